"""phyradgs import: options and a data sheet's words, at each door in the words of that door; and the TOML to fill in."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import writers_of_importers as w

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import read_scan

pytestmark = pytest.mark.slow
DOCS = Path(__file__).resolve().parents[2] / "docs" / "import.md"
CONE = ("--source-to-axis-mm", "500", "--source-to-detector-mm", "800")
SHEET = {"first": "left", "fps": 0.8, "readout_ms": 300.0}
SHEET_TOML = '[timing]\nexposure_s = 0.4\n[readout]\nfirst = "left"\nfps = 0.8\nreadout_ms = 300.0'
SHEET_WORDS = ("--exposure-ms", "400", "--first", "left", "--fps", "0.8", "--readout-ms", "300")


@pytest.fixture
def run(cli, capsys, tmp_path):
    """(words...) → (status, standard output, standard error) of `phyradgs import` to scan.h5."""

    def command(*words: object, out: tuple[str, ...] = ("-o", str(tmp_path / "scan.h5"))) -> tuple[int, str, str]:
        status, captured = cli.run(["import", *map(str, words), *out]), capsys.readouterr()
        return status, captured.out, captured.err

    return command


@pytest.fixture
def imported(tmp_path):
    return lambda: read_scan(tmp_path / "scan.h5", counts_to_attenuation)


def test_three_doors_take_a_data_sheet(run, imported, tmp_path, make_truth) -> None:
    truth, model = make_truth(fly=True, axis="columns"), {"detector_model": "intensity"}
    toml = SHEET_TOML.replace("[readout]", 'detector_model = "intensity"\n[readout]')
    plain, stated = w.write_tiff(tmp_path / "a", truth), w.write_tiff(tmp_path / "b", truth, toml)
    assert run(plain, *SHEET_WORDS, "--detector-model", "intensity")[0] == 0
    for scan in (imported(), import_scan(plain, ImportOptions(exposure_s=0.4, **SHEET, **model)), import_scan(stated)):
        assert scan.shutter == Shutter(0.4, 0.3, "columns", 1) and scan.detector_model == "intensity"
        np.testing.assert_allclose(scan.frame_start_s, 1.25 * np.arange(6))
    assert import_scan(stated, ImportOptions(detector_model="log")).detector_model == "log"
    bad = w.write_tiff(tmp_path / "c", truth, toml.replace("intensity", "intensty"))
    assert "[timing] detector_model: found 'intensty'" in run(bad)[2]


def test_import_prints_what_it_took_and_what_it_assumed(run, tmp_path, make_truth) -> None:
    stated = w.write_tiff(tmp_path / "s", make_truth(fly=True), SHEET_TOML)
    order = "columns read in 300 ms, left first; 0.8 fps; exposure 8° in 400 ms"
    assumed = "angles as each frame opens (assumed); averages line integrals (assumed)"
    assert f"timing: {order}; {assumed}\n" in run(stated)[1]
    _, out, _ = run(stated, "--angle-at", "start", "--detector-model", "intensity")
    assert f"timing: {order}; averages intensity\n" in out and "\nblur at the rim: " in out
    assert re.search(r"^sizes: field of view .* mm \(z, y, x\), fan .*°, cone .*°, voxels .* mm, largest", out, re.M)
    said = run(w.write_r2(tmp_path / "r", make_truth()))[1]
    assert "timing: every frame at rest\n" in said and "applied" not in said
    said = run(w.write_tigre(tmp_path / "t.pickle", make_truth()))[1].splitlines()
    assert len(said) == 3 and all(said)  # no files were chosen


def test_contradictions_are_refused_in_the_words_of_the_door(run, tmp_path, make_truth) -> None:
    """The TOML's keys where there is one; an option that the user gave is named as an option; Python by its arguments."""
    truth = make_truth()
    path = w.write_rtk(tmp_path / "rtk", truth)
    with pytest.raises(InputError, match=r"^exposure_s: .* say frame_time_s or fps$"):
        import_scan(path, ImportOptions(exposure_s=0.4))
    for words, said in {("--fps", "15"): "say --exposure-ms", ("--readout-ms", "62"): "--readout-ms: found no time"}.items():
        status, _, error = run(path, *words)
        assert status == 2 and error.count("\n") == 1 and said in error, (words, error)
    for number, (lines, said) in enumerate({
        '[readout]\nfirst = "left"\naxis = "rows"': "[readout] first: found 'left' with",
        "[timing]\nexposure_s = 0.1\nstart_s = [0, 1, 2, 3, 4, 5]\n[readout]\nfps = 15": "[readout] fps: found 15 with",
        "[readout]\nreadout_ms = 62": "[readout] readout_ms: found no time",
    }.items()):  # fmt: skip
        status, _, error = run(w.write_tiff(tmp_path / f"t{number}", truth, lines))
        assert status == 2 and error.count("\n") == 1 and said in error and "--" not in error, (lines, error)
    error = run(w.write_tiff(tmp_path / "tiff", truth), "--angle-at", "middle")[2]
    assert "--angle-at: found no time" in error and "say [timing] frame_time_s or [readout] fps" in error


def test_import_says_which_flats_and_darks_it_applied_and_warns_of_none(run, tmp_path, make_truth, caplog) -> None:
    folder = w.write_tiff(tmp_path / "tiff", make_truth())
    assert "6 frames of 10×14, 2 flats and 3 darks applied, at rest, 0 pixels masked" in run(folder)[1]
    assert not caplog.messages and "0 flats and 3 darks applied" in run(folder, "--flat-value", "5e4")[1]
    run(folder, "--quantity", "transmission")
    assert "2 flats and 3 darks are left out, because the projections hold transmission" in caplog.text
    (folder / "scan.toml").write_text((folder / "scan.toml").read_text().replace('darks = "dark_*.tif"', ""))
    assert "2 flats and 0 darks applied" in run(folder)[1]
    assert "scan.toml: counts without darks: an offset of the panel stays" in caplog.text


def filled_in(text: str, **values: object) -> str:
    """The template with values for some of its keys, where they stand or after the # is removed."""
    for key, value in values.items():
        text, count = re.subn(rf"^(# )?{key} = [^#]*", f"{key} = {value} ", text, flags=re.M)
        assert count == 1, key
    return text


def test_a_template_that_is_filled_in_is_the_same_scan(run, tmp_path, make_truth, assert_same) -> None:
    truth = make_truth(fly=True, axis="columns")
    folder = w.write_tiff(tmp_path / "tiffs", truth)
    (folder / "scan.toml").unlink()
    assert f"phyradgs import {folder} --template" in run(folder)[2]
    np.savetxt(folder / "angles.txt", np.rad2deg(truth.angle_rad))
    assert "one of both; write > scan.toml" in run(folder, "--template")[2]
    status, text, error = run(folder, "--template", out=())
    assert (status, error) == (0, "") and not (tmp_path / "scan.h5").exists()
    stored = {"flats": '"flat_*.tif"', "darks": '"dark_*.tif"', "file": '"angles.txt"'}
    (folder / "scan.toml").write_text(filled_in(text, **stored), encoding="utf-8")
    assert "[source] to_axis_mm: found 0" in run(folder)[2]
    cone = {"to_axis_mm": 500, "to_detector_mm": 800, "pixel_size_v_mm": 3.0, "pixel_size_u_mm": 2.5}
    moved = {"offset_v_mm": 4.0, "offset_u_mm": -6.0, "exposure_s": 0.4, **SHEET, "first": '"left"'}
    (folder / "scan.toml").write_text(filled_in(text, **cone, **moved, **stored), encoding="utf-8")
    assert_same(import_scan(folder), truth, grid=False)


def test_the_grid_by_options(run, imported, tmp_path, make_truth) -> None:
    """A truth that does not fit the grid is left out, and that is said."""
    rtk, r2 = w.write_rtk(tmp_path / "rtk", make_truth()), w.write_r2(tmp_path / "r2", make_truth())
    run(rtk, "--size", "6,7,8")
    assert imported().grid.shape == (6, 7, 8) and imported().reference is None
    assert "is on another grid and is left out" in "".join(run(r2, "--size", "9", "--voxel-mm", "0.5")[1:])
    assert imported().grid.voxel_size_mm == (0.5, 0.5, 0.5) and imported().reference is None
    assert "left out" not in "".join(run(r2)[1:]) and imported().reference is not None
    assert "r2, 6 frames of 10×14, at rest" in run(r2, "--part", "all", "--unit-mm", "2")[1]
    assert imported().geometry.source_to_axis_mm == pytest.approx(1000)


def test_timing_and_geometry_by_options(run, imported, tmp_path, make_truth) -> None:
    timing = ["--exposure-ms", "400", "--readout-ms", "300", "--fps", "0.8", "--first", "right"]
    assert "fly-scan" in run(w.write_rtk(tmp_path / "rtk", make_truth()), *timing)[1]
    assert imported().shutter == Shutter(0.4, 0.3, "columns", -1)
    path = w.write_data_exchange(tmp_path / "dx.h5", make_truth())
    told = ("--detector-offset", "4,-6", "--pixel-size-mm", "3,2.5", "--rotates", "sample", "--row-0", "top")
    assert run(path, *CONE, *told)[0] == 0
    np.testing.assert_allclose(imported().projections, make_truth().scan.projections, atol=1e-5)
    assert run(path, *CONE, "--pixel-size-mm", "2.5")[0] == 0 and imported().geometry.pixel_size_mm == (2.5, 2.5)
    assert "one for square pixels; write for example 0.148" in run(path, *CONE, "--pixel-size-mm", "2.5,")[2]


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
        status, _, error = run(folder, out=("-o", str(victim)))
        assert status == 2 and error.startswith("phyradgs: --output: ")
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    for _ in range(2):
        assert run(folder, out=("-o", str(folder / "scan.h5")))[0] == 0


def test_frames_without_a_pixel_are_named_and_do_not_count(run, tmp_path) -> None:
    counts = np.random.default_rng(0).uniform(500.0, 900.0, (3, 4, 5))
    counts[0, 0, 0], counts[1] = 500.0, 0.0
    with h5py.File(tmp_path / "dx.h5", "w") as file:
        file["exchange/data"], file["exchange/theta"] = counts, np.array([0.0, 120.0, 240.0])
        file["exchange/data_white"], file["exchange/data_dark"] = np.full((2, 4, 5), 1000.0), np.zeros((1, 4, 5))
    said = "".join(run(tmp_path / "dx.h5", *CONE, "--pixel-size-mm", "1,1")[1:])
    for text in ("20 pixels masked", "largest line integral 0.693", "no pixel can be used in 1 frames (from 0): 1"):
        assert text in said
