"""phyradgs import, as the command line runs it."""

import os
import re
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import typer
import writers_of_importers as w
from typer.testing import CliRunner

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.commands.import_scan import EXAMPLES, import_command
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import import_scan
from phyradgs_cl.io import read_scan

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs" / "import.md"


@pytest.fixture
def run(tmp_path):
    """(input, words...) → what the command did; its scan.h5 is in tmp_path where none other is named."""
    app = typer.Typer(rich_markup_mode=None)
    app.command("import", epilog=EXAMPLES["import"])(import_command)

    def command(path: Path, *words: object, out: Path = tmp_path / "scan.h5", ok: bool = True):
        done = CliRunner().invoke(app, [str(a) for a in (path, "-o", out, *words)])
        assert done.exit_code == 0 or not ok, (done.output, done.exception)
        return done

    return command


@pytest.fixture
def imported(tmp_path):
    return lambda: read_scan(tmp_path / "scan.h5", counts_to_attenuation)


def test_a_folder_becomes_a_scan(run, imported, tmp_path, make_truth) -> None:
    path = w.write_r2(tmp_path / "r2", make_truth())
    assert "r2, 6 frames of 10×14, at rest" in run(path, "--part", "all", "--unit-mm", "2").output
    assert imported().geometry.source_to_axis_mm == pytest.approx(1000)
    assert imported().provenance["imported_from"] == str(path)


def test_the_grid_by_options(run, imported, tmp_path, make_truth) -> None:
    """A truth that does not fit the grid is left out, and that is said."""
    rtk, r2 = w.write_rtk(tmp_path / "rtk", make_truth()), w.write_r2(tmp_path / "r2", make_truth())
    run(rtk, "--size", "6,7,8")
    assert imported().grid.shape == (6, 7, 8) and imported().reference is None
    assert "is on another grid and is left out" in run(r2, "--size", "9", "--voxel-mm", "0.5").output
    assert imported().grid.voxel_size_mm == (0.5, 0.5, 0.5) and imported().reference is None
    assert "left out" not in run(r2).output and imported().reference is not None


def test_timing_and_geometry_by_options(run, imported, tmp_path, make_truth) -> None:
    timing = ["--exposure-ms", "400", "--readout-ms", "300", "--fps", "0.8", "--first", "right"]
    done = run(w.write_rtk(tmp_path / "rtk", make_truth()), *timing)
    assert "fly-scan" in done.output and imported().shutter == Shutter(0.4, 0.3, "columns", -1)
    path = w.write_data_exchange(tmp_path / "dx.h5", make_truth())
    cone = ["--source-to-axis-mm", "500", "--source-to-detector-mm", "800", "--detector-offset", "4,-6"]
    run(path, *cone, "--pixel-size-mm", "3,2.5", "--rotates", "sample", "--row-0", "top")
    np.testing.assert_allclose(imported().projections, make_truth().scan.projections, atol=1e-5)


def test_the_documentation_s_example_runs(tmp_path, make_truth, monkeypatch) -> None:
    text = DOCS.read_text(encoding="utf-8")
    toml = next(block for block in re.findall(r"```toml\n(.*?)```", text, re.S) if "[frames]" in block)
    path = w.write_tiff(tmp_path / "scan", make_truth())
    (path / "scan.toml").write_text(toml)
    scan = import_scan(path)
    assert scan.is_fly and scan.frames == 6
    python = next(b for b in re.findall(r"```python\n(.*?)```", text, re.S))
    monkeypatch.chdir(tmp_path)
    exec(compile(python, str(DOCS), "exec"), {})
    assert read_scan(tmp_path / "scan.h5", counts_to_attenuation).is_fly


def test_nothing_that_is_read_is_overwritten(run, tmp_path, make_truth) -> None:
    """Whatever lies with the input and is no scan of ours may be part of it; one of ours is made anew."""
    folder = w.write_rtk(tmp_path / "rtk", make_truth())
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert len(before) >= 2
    for victim in before:
        done = run(folder, out=victim, ok=False)
        assert isinstance(done.exception, InputError) and done.exception.subject == "--output"
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    for _ in range(2):
        run(folder, out=folder / "scan.h5")


@pytest.mark.skipif(sys.platform != "linux", reason="file systems that take any bytes")
def test_a_title_with_a_nul_and_a_folder_whose_name_is_no_text(run, imported, tmp_path, make_truth) -> None:
    folder = w.write_tiff(tmp_path / os.fsdecode(b"bad\xff"), make_truth())
    description = folder / "scan.toml"
    text = description.read_text()
    for title in (r'title = "a\u0000b\u001b"', ""):
        description.write_text(text.replace('title = "tiff"', title))
        run(folder)
        assert imported().title == ("a\ufffdb\ufffd" if title else "bad\ufffd")
        assert imported().provenance["imported_from"] == str(folder)


def test_frames_without_a_pixel_are_named_and_do_not_count(run, tmp_path) -> None:
    counts = np.random.default_rng(0).uniform(500.0, 900.0, (3, 4, 5)).astype(np.float32)
    counts[0, 0, 0] = 500.0
    counts[1] = 0.0
    with h5py.File(tmp_path / "dx.h5", "w") as file:
        file["exchange/data"], file["exchange/theta"] = counts, np.array([0.0, 120.0, 240.0])
        file["exchange/data_white"] = np.full((2, 4, 5), 1000.0, np.float32)
        file["exchange/data_dark"] = np.zeros((1, 4, 5), np.float32)
    where = ("--source-to-axis-mm", "500", "--source-to-detector-mm", "800", "--pixel-size-mm", "1,1")
    done = run(tmp_path / "dx.h5", *where)
    assert all(text in done.output for text in ("20 pixels masked", "largest line integral 0.693"))
    assert "no pixel can be used in 1 frames (from 0): 1" in done.output
