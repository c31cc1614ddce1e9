"""Parallel beams: offset and roll by the same projection, no distance or tilt, beads in closed form."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from parallel_kit import BODIES, GRID, SIDE, laminography_scan, line_integrals, parallel_scan

from phyradgs_cl.acquisition import ConeGeometry, Shutter, pixel_centres
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, perturb
from phyradgs_cl.api import static_scan
from phyradgs_cl.calibrate import AGREES, CANNOT_TELL, CORRECTED, calibrate
from phyradgs_cl.calibrate.beads import BeadProblem
from phyradgs_cl.calibrate.parameters import requested
from phyradgs_cl.calibrate.problem import Stage
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import write_scan
from phyradgs_cl.io.scan.writer import copy_with_motion
from phyradgs_cl.workflow.files import load_scan

pytestmark = pytest.mark.slow


def poses_of(scan):
    return np.stack([scan.trajectory.pose(f, np.array(t)) for f, t in enumerate(scan.frame_start_s)])


def seen_by(poses):
    """The frames of the bodies that poses see."""
    return np.stack([line_integrals(BODIES, pose, (SIDE, SIDE)) for pose in poses]).astype(np.float32)


def test_directions_turn_and_never_shift() -> None:
    scan = parallel_scan()
    correction = GeometryCorrection(offset_u_mm=0.2, offset_v_mm=-0.1, roll_rad=0.1, turn_rad=0.3)
    views = Views(np.linspace(0.0, 0.1, scan.frames), np.full((scan.frames, 2), 0.7))
    sway = replace(Sway.none(scan, 7), coefficients=np.random.default_rng(1).normal(0, 0.3, (7, 6)))
    for changed in (perturb(scan, correction), perturb(scan, correction, views), perturb(scan, correction, sway)):
        assert changed.is_parallel
        poses = poses_of(changed)
        np.testing.assert_allclose(np.linalg.norm(poses[:, :3], axis=1), 1, rtol=1e-12)
        np.testing.assert_allclose(np.einsum("fi,fi->f", poses[:, :3], poses[:, 6:9]), 0, atol=1e-12)
    moved = perturb(scan, GeometryCorrection(), replace(sway, coefficients=np.tile([0, 0, 0, 0.2, -0.1, 0.3], (7, 1))))
    before, after = (one.trajectory.pose(3, np.array(3.0)) for one in (scan, moved))
    np.testing.assert_allclose(after - before, [0, 0, 0, -0.2, 0.1, -0.3, *[0] * 6], atol=1e-12)


def test_tilts_and_distances_are_refused_and_not_asked_for() -> None:
    scan, fly = parallel_scan(), parallel_scan(shutter=Shutter(0.1, 0.5))
    assert requested(None, scan, knows_shape=True).names == ["offset-u", "offset-v", "roll"]
    assert requested(None, fly).names == ["offset-u", "offset-v", "roll", "readout", "exposure"]
    for word, name in (("tilt", "tilt-v"), ("distance", "source-distance"), ("detector-distance",) * 2):
        with pytest.raises(InputError, match=f"{name} of a parallel beam"):
            requested(f"roll,{word}", scan)


def test_an_offset_and_a_roll_are_found_in_half_a_turn_and_a_right_scan_is_left_alone(rt) -> None:
    scan = parallel_scan(30, 180.0, 1.5)
    rolled = perturb(scan, GeometryCorrection(offset_u_mm=0.15, roll_rad=np.deg2rad(1.5)))
    result = calibrate(replace(scan, projections=seen_by(poses_of(rolled))), rt)
    found = {one.name: one for one in result.parameters}
    assert found["offset-u"].verdict == CORRECTED and abs(found["offset-u"].found - 0.15) < 0.01
    assert found["roll"].verdict == CORRECTED and abs(found["roll"].found - 1.5) < 0.2
    assert found["offset-v"].verdict == CANNOT_TELL  # an object further along the axis
    assert result.residual_rms[1] < 0.5 * result.residual_rms[0]
    right = calibrate(parallel_scan(), rt)
    assert right.corrected == [] and right.parameters[0].verdict == AGREES


@pytest.mark.parametrize(
    ("so_mm", "turn_deg", "off_mm", "roll_deg"), [(0, 360, 0.15, -0.9), (0, 180, -0.1, 1.2), (60, 360, 0.15, -0.9)]
)
def test_the_roll_of_sharp_edges_is_whole_in_rays_that_stay_in_a_slice(rt, so_mm, turn_deg, off_mm, roll_deg) -> None:
    """Single pixels, whose errors at edges took a tenth to a quarter of the roll; in half a turn all of it."""
    scan = parallel_scan(40, turn_deg)
    if so_mm:
        cone, angles_deg = ConeGeometry(so_mm, 1.4 * so_mm, (SIDE, SIDE), (0.14, 0.14)), 17 + 9.0 * np.arange(40)
        scan = static_scan(np.zeros_like(scan.projections), cone, angles_deg, grid=GRID)
    poses = poses_of(perturb(scan, GeometryCorrection(offset_u_mm=off_mm, roll_rad=np.deg2rad(roll_deg))))
    frames = seen_by(poses)
    if so_mm:
        frames = BODIES.line_integrals(poses[:, None, None, :3], pixel_centres(poses, (SIDE, SIDE)))
    noisy = frames + np.random.default_rng(2).normal(0, 0.003, frames.shape)
    offset, roll = calibrate(replace(scan, projections=noisy.astype(np.float32)), rt, "offset-u,roll").parameters
    assert offset.verdict == roll.verdict == CORRECTED
    assert abs(offset.found - off_mm) < min(2 * offset.deviation, 0.002)
    assert abs(roll.found - roll_deg) < min(2 * roll.deviation, 0.045 if turn_deg == 360 else 0.15)


def test_frames_of_beads_are_the_closed_form() -> None:
    """Rays across the axis, and rays that rise, averaged over points of a pixel."""
    place = [0.0, 0.0, 0.2, 0.1, -0.05, 0.02]
    for scan in (parallel_scan(8), laminography_scan(8)):
        operator = BeadProblem.of(BODIES, np.zeros(7), [scan], Stage(SIDE, 8, 4), 8).operator(GeometryCorrection())
        moved = perturb(scan, GeometryCorrection(), replace(Sway.none(scan, 7), coefficients=np.tile(place, (7, 1))))
        offsets = (np.arange(operator.samples) + 0.5) / operator.samples - 0.5
        expected = np.zeros(scan.projections.shape)
        for v, u in itertools.product(offsets, offsets):
            points = poses_of(moved)
            points[:, 3:6] += u * points[:, 6:9] + v * points[:, 9:12]
            expected += seen_by(points) / len(offsets) ** 2
        np.testing.assert_allclose(operator.forward(np.array([*place, 1.0])), expected, rtol=0, atol=1e-5)


def test_a_corrected_scan_is_stored_as_a_parallel_beam(tmp_path) -> None:
    scan = parallel_scan(8)
    write_scan(tmp_path / "scan.h5", scan)
    for correction in (GeometryCorrection(offset_u_mm=0.1), GeometryCorrection(offset_u_mm=0.1, roll_rad=0.05)):
        corrected = perturb(scan, correction)
        copy_with_motion(tmp_path / "scan.h5", tmp_path / "copy.h5", corrected)
        stored = load_scan(tmp_path / "copy.h5")
        assert stored.is_parallel and stored.geometry.detector_offset_mm[1] == pytest.approx(0.1)
        poses = [one.trajectory.pose(3, scan.frame_start_s[3:4]) for one in (corrected, stored)]
        np.testing.assert_allclose(poses[1], poses[0], atol=1e-9)
