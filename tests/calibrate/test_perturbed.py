"""Changed scans: what a change means, by two routes; and what a copy of a file holds of it."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, PerRow, pixel_centres
from phyradgs_cl.acquisition.altered.perturbed import (
    GeometryCorrection,
    PerturbedTrajectory,
    Sway,
    Views,
    perturb,
)
from phyradgs_cl.io import write_scan
from phyradgs_cl.io.scan.writer import copy_with_motion
from phyradgs_cl.workflow import load_scan

NUMBERS = GeometryCorrection(offset_u_mm=0.3, offset_v_mm=-0.2, source_distance_mm=0.1, detector_distance_mm=-0.4)
TURNS = GeometryCorrection(roll_rad=0.02, tilt_v_rad=-0.03, tilt_u_rad=0.01)
TIMES = GeometryCorrection(readout_s=0.1, exposure_s=-0.2)

TIMED = {"count_time", "detector_readout_time", "rotation_angle_end"}


def poses(scan):
    return np.concatenate([PerRow(3).cells(scan, frame).pose for frame in range(scan.frames)])


def test_numbers_of_the_geometry_move_poses_as_that_does_and_a_lift_raises_source_and_panel(right) -> None:
    by_geometry = perturb(right, NUMBERS)
    assert isinstance(by_geometry.trajectory, CircularOrbit)
    by_poses = replace(right, trajectory=PerturbedTrajectory(right.trajectory, right.geometry.detector_shape, NUMBERS))
    np.testing.assert_allclose(poses(by_poses), poses(by_geometry), atol=1e-12)
    expected = poses(right) + np.array([0, 0, 0.3, 0, 0, 0.3, *[0] * 6])
    np.testing.assert_allclose(poses(perturb(right, GeometryCorrection(lift_mm=0.3))), expected, atol=1e-12)


def test_turns_leave_the_middle_of_the_panel_where_it_is(right) -> None:
    stated, turned = (pixel_centres(poses(scan)[:1], (32, 32))[0] for scan in (right, perturb(right, TURNS)))
    np.testing.assert_allclose(turned.mean((0, 1)), stated.mean((0, 1)), atol=1e-12)
    for along, change in enumerate((GeometryCorrection(tilt_v_rad=0.1), GeometryCorrection(tilt_u_rad=0.1))):
        shift = pixel_centres(poses(perturb(right, change))[:1], (32, 32))[0] - stated
        assert np.allclose(np.diff(shift, axis=along), 0), change  # along the axis of the tilt it moves as one
        assert np.abs(shift).max() > 0.1, change
    np.testing.assert_allclose(np.linalg.norm(turned[0, 1] - turned[0, 0]), 0.125)


def test_views_move_by_themselves(right) -> None:
    views = Views(np.zeros(11), np.zeros((11, 2)))
    views.turn_rad[3], views.shift_mm[5] = 0.01, (0.2, 0.0)
    after, time_s = perturb(right, GeometryCorrection(), views), np.array([1.0])
    is_off = [not np.allclose(after.trajectory.pose(f, time_s), right.trajectory.pose(f, time_s)) for f in range(11)]
    assert np.flatnonzero(is_off).tolist() == [3, 5]
    shift = (after.trajectory.pose(5, time_s) - right.trajectory.pose(5, time_s))[0]
    np.testing.assert_allclose(shift[3:6], [0, 0, 0.2], atol=1e-12)


def test_an_object_that_moves_sees_source_and_panel_move_the_other_way(right) -> None:
    """Rays meet the object where they would have met it at rest."""
    rng = np.random.default_rng(0)
    sway = replace(Sway.none(right, 5), coefficients=0.1 * rng.normal(size=(5, 6)))
    path = perturb(right, GeometryCorrection(), sway).trajectory
    time_s = right.frame_start_s[0] + np.array([0.0, 0.3, 5.0])
    stated, seen = (trajectory.pose(0, time_s).reshape(3, 4, 3) for trajectory in (right.trajectory, path))
    for at, before, after in zip(sway.at(time_s), stated, seen, strict=True):
        turn = Rotation.from_rotvec(at[:3]).as_matrix()
        np.testing.assert_allclose(after[:2] @ turn.T + at[3:], before[:2], atol=1e-12)
        np.testing.assert_allclose(after[2:] @ turn.T, before[2:], atol=1e-12)
    np.testing.assert_allclose(sway.basis(np.linspace(-9, 99, 7)).sum(-1), 1)


def datasets(path) -> dict[str, object]:
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


@pytest.mark.parametrize(("change", "touched"), [
    (NUMBERS, {"detector_offset", "detector/distance", "source/distance"}), (TURNS, {"poses/pose", "poses/time_s"}),
    (TIMES, TIMED), (replace(TIMES, offset_u_mm=0.3), TIMED | {"detector_offset"}),
])  # fmt: skip
def test_a_copy_says_what_was_changed_and_nothing_else(right, tmp_path, change, touched) -> None:
    path, copy = tmp_path / "scan.h5", tmp_path / "copy.h5"
    counts = np.random.default_rng(0).integers(1, 60000, (13, 32, 32)).astype(np.uint16)
    write_scan(path, right, data=counts, image_key=[1, 2, *[0] * 11], quantity="counts")
    stated = load_scan(path)
    changed = perturb(stated, change)
    copy_with_motion(path, copy, replace(changed, provenance={"why": "a test"}))
    read = load_scan(copy)
    np.testing.assert_allclose(poses(read), poses(changed), atol=1e-5)
    assert read.provenance == {"why": "a test", "flats_applied": 1, "darks_applied": 1} and read.is_fly
    before, after = datasets(path), datasets(copy)
    differ = {name for name in after if name not in before or not np.array_equal(before[name], after[name])}
    ends = {name for name in differ if name.endswith(tuple(touched))}
    assert differ - ends == {"entry/phyradgs/provenance"} and len(ends) == len(touched)


def test_encoder_standing_gantry_and_views_are_copied_too(right, tmp_path) -> None:
    path, copy = tmp_path / "scan.h5", tmp_path / "copy.h5"
    table = EncoderTable(np.array([-1.0, 50.0]), np.array([0.0, 7.0]))
    encoded = replace(right, trajectory=CircularOrbit(right.geometry, table))
    views = Views(0.01 * np.arange(11), 0.1 * np.arange(22).reshape(11, 2))
    for scan, change, off in ((encoded, TIMES, None), (replace(right, is_fly=False), TURNS, None), (right, TURNS, views)):
        write_scan(path, scan)
        changed = perturb(load_scan(path), change, off)
        copy_with_motion(path, copy, changed)
        read = load_scan(copy)
        np.testing.assert_allclose(poses(read), poses(changed), atol=1e-5)
        assert read.is_fly == scan.is_fly
