"""Geometries that are no circle: RTK's tilts and offsets, and calibrated views of a real C-arm."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from conftest_of_importers import GEOMETRY, WORLD_POINTS, pose_at, projected
from writers_of_importers import AIR, write_phyradgs_real

from phyradgs_cl.acquisition import CircularOrbit, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

pytestmark = pytest.mark.slow
# Written by RTK 2.7: three projections, the third tilted about all axes with every offset in use.
DATA = Path(__file__).with_name("data")
RTK_FILE, RTK_PARALLEL = DATA / "rtk_tilted.xml", DATA / "rtk_parallel.xml"
SPACING, ORIGIN = (2.5, 3.0), (-14.0, -16.5)
FLY = ImportOptions(exposure_s=0.5, readout_s=0.25, frame_time_s=1.0)


@pytest.fixture
def rtk_folder(tmp_path) -> Path:
    shutil.copy(RTK_FILE, tmp_path / "geometry.xml")
    stack = sitk.GetImageFromArray(np.arange(3 * 10 * 14, dtype=np.float32).reshape(3, 10, 14) / 64)
    stack.SetSpacing((*SPACING, 1.0))
    stack.SetOrigin((*ORIGIN, 0.0))
    sitk.WriteImage(stack, str(tmp_path / "stack.mha"))
    return tmp_path


def rtk_pixels(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) (row, column) by RTK's own 3×4 matrix; its axes (X, Y, Z) are (y, z, x) here."""
    u, v, w = matrix @ np.concatenate([points[:, [1, 2, 0]], np.ones((len(points), 1))], 1).T
    return np.stack([(v / w - ORIGIN[1]) / SPACING[1], (u / w - ORIGIN[0]) / SPACING[0]], -1)


@pytest.mark.parametrize("file", [RTK_FILE, RTK_PARALLEL], ids=["cone", "parallel"])
def test_rtk_s_own_matrices_see_points_where_our_poses_do(rtk_folder, file) -> None:
    shutil.copy(file, rtk_folder / "geometry.xml")
    scan = import_scan(rtk_folder)
    assert isinstance(scan.trajectory, PoseTable) and not scan.is_fly and scan.is_parallel == (file == RTK_PARALLEL)
    texts = re.findall(r"<Matrix>(.*?)</Matrix>", file.read_text(), re.S)
    for frame, text in enumerate(texts):
        matrix = np.array(text.split(), float).reshape(3, 4)
        for share in (0.0, 0.5, 1.0):
            at = scan.frame_start_s[frame] + share * scan.shutter.middle_s
            pose, expected = scan.trajectory.pose(frame, np.array([at]))[0], rtk_pixels(matrix, WORLD_POINTS)
            np.testing.assert_allclose(projected(pose, WORLD_POINTS, scan.is_parallel), expected, atol=1e-6)
    np.testing.assert_array_equal(scan.projections[1, 2, :3], (140 + 28 + np.arange(3)) / 64)


def test_rtk_s_poses_move_through_the_frames(rtk_folder) -> None:
    """With times the poses of the file are met as each exposure starts, or in its middle; every window is covered."""
    still = import_scan(rtk_folder)
    shutil.copy(rtk_folder / "stack.mha", rtk_folder / "truth.mha")
    with pytest.raises(InputError, match="name the file itself"):
        import_scan(rtk_folder)
    np.testing.assert_array_equal(import_scan(rtk_folder / "stack.mha").projections, still.projections)
    (rtk_folder / "truth.mha").unlink()
    for options, after_s in ((FLY, 0.0), (replace(FLY, angle_at="middle"), 0.25)):
        fly = import_scan(rtk_folder, options)
        assert fly.is_fly
        for frame in range(3):
            stands = still.trajectory.pose(frame, still.frame_start_s[frame : frame + 1])
            passes = fly.trajectory.pose(frame, fly.frame_start_s[frame : frame + 1] + after_s)
            np.testing.assert_allclose(passes, stands, atol=1e-6)


REAL = ImportOptions(exposure_s=0.4, pixel_size_mm=GEOMETRY.pixel_size_mm, flat_value=AIR)
REAL_GEOMETRY = replace(GEOMETRY, detector_offset_mm=(4.0, 0.0))


@pytest.fixture
def real_truth(make_truth):
    """The first stored row, at the top, is read first: our last."""
    return make_truth(fly=True, axis="rows", direction=-1, geometry=REAL_GEOMETRY)


def test_phyradgs_real(tmp_path, real_truth, assert_same, caplog) -> None:
    path = write_phyradgs_real(tmp_path / "real", real_truth)
    assert recognise(path) == "phyradgs-real"
    scan = import_scan(path, REAL)
    # counts of 16 bits: half a count of 50,000 · exp(−1.5) is 5e-5
    assert_same(scan, real_truth, grid=False, pixels=1e-4)
    assert "counts without flats" not in caplog.text
    brightest = import_scan(path, replace(REAL, flat_value=None))
    assert "counts without flats: the brightest pixel, 50000 counts, is taken as air; else say flat_value" in caplog.text
    np.testing.assert_allclose(brightest.projections, scan.projections, atol=1e-4)


def test_one_scan_of_several_in_a_file(tmp_path, real_truth, assert_same) -> None:
    path = write_phyradgs_real(tmp_path / "real", real_truth)
    file = path / "geometric_motion_rs.json"
    meta = json.loads(file.read_text())
    meta["views"] = meta["views"][::-1] + meta["views"]
    file.write_text(json.dumps(meta))
    with pytest.raises(InputError, match="say first_view"):
        import_scan(path, REAL)
    assert_same(import_scan(path, replace(REAL, first_view=6)), real_truth, grid=False, pixels=1e-4)


def test_circles_beside_the_axis(tmp_path, real_truth) -> None:
    """Everything moved by one vector sees a point that moved along where it was."""
    scan = import_scan(write_phyradgs_real(tmp_path / "real", real_truth, centre_mm=(3.0, -2.0)), REAL)
    assert not isinstance(scan.trajectory, CircularOrbit)
    for frame in range(scan.frames):
        for share in (0.0, 0.4, 1.0):
            there = projected(pose_at(scan, frame, share), WORLD_POINTS + [3.0, -2.0, 0.0])
            native = pose_at(real_truth.scan, frame, share)
            np.testing.assert_allclose(there, projected(native, WORLD_POINTS), atol=1e-4)


def test_windows_that_overlap_are_moved_apart(tmp_path, real_truth) -> None:
    sweeps = real_truth.scan.trajectory.kinematics
    orbit = CircularOrbit(REAL_GEOMETRY, replace(sweeps, angle_end_rad=sweeps.angle_start_rad + np.deg2rad(24)))
    wide_truth = replace(real_truth, scan=replace(real_truth.scan, trajectory=orbit))
    scan = import_scan(write_phyradgs_real(tmp_path / "real", wide_truth), REAL)
    assert np.diff(scan.frame_start_s).min() > scan.shutter.span_s
    pose, end_rad = pose_at(scan, 3, 1.0), sweeps.angle_start_rad[3] + np.deg2rad(24) * (1 + 0.3 / 0.4)
    native = REAL_GEOMETRY.pose(end_rad)
    np.testing.assert_allclose(projected(pose, WORLD_POINTS), projected(native, WORLD_POINTS), atol=1e-5)
