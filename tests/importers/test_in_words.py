"""What a user says in a data sheet's words, at each door in the words of that door; and the TOML to fill in."""

import re
from dataclasses import replace

import numpy as np
import pytest
import writers_of_importers as w

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import read_scan

pytestmark = pytest.mark.slow

SHEET = {"first": "left", "fps": 0.8, "readout_ms": 300.0}
SHEET_TOML = '[timing]\nexposure_s = 0.4\n[readout]\nfirst = "left"\nfps = 0.8\nreadout_ms = 300.0'
SHEET_WORDS = ("--exposure-ms", "400", "--first", "left", "--fps", "0.8", "--readout-ms", "300")


@pytest.fixture
def run(cli, capsys, tmp_path):
    """(words...) → (status, standard output, standard error) of `phyradgs import` to scan.h5."""

    def command(*words: object, out: tuple[str, ...] = ("-o", str(tmp_path / "scan.h5"))) -> tuple[int, str, str]:
        status = cli.run(["import", *map(str, words), *out])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return command


def test_three_doors_take_a_data_sheet(run, tmp_path, make_truth) -> None:
    truth = make_truth(fly=True, axis="columns")
    plain, stated = w.write_tiff(tmp_path / "a", truth), w.write_tiff(tmp_path / "b", truth, SHEET_TOML)
    assert run(plain, *SHEET_WORDS)[0] == 0
    scans = [import_scan(plain, ImportOptions(exposure_s=0.4, **SHEET)), import_scan(stated)]
    for scan in (*scans, read_scan(tmp_path / "scan.h5", counts_to_attenuation)):
        assert scan.shutter == Shutter(0.4, 0.3, "columns", 1)
        np.testing.assert_allclose(scan.frame_start_s, 1.25 * np.arange(6))


def test_import_prints_what_it_took_and_what_it_assumed(run, tmp_path, make_truth) -> None:
    blurred = w.write_phyradgs(tmp_path / "p", make_truth(fly=True, axis="columns"))
    arc = "exposure 8° in 1000 ms (assumed)"
    _, out, _ = run(blurred)
    assert f"timing: columns read in 750 ms, left first (assumed); {arc}; averages line integrals (assumed)\n" in out
    assert "\nblur at the rim: 1.3 px, at half radius 0.66 px\n" in out  # 8° of 9.4 columns, off centre
    stated = w.write_tiff(tmp_path / "s", make_truth(fly=True), SHEET_TOML)
    order = "columns read in 300 ms, left first; 0.8 fps; exposure 8° in 400 ms"
    assumed = "angles as each frame opens (assumed); averages line integrals (assumed)"
    assert f"timing: {order}; {assumed}\n" in run(stated)[1]
    _, out, _ = run(stated, "--angle-at", "start", "--detector-model", "intensity")
    assert f"timing: {order}; averages intensity\n" in out
    assert re.search(r"^sizes: field of view .* mm \(z, y, x\), fan .*°, cone .*°, voxels .* mm, largest", out, re.M)
    assert "timing: every frame at rest\n" in run(w.write_r2(tmp_path / "r", make_truth()))[1]


def test_contradictions_are_refused_in_the_words_of_the_door(run, tmp_path, make_truth) -> None:
    truth = make_truth()
    path = w.write_rtk(tmp_path / "rtk", truth)
    for words, said in {
        ("--fps", "15"): "say --exposure-ms",
        ("--readout-ms", "62"): "--readout-ms: found no time from frame to frame",
    }.items():
        status, _, error = run(path, *words)
        assert status == 2 and error.count("\n") == 1 and said in error, (words, error)
    for number, (lines, said) in enumerate({
        '[readout]\nfirst = "left"\naxis = "rows"': "[readout] first: found 'left' with",
        "[timing]\nexposure_s = 0.1\nstart_s = [0, 1, 2, 3, 4, 5]\n[readout]\nfps = 15": "[readout] fps: found 15 with",
        "[timing]\nexposure_s = 0.1\nreadout_s = 2.0\n[readout]\nreadout_ms = 62": "[readout] readout_ms: found 62 with",
        "[readout]\nfps = 15": "say [timing] exposure_s",
        "[readout]\nreadout_ms = 62": "[readout] readout_ms: found no time",
    }.items()):  # fmt: skip
        status, _, error = run(w.write_tiff(tmp_path / f"t{number}", truth, lines))
        assert status == 2 and error.count("\n") == 1 and said in error and "--" not in error, (lines, error)


def test_what_a_file_lacks_is_asked_for_in_the_words_of_the_door(run, tmp_path, make_truth) -> None:
    """The TOML's keys where there is one; an option that the user gave is named as an option; Python by its arguments."""
    folder = w.write_tiff(tmp_path / "tiff", make_truth(), "[timing]\nexposure_s = 0.4")
    assert "[timing] frame_time_s or [readout] fps" in run(folder)[2]
    text = (folder / "scan.toml").read_text().replace("[timing]\nexposure_s = 0.4", "").replace('flats = "flat_*.tif"', "")
    (folder / "scan.toml").write_text(text.replace('darks = "dark_*.tif"', ""))
    assert "say [frames] quantity attenuation" in run(folder)[2]
    assert "or say [frames] flat_value" in run(folder, "--quantity", "counts")[2]
    error = run(folder, "--quantity", "counts", "--flat-value", "5e4", "--angle-at", "middle")[2]
    assert "--angle-at: found no time" in error and "say [timing] frame_time_s" in error
    with pytest.raises(InputError, match=r"^exposure_s: .* say frame_time_s or fps$"):
        import_scan(w.write_rtk(tmp_path / "rtk", make_truth()), ImportOptions(exposure_s=0.4))


def test_import_says_which_flats_and_darks_it_applied_and_warns_of_none(run, tmp_path, make_truth, caplog) -> None:
    folder = w.write_tiff(tmp_path / "tiff", make_truth())
    assert "6 frames of 10×14, 2 flats and 3 darks applied, at rest, 0 pixels masked" in run(folder)[1]
    assert not caplog.messages
    assert "0 flats and 3 darks applied" in run(folder, "--flat-value", "5e4")[1]
    run(folder, "--quantity", "transmission")
    assert "2 flats and 3 darks are left out, because the projections hold transmission" in caplog.text
    caplog.clear()
    text = (folder / "scan.toml").read_text()
    (folder / "scan.toml").write_text(text.replace('darks = "dark_*.tif"', ""))
    assert "2 flats and 0 darks applied" in run(folder)[1]
    assert "scan.toml: counts without darks: an offset of the panel stays" in caplog.text
    assert "applied" not in run(w.write_r2(tmp_path / "r", make_truth()))[1]


def test_the_model_of_the_panel_may_stand_in_the_toml(run, tmp_path, make_truth) -> None:
    truth = make_truth(fly=True)
    sheet = SHEET_TOML.replace("[readout]", 'detector_model = "intensity"\n[readout]').replace('"left"', '"bottom"')
    folder = w.write_tiff(tmp_path / "a", truth, sheet)
    _, out, _ = run(folder)
    assert "averages intensity\n" in out
    assert read_scan(tmp_path / "scan.h5", counts_to_attenuation).detector_model == "intensity"
    assert import_scan(folder, ImportOptions(detector_model="log")).detector_model == "log"
    bad = w.write_tiff(tmp_path / "b", truth, sheet.replace("intensity", "intensty"))
    assert "[timing] detector_model: found 'intensty'" in run(bad)[2]


def test_one_pixel_size_means_square_pixels(run, tmp_path, make_truth) -> None:
    data = w.write_data_exchange(tmp_path / "dx.h5", make_truth())
    cone = ("--source-to-axis-mm", "500", "--source-to-detector-mm", "800")
    assert run(data, *cone, "--pixel-size-mm", "2.5")[0] == 0
    assert read_scan(tmp_path / "scan.h5", counts_to_attenuation).geometry.pixel_size_mm == (2.5, 2.5)
    assert "one for square pixels; write for example 0.148" in run(data, *cone, "--pixel-size-mm", "2.5,")[2]


# --- the TOML to fill in ------------------------------------------------------------------------------------------------


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
    status, text, error = run(folder, "--template", out=())
    assert (status, error) == (0, "") and not (tmp_path / "scan.h5").exists()
    stored = {"flats": '"flat_*.tif"', "darks": '"dark_*.tif"', "file": '"angles.txt"'}
    (folder / "scan.toml").write_text(filled_in(text, **stored), encoding="utf-8")
    assert "[source] to_axis_mm: found 0" in run(folder)[2]
    cone = {"to_axis_mm": 500, "to_detector_mm": 800, "pixel_size_v_mm": 3.0, "pixel_size_u_mm": 2.5}
    moved = {"offset_v_mm": 4.0, "offset_u_mm": -6.0, "exposure_s": 0.4, **SHEET, "first": '"left"'}
    (folder / "scan.toml").write_text(filled_in(text, **cone, **moved, **stored), encoding="utf-8")
    assert_same(import_scan(folder), truth, grid=False)


SAID = {
    "exposure_s": {"exposure_s": 0.4}, "readout_s": {"readout_s": 0.3}, "angle_at": {"angle_at": "middle"},
    "readout_axis": {"readout_axis": "rows"}, "readout_direction": {"readout_direction": -1},
    "first": {"first": "left"}, "readout_ms": {"readout_ms": 300.0},
}  # fmt: skip


@pytest.mark.parametrize("form", ["rtk", "nxtomo", "tiff"])
def test_a_turn_without_a_frame_time_is_refused(tmp_path, make_truth, form) -> None:
    path, options = w.write(form, tmp_path, make_truth), ImportOptions()
    for name, said in SAID.items():
        if form == "nxtomo" and name == "exposure_s":  # the option replaces the file's count_time, which says no more
            assert not import_scan(path, replace(options, **said), form).is_fly
            continue
        with pytest.raises(InputError, match=f"^{name}: .*time from frame to frame.*say .*frame_time_s or .*fps"):
            import_scan(path, replace(options, **said), form)
        timed = replace(options, frame_time_s=1.25, **{"exposure_s": 0.4, **said})
        assert import_scan(path, timed, form).is_fly
    assert not import_scan(path, options, form).is_fly
