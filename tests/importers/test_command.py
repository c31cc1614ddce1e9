"""phyradgs import, as the command line runs it."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
import pytest
import typer
import writers_of_importers as w
from typer.testing import CliRunner

from phyradgs_cl.commands.import_scan import EXAMPLE, import_command
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.importers import FORMATS, ImportOptions, import_scan
from phyradgs_cl.importers.options import option_name
from phyradgs_cl.io import read_scan

DOCS = Path(__file__).resolve().parents[2] / "docs" / "import.md"


@pytest.fixture
def run():
    app = typer.Typer(rich_markup_mode=None)
    app.command("import", epilog=EXAMPLE)(import_command)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


def test_a_folder_becomes_a_scan(run, tmp_path, make_truth) -> None:
    path, out = w.write_r2(tmp_path / "r2", make_truth()), tmp_path / "scan.h5"
    done = run(path, "-o", out, "--part", "all", "--unit-mm", "2")
    assert done.exit_code == 0, (done.output, done.exception)
    assert "r2, 6 frames of 10×14, at rest" in done.output
    scan = read_scan(out, counts_to_attenuation)
    assert scan.geometry.source_to_axis_mm == pytest.approx(1000)
    assert scan.provenance["imported_from"] == str(path)


@pytest.mark.parametrize(
    ("write", "options", "shape", "has_reference"),
    [
        (w.write_rtk, ["--size", "6,7,8"], (6, 7, 8), False),
        (w.write_r2, ["--size", "9", "--voxel-mm", "0.5"], None, False),
        (w.write_r2, [], None, True),
    ],
)
def test_the_grid_by_options(run, tmp_path, make_truth, write, options, shape, has_reference) -> None:
    """A truth that does not fit the grid is left out, and that is said."""
    path, out = write(tmp_path / "source", make_truth()), tmp_path / "scan.h5"
    done = run(path, "-o", out, *options)
    assert done.exit_code == 0, done.exception
    assert ("is on another grid and is left out" in done.output) == (write is w.write_r2 and bool(options))
    scan = read_scan(out, counts_to_attenuation)
    assert (scan.reference is not None) == has_reference
    assert shape is None or scan.grid.shape == shape
    assert not options or shape or scan.grid.voxel_size_mm == (0.5, 0.5, 0.5)


def test_timing_by_options(run, tmp_path, make_truth) -> None:
    path, out = w.write_rtk(tmp_path / "rtk", make_truth()), tmp_path / "scan.h5"
    timing = ["--exposure-s", "0.4", "--readout-s", "0.3", "--frame-time-s", "1.25"]
    done = run(path, "-o", out, *timing, "--readout", "columns", "--readout-direction", "-1")
    assert done.exit_code == 0 and "fly-scan" in done.output, done.exception
    shutter = read_scan(out, counts_to_attenuation).shutter
    assert (shutter.exposure_s, shutter.readout_s, shutter.axis, shutter.direction) == (
        0.4,
        0.3,
        "columns",
        -1,
    )


def test_geometry_by_options(run, tmp_path, make_truth) -> None:
    path, out = w.write_data_exchange(tmp_path / "dx.h5", make_truth()), tmp_path / "scan.h5"
    cone = ["--source-to-axis-mm", "500", "--source-to-detector-mm", "800", "--detector-offset", "4,-6"]
    done = run(path, "-o", out, *cone, "--pixel-size-mm", "3,2.5", "--rotates", "sample", "--row-0", "top")
    assert done.exit_code == 0, done.exception
    np.testing.assert_allclose(
        read_scan(out, counts_to_attenuation).projections, make_truth().scan.projections, atol=1e-5
    )


def test_an_existing_output_survives_an_error(run, tmp_path, make_truth) -> None:
    path, out = w.write_r2(tmp_path / "r2", make_truth()), tmp_path / "scan.h5"
    out.write_bytes(b"precious")
    (path / "proj_train" / "0000.npy").unlink()
    assert isinstance(run(path, "-o", out).exception, InputError)
    assert out.read_bytes() == b"precious" and not list(tmp_path.glob(".*"))


def test_the_input_is_not_overwritten(run, tmp_path, make_truth) -> None:
    path = w.write_data_exchange(tmp_path / "dx.h5", make_truth())
    assert isinstance(run(path, "-o", path).exception, InputError)
    assert isinstance(run(path, "-o", tmp_path / "none" / "scan.h5").exception, OutputError)


def test_formats_and_options_are_described() -> None:
    text = DOCS.read_text(encoding="utf-8")
    missing = [form for form in FORMATS if f"`{form}`" not in text]
    missing += [f.name for f in fields(ImportOptions) if f"`{option_name(f.name)}" not in text]
    assert not missing


def test_the_documentation_s_example_runs(tmp_path, make_truth, monkeypatch) -> None:
    """The worked TOML of docs/import.md describes the folder that the writer makes."""
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
    """Whatever lies with the input and is no scan of ours may be part of it."""
    folder = tmp_path / "rtk"
    source = w.write_rtk(folder, make_truth())
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert len(before) >= 2
    for victim in before:
        for given in {source, folder if source.is_dir() else source}:
            done = run(given, "-o", victim)
            assert isinstance(done.exception, InputError) and done.exception.culprit == "--output"
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_scan_beside_the_input_is_made_anew(run, tmp_path, make_truth) -> None:
    source = w.write_rtk(tmp_path / "rtk", make_truth())
    out = (source if source.is_dir() else source.parent) / "scan.h5"
    for _ in range(2):
        done = run(source, "-o", out)
        assert done.exit_code == 0, done.exception


@pytest.mark.parametrize("name", ["", "a.tif"])
def test_images_without_a_description_are_told_what_they_lack(run, tmp_path, name) -> None:
    (tmp_path / "a.tif").write_bytes(b"II*")
    done = run(tmp_path / name, "-o", tmp_path / "scan.h5")
    assert isinstance(done.exception, InputError) and "no TOML" in str(done.exception)


@pytest.mark.parametrize("member", ["/entry/reconstruction", "/volume"])
def test_a_volume_is_told_from_a_scan(run, tmp_path, member) -> None:
    with h5py.File(tmp_path / "volume.h5", "w") as file:
        file[member] = np.zeros((2, 2, 2), np.float32)
    done = run(tmp_path / "volume.h5", "-o", tmp_path / "scan.h5")
    assert isinstance(done.exception, InputError) and "found a volume" in str(done.exception)
    assert f"volume.h5:{member}" in str(done.exception) and "phyradgs export" in str(done.exception)


@pytest.mark.skipif(sys.platform != "linux", reason="file systems that take any bytes")
def test_a_title_with_a_nul_and_a_folder_whose_name_is_no_text(run, tmp_path, make_truth) -> None:
    folder, out = w.write_tiff(tmp_path / os.fsdecode(b"bad\xff"), make_truth()), tmp_path / "scan.h5"
    description = folder / "scan.toml"
    text = description.read_text()
    for title in (r'title = "a\u0000b\u001b"', ""):
        description.write_text(text.replace('title = "tiff"', title))
        done = run(folder, "-o", out)
        assert done.exit_code == 0, (done.output, done.exception)
        scan = read_scan(out, counts_to_attenuation)
        assert scan.title == ("a\ufffdb\ufffd" if title else "bad\ufffd")
        assert scan.provenance["imported_from"] == str(folder)


def test_frames_without_a_pixel_are_named_and_do_not_count(run, tmp_path) -> None:
    counts = np.random.default_rng(0).uniform(500.0, 900.0, (3, 4, 5)).astype(np.float32)
    counts[0, 0, 0] = 500.0
    counts[1] = 0.0
    with h5py.File(tmp_path / "dx.h5", "w") as file:
        file["exchange/data"], file["exchange/theta"] = counts, np.array([0.0, 120.0, 240.0])
        file["exchange/data_white"] = np.full((2, 4, 5), 1000.0, np.float32)
        file["exchange/data_dark"] = np.zeros((1, 4, 5), np.float32)
    where = ("--source-to-axis-mm", "500", "--source-to-detector-mm", "800", "--pixel-size-mm", "1,1")
    done = run(tmp_path / "dx.h5", "-o", tmp_path / "s.h5", *where)
    assert done.exit_code == 0, (done.output, done.exception)
    assert "largest line integral 0.693, 20 pixels masked" in done.output
    assert "no pixel can be used in 1 frames (from 0): 1" in done.output
