"""Benchmarks run, at their smallest; no figure of theirs is looked at but for being there."""

import json
import runpy
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from phyradgs_cl import device_check

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def run(monkeypatch, capsys):
    """(name, words..., status) → what a benchmark prints, run in this process."""

    def run(name: str, *words: str, status: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", [str(FOLDER / name), *words])
        capsys.readouterr()
        found = 0
        try:
            runpy.run_path(sys.argv[0], run_name="__main__")
        except SystemExit as ended:
            found = ended.code or 0
        assert found == status, name
        return capsys.readouterr().out

    return run


def test_the_demo(tmp_path, run, monkeypatch) -> None:
    """Its table has every run with its motion, and its processor seconds are counted in the sum."""
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))
    lines = run("demo.py", str(tmp_path), "--quick").splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith("method "))
    *rows, total = (line.split() for line in lines[start + 1 : start + 6])
    assert [row[:2] for row in rows] == [["fdk", "ignored"], ["fista", "ignored"], ["fista", "known"], ["phyradgs", "known"]]
    used_s = [float(row[-1]) for row in rows]
    assert min(used_s) > 0 and sum(used_s) < float(total[-1])  # the simulation is in the sum
    assert float(rows[2][2]) > float(rows[1][2])  # PSNR, motion known and ignored
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")


def test_volumes_before_and_after(tmp_path, run) -> None:
    """The same code has the same bits; a volume that was another before is named with its size."""
    kept = tmp_path / "before.npz"
    run("identity.py", str(kept), "fdk")
    assert "2 of 2 volumes have the same bits" in run("identity.py", str(kept), "fdk")
    before = dict(np.load(kept))
    np.savez(kept, **{**before, "fdk, static": before["fdk, static"] * 1.25})
    assert "fdk, static: 2.0e-01" in run("identity.py", str(kept), "fdk", status=1)


def test_densities_in_every_geometry(tmp_path, run) -> None:
    """One method each, in turn: none is off by more than 2 % without a warning. Two cells take as long as the others: FISTA
    with few of its finest voxels stands for them, and lines that are there are not run again."""
    rows, table = tmp_path / "rows.jsonl", tmp_path / "table.md"
    costly = "cone, pixel 3 voxels", "parallel, pixel 4 voxels"
    rows.write_text("".join(json.dumps({"case": case, "method": "fista", "warnings": []}) + "\n" for case in costly))
    for beam in ("cone", "parallel"):
        run("geometries.py", "--case", f"{beam}, pixel 2 voxels", "--method", "fista", "--json", str(rows))
    run("geometries.py", "--quick", "--json", str(rows), "--table", str(table))
    found = [json.loads(line) for line in rows.read_text(encoding="utf-8").splitlines()]
    assert len(found) > 60 and {row["method"] for row in found} >= {"fista", "sirt", "fdk", "phyradgs"}
    assert "| cone: helices" in table.read_text(encoding="utf-8")


def test_what_a_gpu_would_say(tmp_path, run, monkeypatch) -> None:
    """One of the checks of a device stands for all."""
    monkeypatch.setattr(device_check, "CHECKS", (device_check._optimiser,))
    words = ["--quick", "--json", str(tmp_path / "facts.json"), "--table", str(tmp_path / "table.md")]
    run("gpu.py", *words)
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["device"] and facts["load_before"] >= 0
    assert facts["trusted"] and facts["same_bits"] and "passed" in facts["tests"] and not facts["errors"]
    assert min(facts[name] for name in ("iteration_ms", "run_s", "fista_tv_s", "fdk_gups")) > 0
    assert facts["device"] in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_benchmarks_that_append_lines_are_resumed(tmp_path, run) -> None:
    x = np.linspace(-1, 1, 32)
    with h5py.File(tmp_path / "ball_32.h5", "w") as file:
        file["volume"] = (x[:, None, None] ** 2 + x[:, None] ** 2 + x**2 < 0.5).astype(np.float32)
    for name, words, facts in (
        ("calibrate.py", "{tmp} {lines} --cases wobble --size 16 --views 8 --seeds 1", {"case": "wobble", "seed": 1}),
        ("bead_bias.py", "{lines} --size XS --trials stop-and-shoot", {"trial": "stop-and-shoot", "method": "fista-tv"}),
        ("fan_fly.py", "{lines} --side 28 --iterations 2 --trials 1", {"side": 28, "method": "fdk", "model": "ignored"}),
    ):
        lines = tmp_path / f"{name}.jsonl"
        asked = [word.format(tmp=tmp_path, lines=lines) for word in words.split()]
        first = run(name, *asked)
        assert lines.read_text() == first and facts.items() <= json.loads(first).items()
        assert run(name, *asked) == "" and lines.read_text() == first
