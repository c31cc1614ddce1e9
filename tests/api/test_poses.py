"""Gradients by the poses of single views: against differences of moved views, and volumes against clouds."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from phyradgs_cl import api
from phyradgs_cl.api import Exact, MicroViews, move_views, pose_gradient, ray_operator, splat_operator
from phyradgs_cl.io.scan.motion import overlaps
from phyradgs_cl.io.scan.writer import copy_with_motion

pytestmark = pytest.mark.slow
FINE = Exact(time_error=1e-4)
STEPS = (1e-3, 1e-2, 1e-2)  # rad, mm, mm


def weights(scan) -> np.ndarray:
    return gaussian_filter(np.random.default_rng(5).normal(size=scan.projections.shape), (0, 2, 2)).astype(np.float32)


def differences(scan, frames_of, by_frames) -> np.ndarray:
    """dL/dviews (F, 3) of L = Σ frames by_frames."""
    found = np.zeros((scan.frames, 3))
    for kind, step in enumerate(STEPS):
        for sign in (1, -1):
            views = np.zeros((scan.frames, 3))
            views[:, kind] = sign * step
            frames = frames_of(move_views(scan, views)).astype(np.float64)
            found[:, kind] += sign / (2 * step) * np.einsum("fvu,fvu->f", frames, by_frames)
    return found


def assert_close(found, expected, share) -> None:
    assert np.all(np.abs(found - expected) < share * np.abs(expected).max(0)), (found, expected)


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("options", [{"motion": FINE}, {"motion": MicroViews(4, 3)}, {"motion": "static", "affine": True}])
def test_a_clouds_gradient_is_that_of_moved_views(rt, request, cloud, axis, options) -> None:
    scan = request.getfixturevalue("scan" if axis == "rows" else "columns_scan")
    by_frames, pitch_mm = weights(scan), scan.geometry.pixel_size_mm

    def operator(of):
        return splat_operator(of, cutoff_sigma=0, device=rt, **options)

    found = operator(scan).by_poses(cloud, by_frames) / np.array([1.0, *pitch_mm])
    assert_close(found, differences(scan, lambda of: operator(of)(cloud), by_frames), 2e-3)
    some = operator(scan).frames([4, 1]).by_poses(cloud, by_frames[[4, 1]]) / np.array([1.0, *pitch_mm])
    assert np.allclose(some, found[[4, 1]], rtol=1e-6)


def test_a_volumes_gradient_is_that_of_moved_views(rt, scan) -> None:
    by_frames, volume = weights(scan), gaussian_filter(scan.reference, 1)
    found = pose_gradient(scan, volume, by_frames, "per-row", device=rt)
    assert_close(found, differences(scan, lambda of: ray_operator(of, "per-row", device=rt)(volume), by_frames), 0.1)


def test_gauges_are_left_out(scan) -> None:
    views = np.zeros((scan.frames, 3))
    views[:, 0] = 0.1
    scans = move_views(scan, views), move_views(scan, views, without_gauges=True), scan
    moved, kept, same = (one.trajectory.pose(0, np.zeros(1)) for one in scans)
    assert not np.allclose(moved, same) and np.allclose(kept, same)


@pytest.mark.parametrize(("first_s", "step_s", "readout_ratio", "is_fly"), [
    (0.0, 1.0, 0.0, True), (0.0, 0.1, 0.5, True), (1.7e9, 0.3, 0.0, True), (0.0, 1.0, 0.0, False),
])
def test_moved_frames_that_touch_in_time_are_saved(rt, tmp_path, first_s, step_s, readout_ratio, is_fly) -> None:
    """Poses jump from one frame to the next, and the file keeps a pose for every time."""
    cone, reference = api.ConeGeometry(5.0, 7.0, (12, 12), 0.3), np.random.default_rng(4).uniform(size=(6, 6, 6))
    frames, exposure_s = np.zeros((8, 12, 12)), step_s / (1 + readout_ratio)
    arc_deg = 45.0 * exposure_s / step_s
    how = {"exposure_deg": arc_deg, "exposure_s": exposure_s, "readout_ratio": readout_ratio, "grid": api.Grid.cube(6, 2.0)}
    touching = api.fly_scan(frames, cone, 45.0 * np.arange(8), **how)
    start_s = first_s + touching.frame_start_s
    speed = api.ConstantSpeed(-first_s * np.deg2rad(45.0) / step_s, np.deg2rad(45.0) / step_s)
    gating, orbit = api.Gating(start_s + touching.shutter.middle_s, np.arange(8.0)), api.CircularOrbit(cone, speed)
    scan = replace(touching, frame_start_s=start_s, trajectory=orbit, is_fly=is_fly, gating=gating)
    moved = move_views(scan, np.random.default_rng(0).normal(size=(8, 3)) * [0.02, 0.3, 0.3])
    assert not overlaps(moved)
    gaussian = api.Gaussians(np.array([[0.3, 0.1, 0.2]]), np.full((1, 3), 0.3), np.eye(1, 4), np.ones(1))
    operators = [(partial(ray_operator, motion=motion), reference) for motion in ("static", "per-row", "micro-views")]
    operators += [(splat_operator, gaussian)] if is_fly else []  # elsewhere ``exact`` follows an exposure at rest
    api.save_scan(tmp_path / "scan.h5", scan)
    api.save_scan(tmp_path / "moved.h5", moved)
    copy_with_motion(tmp_path / "scan.h5", tmp_path / "copy.h5", moved)
    for name in ("moved.h5", "copy.h5"):
        stored = api.load_scan(tmp_path / name)
        assert stored.is_fly == is_fly and np.array_equal(stored.frame_start_s, moved.frame_start_s)
        assert not is_fly or stored.shutter.exposure_s == pytest.approx(exposure_s, rel=1e-4)
        np.testing.assert_allclose(stored.gating.at(stored.middle_times_s), gating.values, atol=1e-4)
        for operator, x in operators:
            ours, theirs = (operator(one, device=rt)(x) for one in (moved, stored))
            np.testing.assert_allclose(theirs, ours, rtol=0, atol=2e-4 * ours.max(), err_msg=f"{name} {operator}")


def test_a_file_with_one_pose_at_a_time_says_so(rt, tmp_path) -> None:
    scan = api.simulate("jaw", size=8, detector=12, views=6, exposure_deg=60.0, device=rt)
    assert scan.shutter.span_s > np.diff(scan.frame_start_s).min() and overlaps(scan)
    views = np.random.default_rng(3).normal(size=(scan.frames, 3))
    with pytest.raises(api.InputError, match="do not overlap in time"):
        api.save_scan(tmp_path / "scan.h5", move_views(scan, views))
    assert not list(tmp_path.iterdir())
