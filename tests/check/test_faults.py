"""The whole check: each planted fault is found, and a clean scan has none."""

import json
from dataclasses import replace

import numpy as np
import pytest
from check_kit import cropped, negative, some_frames, stated, suspected, verdicts

from phyradgs_cl.acquisition import ConeGeometry, PoseTable
from phyradgs_cl.acquisition.altered.coarse import FINE_COLUMNS, QUICK_COLUMNS, coarse
from phyradgs_cl.acquisition.plausible import blur_facts, blur_line
from phyradgs_cl.check import CANNOT_TELL, OK, SUSPICIOUS, check
from phyradgs_cl.check.detector import check_gain
from phyradgs_cl.check.orbit import OTHER_CAUSE, check_centre, find_orbit
from phyradgs_cl.check.run import quick_scan
from phyradgs_cl.check.shutter import check_exposure, check_readout
from phyradgs_cl.commands.check import SUSPICIOUS_STATUS
from phyradgs_cl.detector.effects import beer_lambert_noise
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import read_scan, write_scan
from phyradgs_cl.reconstructors.fits.axis import AxisShift
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow


def test_a_scan_at_rest_with_a_masked_pixel_is_asked_less_and_progress_is_told(rt, still) -> None:
    p, mask, seen = still.projections.copy(), np.zeros(still.geometry.detector_shape, bool), []
    mask[5, 7] = True
    p[:, 5, 7] = np.nan
    with pytest.raises(InputError, match="NaN"):
        check(replace(still, projections=p), rt)
    with pytest.raises(InputError, match="every pixel masked"):
        check(replace(still, pixel_mask=np.ones_like(mask)), rt)
    masked = replace(still, projections=p, pixel_mask=mask)
    found = check(masked, rt, report=lambda done, total, question: seen.append((done, total, question)))
    assert found.suspicious == [] and np.isfinite(found.offset_mm)
    asked = verdicts(found)
    assert seen == [(n, 11, question) for n, question in enumerate([*asked, ""])]
    assert "sign of readout" not in asked and asked["exposure"] == CANNOT_TELL and len(asked) == 11


@pytest.mark.parametrize(("rows", "columns", "verdict"), [(64, 4, CANNOT_TELL), (1, 64, OK), (1, 1, CANNOT_TELL)])
def test_strips_of_a_panel_raise_no_false_alarm(rt, scan_of, rows, columns, verdict) -> None:
    """Blocks are no larger than the panel's shorter side, and few columns say nothing about the axis."""
    found = check(scan_of(ConeGeometry(5.0, 7.0, (rows, columns), (0.0625, 0.0625))), rt)
    assert verdicts(found)["sign of rotation"] == verdicts(found)["centre of rotation"] == verdict
    assert np.isnan(found.offset_mm) == (verdict == CANNOT_TELL)


def test_a_mirror_image_in_a_narrow_fan_cannot_be_told(rt, scan_of) -> None:
    narrow = ConeGeometry(500.0, 700.0, (32, 32), (0.125, 0.125))
    scan = scan_of(narrow, views=15, exposure_deg=24.0, readout_ratio=0.5)
    found = check(negative(scan), rt)
    distances = next(one for one in found.findings if one.question == "distances")
    assert distances.verdict == CANNOT_TELL  # only the fan shows them
    assert "neither pixel sizes nor distances are verified" in distances.text and "--pixel-size-mm" in distances.advice
    assert verdicts(found)["sign of rotation"] == verdicts(found)["sign of readout"] == CANNOT_TELL
    assert find_orbit(rt, quick_scan(scan), scan, True).sign.verdict == CANNOT_TELL


def test_a_beam_without_a_fan_leaves_sizes_and_offset_open() -> None:
    """Stated 20 pixels beside the middle, found at 2, the panel may have larger pixels; at -20 it may be a mirror image."""

    def found(pixels):
        return check_centre(AxisShift(pixels, 0.05, np.empty(0)), 2, 0.1, 20.0)

    assert found(-18.0).unit == OTHER_CAUSE and "pixel sizes were 10 times as large" in found(-18.0).text
    assert "--fix-offset" not in found(-18.0).advice and "--fix-offset" in found(-15.0).advice
    assert "mirrored in u" in found(-40.0).text and "mirrored" not in found(-15.0).text
    assert found(0.49).verdict == SUSPICIOUS and found(0.3).verdict == OK  # an axis on pixel N/2 in place of (N-1)/2
    # 26 columns are a coarse pixel of a wide panel, which tolerates no more
    assert check_centre(AxisShift(-1.9, 0.1, np.empty(0)), 26, 0.1, 0.0).verdict == SUSPICIOUS


def test_the_deviation_of_an_offset_covers_its_error_in_half_a_turn(rt, scan_of) -> None:
    """Most rays are then measured once, and coarse volumes pull the offset to one side."""
    pixels, geometry = 0.5, ConeGeometry(5.0, 7.0, (64, 64), (0.0625, 0.0625))
    scan = scan_of(geometry, size=32, views=40, exposure_deg=9.0)
    off = stated(some_frames(scan, slice(24)), detector_offset_mm=(0.0, -pixels * 0.0625))
    found = find_orbit(rt, quick_scan(off), off, True).shift
    assert abs(found.pixels - pixels) < 2 * found.deviation < 0.8


def test_a_drift_of_the_gain(rt, clean, still) -> None:
    change = -0.05
    gain = np.log1p(change) * np.arange(clean.frames) / (clean.frames - 1)
    drifted, fixed = (replace(one, projections=one.projections - np.float32(gain)[:, None, None]) for one in (clean, still))
    found = check(drifted, rt)
    assert suspected(found) == ["gain drift"]
    narrow = cropped(fixed, np.s_[:, :, 9:23])
    cut = next(f for f in check(narrow, rt).findings if f.question == "gain drift")
    assert cut.verdict == CANNOT_TELL and "or the object does beyond the panel" in cut.text
    value = next(f.value for f in found.findings if f.question == "gain drift")
    assert value == pytest.approx(change, abs=0.01)
    brighter = check_gain(rt, coarse(replace(clean, projections=clean.projections + gain[:, None, None]), QUICK_COLUMNS))
    assert brighter.verdict == SUSPICIOUS and brighter.value == pytest.approx(-change, abs=0.01)


@pytest.mark.parametrize("left", [1, 40])
def test_a_mask_that_leaves_a_few_pixels(rt, still, left) -> None:
    mask = np.ones((32, 32), bool)
    mask.flat[np.random.default_rng(0).permutation(1024)[:left]] = False
    found = check(replace(still, pixel_mask=mask), rt)
    assert found.suspicious == [] and verdicts(found)["consistency"] == CANNOT_TELL


def test_of_frames_that_are_mostly_noise_the_noise_alone_is_named(rt, still) -> None:
    """Thirty photons in a pixel: no order of the frames fits better than another, and that is no fault of theirs."""
    frames = still.projections * (2 / still.projections.max())
    noisy = beer_lambert_noise(frames, 30, 10.0, np.random.default_rng(0))
    found = check(replace(still, projections=noisy), rt)
    assert suspected(found) == ["noise"] and verdicts(found)["consistency"] == CANNOT_TELL


def test_a_wrong_readout(rt, scan_of) -> None:
    """Columns that are read in the wrong order bend the object, which shows; in a wide cone."""
    scan = scan_of(ConeGeometry(3.0, 4.5, (48, 48), (0.125, 0.125)), "foot", 32, "columns", views=25)
    other, at_once = (replace(scan, shutter=replace(scan.shutter, **k)) for k in ({"direction": -1}, {"readout_s": 0.0}))
    right, turned, shut = (check_readout(rt, coarse(one, FINE_COLUMNS)) for one in (scan, other, at_once))
    assert (right.verdict, turned.verdict, shut.verdict) == (OK, SUSPICIOUS, CANNOT_TELL)
    assert "set readout_direction to 1, or import with --first" in turned.advice
    assert "by columns, index 0 first" in shut.text  # of four orders


def test_the_command_and_its_status(cli, clean, tmp_path, capsys) -> None:
    """No offset is corrected where the gantry turns the other way: of mirrored frames it would have the wrong sign."""
    path, fixed = tmp_path / "scan.h5", tmp_path / "fixed.h5"
    write_scan(path, clean)
    assert cli.run(["check", str(path)]) == 0
    text = capsys.readouterr().out
    assert text.count("\n") >= 12 and "not asked: which end of the panel is up" in text
    assert f"\n{blur_line(clean)}\n" in text and blur_line(clean).startswith("blur at the rim: ")
    assert text.endswith("0 of 12 questions suspicious, 2 cannot be told: sign of readout, exposure\n")
    write_scan(path, wrong := negative(stated(clean, detector_offset_mm=(0.0, 0.25))))
    assert cli.run(["check", str(path), "--json", "--fix-offset", "-o", str(fixed)]) == 2
    streams = capsys.readouterr()
    assert "frames that do not fit together" in streams.err and not fixed.exists()
    facts = json.loads(streams.out)
    questions = [one["question"] for one in facts["findings"] if one["verdict"] == SUSPICIOUS]
    assert questions == ["sign of rotation"] and facts["suspicious"] == 1 and len(facts["findings"]) == 12
    assert {name: facts[name] for name in blur_facts(wrong)} == pytest.approx(blur_facts(wrong))
    assert {"question", "verdict", "value", "threshold", "unit", "text", "advice"} <= set(facts["findings"][0])


def test_the_offset_goes_into_a_copy_of_poses_too_where_raw_counts_stay_raw(cli, still, tmp_path, capsys) -> None:
    """The status is that of a drift, which is suspicious too and not corrected."""
    pitch_mm, time_s = still.geometry.pixel_size_mm[1], np.linspace(-1, 30, 400)
    wrong = stated(still, detector_offset_mm=(0.25, 3 * pitch_mm))
    wrong = replace(wrong, trajectory=PoseTable(time_s, wrong.geometry.pose(np.deg2rad(24 * time_s))))
    path, fixed = tmp_path / "scan.h5", tmp_path / "fixed.h5"
    light = np.concatenate([np.zeros((1, 32, 32)), still.projections - np.linspace(0, 0.05, 15)[:, None, None]])
    data, key = (60000 * np.exp(-light)).astype(np.uint16), np.r_[1, np.zeros(15, int)]
    write_scan(path, wrong, data=data, image_key=key, quantity="counts")
    before = path.read_bytes()
    assert cli.run(["check", str(path), "--fix-offset", "-o", str(fixed), "--json"]) == SUSPICIOUS_STATUS
    facts, held = json.loads(capsys.readouterr().out), []
    assert facts["suspicious"] == 2 and 0 < facts["offset_spread_mm"] < 0.1 * pitch_mm
    assert facts["offset_mm"] == pytest.approx(-3 * pitch_mm, abs=0.1 * pitch_mm)
    read_scan(fixed, lambda frames, keys, quantity, at: held.append((frames, quantity)) or (still.projections, None))
    assert held[0][1] == "counts" and np.array_equal(held[0][0], data) and path.read_bytes() == before
    copy, expected = load_scan(fixed), still.trajectory.pose(3, still.frame_start_s[3:4])
    offset_v_mm, offset_u_mm = copy.geometry.detector_offset_mm
    assert offset_v_mm == 0.25 and offset_u_mm == pytest.approx(3 * pitch_mm + facts["offset_mm"])
    for options in (["--fix-offset"], ["-o", str(fixed)], ["--fix-offset", "-o", str(path)]):
        assert cli.run(["check", str(path), *options]) == 2 and path.read_bytes() == before
    pose = copy.trajectory.pose(3, copy.frame_start_s[3:4])
    np.testing.assert_allclose(pose[:, 3:5], expected[:, 3:5], atol=0.15 * pitch_mm)


def test_pulsed_beams(rt, clean) -> None:
    scan = replace(clean, shutter=replace(clean.shutter, pulse_s=(0.5, 0.5)))
    finding = check_exposure(rt, scan)
    assert finding.verdict == CANNOT_TELL and "pulse" in finding.text and "pulse" in finding.advice
