"""Fly-scans summed from dense scans."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, PoseTable, Scan
from phyradgs_cl.api import PerRow, Static, ray_operator, simulate, static_scan, sum_frames

CONE = ConeGeometry(5.0, 7.0, (3, 4), (0.5, 0.5))
ARC_DEG = 1.0  # between projections


def dense(frames: int = 12, **others) -> Scan:
    """Projections that hold their number in every pixel, as intensities."""
    values = np.broadcast_to(-np.log(np.arange(1.0, frames + 1) / 20)[:, None, None], (frames, 3, 4))
    return static_scan(values.astype(np.float32), CONE, 10 + ARC_DEG * np.arange(frames), **others)


def intensities(scan: Scan) -> np.ndarray:
    return 20 * np.exp(-scan.projections)


@pytest.mark.parametrize("readout, direction", [("rows", 1), ("rows", -1), ("columns", 1), ("columns", -1)])
def test_lines_open_one_after_the_other(readout, direction) -> None:
    summed = sum_frames(dense(), 4, 0.75, readout, direction)
    assert summed.frames == 2 and summed.detector_model == "intensity" and summed.is_fly  # a third would end behind the last
    lines = 3 if readout == "rows" else 4
    delay = 3 * np.arange(lines)[::direction] / (lines - 1)
    # intensities rise evenly: a line that opens later by d projections sees d more
    expected = 2.5 + delay
    of_pixels = np.broadcast_to(expected[:, None] if readout == "rows" else expected, (3, 4))
    np.testing.assert_allclose(intensities(summed)[0], of_pixels, rtol=1e-5)


def test_a_pixel_is_masked_where_a_projection_in_its_exposure_is() -> None:
    mask = np.zeros((12, 3, 4), bool)
    mask[4, 0, 0] = mask[7, 2, 1] = True
    masked = ~sum_frames(dense(mask=mask), 4, 0.5).valid
    assert masked[0].nonzero()[0].tolist() == [] and masked[1, 0, 0] and masked[1, 2, 1]
    assert masked[0, 2, 1] == (7 < 4 + 2) and masked.sum() == 2


def test_poses_of_no_circle_lose_a_projection_at_either_end() -> None:
    scan, orbit = dense(), dense().trajectory
    middle_s = scan.frame_start_s
    poses = np.concatenate([orbit.pose(f, np.array([t])) for f, t in enumerate(middle_s)])
    poses[:, 5] += 0.01 * np.arange(12)
    summed = sum_frames(replace(scan, trajectory=PoseTable(middle_s, poses)), 5)
    np.testing.assert_allclose(intensities(summed)[:, 0, 0], [4, 9], rtol=1e-5)
    middle = summed.trajectory.pose(0, summed.frame_start_s[:1] + summed.shutter.middle_s)
    np.testing.assert_allclose(middle[0], poses[3], atol=1e-6)


def test_images_of_the_rim_are_told_from_a_smear(caplog) -> None:
    sum_frames(dense(), 4)
    assert not caplog.records
    wide = replace(CONE, detector_shape=(3, 200), pixel_size_mm=(0.01, 0.01))
    sum_frames(static_scan(np.ones((12, 3, 200), np.float32), wide, np.arange(12.0)), 4)
    assert "1.75 pixels" in caplog.text


@pytest.mark.parametrize("readout_ratio", [0.0, 0.5])
def test_a_sum_is_what_the_known_motion_projects(readout_ratio) -> None:
    """The poses of 8 times in an exposure are those of the 8 projections."""
    scan = simulate("foot", protocol="static", views=48, size=12, detector=12, detector_model="intensity")
    at_rest = ray_operator(scan, "static")
    summed = sum_frames(replace(scan, projections=at_rest(scan.reference)), 8, readout_ratio)
    errors = {}
    for motion in (PerRow(8), Static()):
        difference = ray_operator(summed, motion).intensity(scan.reference) - summed.projections
        errors[motion] = np.linalg.norm(difference) / np.linalg.norm(summed.projections)
    assert errors[PerRow(8)] < 2e-6 and errors[Static()] > 0.02
