"""Provenance is edited, damaged or made up: what is not of its kind is left out, in one line."""

import json
import shutil
from pathlib import Path

import h5py
import pytest

from phyradgs_cl.io import read_volume, write_volume
from phyradgs_cl.io.tables import PROVENANCE, read_facts
from phyradgs_cl.workflow.files import load_scan

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("fast_pictures")]
ABSURD = {
    "half a surrogate pair": "x\udcff\ud800", "a control": "x\x1b[2J\0", "a list": ["x", 1], "a table": {"a": {"b": 1}},
    "beyond floats": 1e308, "NaN": float("nan"), "nothing": None,
}  # fmt: skip
FIELDS = ("method", "scan", "scan_sha256", "seconds", "gaussians", "record", "options", "input", "segments")
FIELDS += ("program", "interrupted_at", "unheard_of")


@pytest.fixture(scope="module")
def files(tiny_scan: Path) -> tuple[Path, Path]:
    """A scan and a volume of it."""
    scan, volume = load_scan(tiny_scan), tiny_scan.with_name("volume.h5")
    write_volume(volume, 0.9 * scan.reference, scan.grid, {"method": "fdk"}, metrics={"ssim": 0.5})
    return tiny_scan, volume


def written(path: Path, target: Path, provenance: str, metrics: str = "{}") -> Path:
    """The volume with other facts, as text."""
    shutil.copy(path, target)
    with h5py.File(target, "r+") as file:
        for name, text in (("provenance", provenance), ("metrics", metrics)):
            (group := file.require_group(f"entry/{name}")).pop("json", None)
            group["json"] = text
    return target


@pytest.mark.parametrize("case", ABSURD)
def test_every_field_may_be_absurd(files, tmp_path, cli, case, capsys, caplog) -> None:
    """In all fields at once, for report, info and evaluate: they end well, or in one line."""
    scan, volume = files
    facts = dict.fromkeys(FIELDS, ABSURD[case])
    facts["options"] = {"motion": {"name": ABSURD[case], "strips": ABSURD[case]}}
    bad = written(volume, tmp_path / "v.h5", json.dumps(facts), json.dumps({"psnr_db": ABSURD[case], "ssim": 1.0}))
    for command in (
        ["info", str(bad)],
        ["report", str(bad), "-o", str(tmp_path / "page.html"), "--views", "0", "--scan", str(scan)],
        ["evaluate", str(bad), "--reference", str(scan)],
    ):
        assert cli.run(command) == 0, f"{case}: {command}"
    out = capsys.readouterr().out
    assert len(out) < 50_000 and "\x1b" not in out and "\0" not in out
    assert "\x1b" not in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_damage_costs_a_field_and_is_told(files, tmp_path, caplog) -> None:
    facts = {"method": ["fdk"], "seconds": "many", "gaussians": 10**400, "seed": 3, "loss": float("inf")}
    stored = read_volume(written(files[1], tmp_path / "v.h5", json.dumps(facts), '{"psnr_db": "x", "ssim": 0.5}'))
    assert stored.provenance == {"seed": 3, "loss": float("inf")} and stored.metrics == {"ssim": 0.5}
    for name in ("method", "seconds", "gaussians", "psnr_db"):
        assert any(name in record.getMessage() for record in caplog.records)


def test_text_that_is_no_table_is_refused() -> None:
    for text in ("[1]", "{", "[" * 100_000, "1" * 5000, '{"a": ' + "[" * 2000 + "]" * 2000 + "}"):
        with pytest.raises(Exception, match="JSON") as caught:
            read_facts("a file", text, PROVENANCE)
        assert type(caught.value).__name__ == "InputError"
