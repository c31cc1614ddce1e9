"""Gradients by the poses of single views: against differences of moved views, and volumes against clouds."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from phyradgs_cl import api
from phyradgs_cl.api import Exact, MicroViews, move_views, pose_gradient, ray_operator, splat_operator
from phyradgs_cl.fields import GridChoice

pytestmark = pytest.mark.slow
FINE = Exact(time_error=1e-4)
STEPS = (1e-3, 1e-2, 1e-2)  # rad, mm, mm


def weights(scan) -> np.ndarray:
    noise = np.random.default_rng(5).normal(size=scan.projections.shape)
    return gaussian_filter(noise, (0, 2, 2)).astype(np.float32)


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
@pytest.mark.parametrize(
    "options", [{"motion": FINE}, {"motion": MicroViews(4, 3)}, {"motion": "static", "affine": True}]
)
def test_a_clouds_gradient_is_that_of_moved_views(rt, request, cloud, axis, options) -> None:
    scan = request.getfixturevalue("scan" if axis == "rows" else "columns_scan")
    by_frames, pitch_mm = weights(scan), scan.geometry.pixel_size_mm

    def operator(of):
        return splat_operator(of, cutoff_sigma=0, device=rt, **options)

    found = operator(scan).by_poses(cloud, by_frames) / np.array([1.0, *pitch_mm])
    assert_close(found, differences(scan, lambda of: operator(of)(cloud), by_frames), 2e-3)
    some = operator(scan).frames([4, 1]).by_poses(cloud, by_frames[[4, 1]]) / np.array([1.0, *pitch_mm])
    assert np.allclose(some, found[[4, 1]], rtol=1e-6)


def test_volumes_and_clouds_meet(rt, scan, cloud) -> None:
    """A cloud and its voxels, on a grid that is finer than it: the same object by two ways."""
    by_frames, fine = weights(scan), scan.with_grid(GridChoice(size=30))
    of_cloud = pose_gradient(fine, cloud, by_frames, device=rt)
    of_voxels = pose_gradient(fine, api.voxelise(cloud, fine.grid, device=rt), by_frames, device=rt)
    assert_close(of_voxels, of_cloud, 0.05)


def test_a_volumes_gradient_is_that_of_moved_views(rt, scan) -> None:
    by_frames, volume = weights(scan), gaussian_filter(scan.reference, 1)
    found = pose_gradient(scan, volume, by_frames, "per-row", device=rt)
    expected = differences(scan, lambda of: ray_operator(of, "per-row", device=rt)(volume), by_frames)
    assert_close(found, expected, 0.1)


def test_gauges_are_left_out(scan) -> None:
    views = np.zeros((scan.frames, 3))
    views[:, 0] = 0.1
    moved, kept, same = (s.trajectory.pose(0, np.zeros(1)) for s in (
        move_views(scan, views), move_views(scan, views, without_gauges=True), scan,
    ))  # fmt: skip
    assert not np.allclose(moved, same) and np.allclose(kept, same)


def test_a_file_with_one_pose_at_a_time_says_so(rt, tmp_path) -> None:
    scan = api.simulate("jaw", size=8, detector=12, views=6, exposure_deg=60.0, device=rt)
    assert scan.shutter.span_s > np.diff(scan.frame_start_s).min()
    views = np.random.default_rng(3).normal(size=(scan.frames, 3))
    with pytest.raises(api.InputError, match="do not overlap in time"):
        api.save_scan(tmp_path / "scan.h5", move_views(scan, views))
    assert not list(tmp_path.iterdir())
