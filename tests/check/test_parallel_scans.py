"""Parallel beams: half turns are complete, the axis comes from opposite views, no answer is about distances."""

from dataclasses import replace

import numpy as np
import pytest
from parallel_kit import SIDE, laminography_scan, parallel_scan

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.acquisition.altered.coarse import QUICK_COLUMNS, coarse
from phyradgs_cl.acquisition.altered.variants import mirrored, reversed_rotation, shifted, stretched, turned
from phyradgs_cl.check import CANNOT_TELL, CENTRE, OK, SUSPICIOUS, check
from phyradgs_cl.check.orbit import SIGN
from phyradgs_cl.check.shutter import EXPOSURE, READOUT
from phyradgs_cl.check.timing import check_angles
from phyradgs_cl.commands.check import check_command
from phyradgs_cl.io import write_scan
from phyradgs_cl.reconstructors.fits.axis import axis_shift, opposite_shift
from phyradgs_cl.workflow.files import load_scan

pytestmark = pytest.mark.slow

HALF_TURNS = [(30, 180.0, False), (31, 180.0, True), (60, 360.0, False), (45, 360.0, False), (40, 220.0, False)]
FOREIGN = ("distance", "fan", "cone", "source", "tilt")


def words_of(result) -> str:
    return " ".join(f"{one.question} {one.text} {one.advice}" for one in result.findings)


@pytest.mark.parametrize(("views", "turn_deg", "with_end"), HALF_TURNS)
def test_opposite_views_find_the_axis(views: int, turn_deg: float, with_end: bool) -> None:
    for pixels in (0.0, -1.5, 5.3):
        shift = opposite_shift(parallel_scan(views, turn_deg, pixels, with_end))
        assert abs(shift.pixels - pixels) < 0.05 and abs(shift.pixels - pixels) < 3 * shift.deviation < 0.1


def test_masked_pixels_do_not_move_the_axis_and_residuals_find_it_too(rt) -> None:
    scan = parallel_scan(true_offset_px=1.5)
    assert abs(axis_shift(rt, coarse(scan, QUICK_COLUMNS)).pixels - 1.5) < 0.1
    mask = np.zeros((SIDE, SIDE), bool)
    mask[:, 20] = mask[7] = True
    frames = np.where(mask, np.float32(9), scan.projections)
    shift = opposite_shift(replace(scan, projections=frames, pixel_mask=mask))
    assert abs(shift.pixels - 1.5) < 3 * shift.deviation < 0.2


def test_where_no_views_are_opposite_the_axis_is_open() -> None:
    unlike = [parallel_scan(views=30, turn_deg=150.0), laminography_scan()]
    unlike.append(parallel_scan(shutter=Shutter(0.01, 0.5, "columns")))
    assert not any(opposite_shift(scan).is_found for scan in unlike)


def test_half_a_turn_is_complete_and_less_is_not() -> None:
    for views, turn_deg, with_end in HALF_TURNS:
        assert check_angles(parallel_scan(views, turn_deg, 0.0, with_end)).verdict == OK
    short = check_angles(parallel_scan(30, 150.0))
    assert short.verdict == SUSPICIOUS and short.text == "views cover 150°; parallel rays need half a turn"
    full = parallel_scan(60, 360.0)
    quarters = replace(full, projections=full.projections[:30], frame_start_s=np.r_[0:15, 30:45].astype(float))
    assert "cover 90°" in check_angles(quarters).text  # 0° to 90° and 180° to 270° see the same
    lamino = laminography_scan()
    assert check_angles(lamino).verdict == OK
    half = replace(lamino, projections=lamino.projections[:15], frame_start_s=lamino.frame_start_s[:15])
    assert check_angles(half).text == "views cover 180°; parallel rays that rise need a full turn"


def test_a_right_scan_is_left_alone(rt) -> None:
    """Laminography knows its sense of rotation; a fly-scan is asked about its readout and exposure, which it cannot tell."""
    fly = parallel_scan(views=36, shutter=Shutter(0.05, 0.9))
    for scan, left_open in ((fly, {SIGN, READOUT, EXPOSURE}), (laminography_scan(), set())):
        result = check(scan, rt)
        asked = {one.question: one.verdict for one in result.findings}
        assert asked == {question: CANNOT_TELL if question in left_open else OK for question in asked} and SIGN in asked
        assert not any(word in words_of(result) for word in FOREIGN)
        if left_open:
            assert abs(result.offset_mm) < 3 * result.offset_spread_mm
            (readout,) = (one for one in result.findings if one.question == READOUT)
            assert "parallel beam" in readout.advice


def test_a_planted_offset_is_found_and_repaired(rt, tmp_path, capsys) -> None:
    write_scan(tmp_path / "scan.h5", parallel_scan(true_offset_px=1.5))
    assert check_command(tmp_path / "scan.h5", fix_offset=True, output=tmp_path / "fixed.h5") == 0
    assert f"suspicious   {CENTRE}" in capsys.readouterr().out
    fixed = load_scan(tmp_path / "fixed.h5")
    assert fixed.is_parallel and abs(fixed.geometry.detector_offset_mm[1] - 0.15) < 0.01
    again = opposite_shift(fixed)
    assert abs(again.pixels) < 0.1


def test_hypotheses_turn_directions_and_shift_none_of_them() -> None:
    scan = parallel_scan()
    angles = np.linspace(0.1, 0.2, scan.frames)
    variants = [
        reversed_rotation(scan), shifted(scan, 2.5), mirrored(scan, "u"), stretched(scan, 1.1, 0.9),
        turned(scan, angles),
    ]
    for variant in variants:
        poses = np.stack([variant.trajectory.pose(f, np.array(t)) for f, t in enumerate(variant.frame_start_s)])
        assert variant.is_parallel
        np.testing.assert_allclose(np.linalg.norm(poses[:, :3], axis=1), 1, rtol=1e-12)
        assert abs(np.einsum("fi,fi->f", poses[:, :3], poses[:, 6:9])).max() < 1e-12  # across the panel as before
