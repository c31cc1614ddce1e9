"""Geometries of all kinds: grids, panels at the axis, senses and jumps of angles, distances, warnings."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.acquisition import ConeGeometry, FrameSweeps, Protocol, Scan, Shutter
from phyradgs_cl.acquisition.geometry import ParallelGeometry, default_grid, pixel_centres
from phyradgs_cl.acquisition.trajectory import EncoderTable, unwrapped
from phyradgs_cl.api import fly_scan, load_scan, save_scan, static_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.assemble import Timing, turning

SHAPE, ANGLES = (12, 20), np.arange(0.0, 360.0, 12.0)
CONE = ConeGeometry(100.0, 150.0, SHAPE, (0.9, 0.6))


def scan_of(geometry, grid: Grid | None = None, frames: np.ndarray | None = None) -> Scan:
    frames = np.ones((len(ANGLES), *SHAPE)) if frames is None else frames
    return static_scan(frames, geometry, ANGLES, grid=grid)


def helix(travel_mm: float, height_mm: float = 0.0) -> np.ndarray:
    angle = np.deg2rad(ANGLES)
    poses = CONE.pose(angle)
    poses[:, [2, 5]] += (height_mm + travel_mm * angle / angle[-1])[:, None]
    return poses


@pytest.mark.parametrize("pitch_mm", [(0.9, 0.6), (0.2, 0.6), (0.6, 0.6)])
def test_voxels_of_the_default_grid_have_the_pitch_of_rows_and_of_columns(pitch_mm) -> None:
    for geometry in (replace(CONE, pixel_size_mm=pitch_mm), ParallelGeometry(SHAPE, pitch_mm)):
        grid, scale = default_grid(geometry), geometry.magnification
        np.testing.assert_allclose(grid.voxel_size_mm, [p / scale for p in (pitch_mm[0], pitch_mm[1], pitch_mm[1])])
        assert grid.size_mm[0] == pytest.approx(SHAPE[0] * pitch_mm[0] / scale, rel=0.1)
        assert grid.size_mm[2] == pytest.approx(SHAPE[1] * pitch_mm[1] / scale, rel=0.1)


def test_the_default_grid_of_a_helix_is_longer_by_its_travel() -> None:
    frames, alone = np.ones((len(ANGLES), *SHAPE)), default_grid(CONE)
    scan = Scan.from_poses(frames, helix(24.0, 5.0))
    (low, top), (alone_low, alone_top) = scan.grid.box_mm[0], alone.box_mm[0]
    assert low <= 5 + alone_low + FLOAT64 and top >= 29 + alone_top - FLOAT64
    assert top - low <= 24 + alone_top - alone_low + alone.voxel_size_mm[0] and scan.grid.shape[1:] == alone.shape[1:]
    assert Scan.from_poses(frames, helix(0.3)).grid.is_close(alone)  # half a voxel is no travel
    tilted = helix(0.0)
    tilted[:, 2] += 80.0
    tilted[:, 5] -= 40.0  # the source looks down on the axis, as in laminography
    assert abs(Scan.from_poses(frames, tilted).grid.offset_mm[0]) < 1


def test_a_panel_scaled_to_the_axis_has_the_rays_of_the_real_one(tmp_path) -> None:
    """And the geometry that poses of a circle tell, at any height, is that of the circle."""
    scaled = replace(CONE, source_to_detector_mm=100.0, pixel_size_mm=(0.6, 0.4), detector_offset_mm=(1.0, 2.0))
    poses = scaled.pose(np.deg2rad(ANGLES))
    scans, wobbling = [scan_of(scaled), Scan.from_poses(np.ones((len(ANGLES), *SHAPE)), poses)], poses.copy()
    wobbling[::2, :6] += np.tile([0.0, 0.0, 0.5], 2)
    raised = poses + np.where(np.isin(np.arange(12), [2, 5]), 40.0, 0.0)
    for told in (scans[1], Scan.from_poses(np.ones((len(ANGLES), *SHAPE)), raised)):
        for name, expected in asdict(scans[0].geometry).items():
            np.testing.assert_allclose(getattr(told.geometry, name), expected, atol=1e-10, err_msg=name)
    scans.append(Scan.from_poses(np.ones((len(ANGLES), *SHAPE)), wobbling))
    for scan, given in zip(scans, (poses, poses, wobbling), strict=True):
        assert scan.geometry.source_to_detector_mm > scan.geometry.source_to_axis_mm
        for frame in (0, 7):
            pose = scan.trajectory.pose(frame, scan.frame_start_s[frame])
            rays, expected = (pixel_centres(one, SHAPE) - one[:3] for one in (pose, given[frame]))
            np.testing.assert_allclose(np.cross(rays, expected), 0, atol=1e-9 * 100**2)
            assert (np.linalg.norm(rays, axis=-1) > 1.5 * np.linalg.norm(expected, axis=-1)).all()
    save_scan(tmp_path / "scan.h5", scans[0])
    assert load_scan(tmp_path / "scan.h5").geometry == scans[0].geometry


@pytest.mark.parametrize("sign", [1, -1])
def test_frames_sweep_as_the_gantry_turns_when_it_swings_back(sign, caplog) -> None:
    forth = 12.0 * np.arange(10)
    for back_deg in (9.0, 0.0, -3.0):  # the exposures back end where those forth begin, or elsewhere
        angles = sign * np.concatenate([forth, forth[::-1] + back_deg])
        scan = fly_scan(np.ones((20, *SHAPE)), CONE, angles, exposure_deg=9.0)
        sweeps = scan.trajectory.kinematics
        arc_deg = np.rad2deg(sweeps.angle_end_rad - sweeps.angle_start_rad)
        np.testing.assert_allclose(arc_deg, sign * np.repeat([9.0, -9.0], 10))
        assert "10 of 20 frames sweep against" in caplog.text
        caplog.clear()
    golden = (137.5 * np.arange(20)) % 360  # steps too large to have a sense
    sweeps = fly_scan(np.ones((20, *SHAPE)), CONE, golden, exposure_deg=9.0).trajectory.kinematics
    np.testing.assert_allclose(sweeps.angle_end_rad - sweeps.angle_start_rad, np.deg2rad(9.0))


@pytest.mark.parametrize("step_deg", [9.0, 222.5, 369.0, -137.0])
def test_angles_that_count_on_beyond_a_turn_are_as_they_say(step_deg) -> None:
    """Their steps were taken to be less than half a turn: 222.5° turned back by 137.5°."""
    said_deg = step_deg * np.arange(50)
    np.testing.assert_array_equal(unwrapped(said_deg, 360.0), said_deg)
    timing = Timing(Shutter(0.09), np.arange(50.0), True)
    orbit = turning(ConeGeometry(5.0, 7.0, (4, 4), 1.0), np.deg2rad(said_deg), timing)
    np.testing.assert_allclose(orbit.kinematics.angle_rad(3, np.array(3.09)), np.deg2rad(3.09 * step_deg))
    np.testing.assert_allclose(np.diff(unwrapped(9.0 * np.arange(50) % 360, 360.0)), 9.0)


def test_angles_that_jump_by_a_turn_are_put_together_again() -> None:
    time_s, angle_rad = np.linspace(0, 10, 101), np.linspace(0.1, 12.0, 101)
    table, between = EncoderTable(time_s, angle_rad % (2 * np.pi)), np.linspace(0, 10, 333)
    np.testing.assert_allclose(table.angle_rad(0, between), np.interp(between, time_s, angle_rad), atol=FLOAT64)
    two = EncoderTable(np.array([0.0, 10.0]), np.array([0.0, 2 * np.pi]))  # a whole turn between two samples
    assert two.angle_rad(0, np.array(5.0)) == pytest.approx(np.pi)
    start_deg = np.arange(0.0, 360.0, 9.0)
    sweeps = FrameSweeps(np.arange(40.0), 1.0, np.deg2rad(start_deg), np.deg2rad((start_deg + 9.0) % 360))
    np.testing.assert_allclose(sweeps.angle_end_rad - sweeps.angle_start_rad, np.deg2rad(9.0))
    wide = FrameSweeps(np.arange(2.0), 1.0, np.zeros(2), np.full(2, 4.0))  # long arcs are meant
    np.testing.assert_array_equal(wide.angle_end_rad, 4.0)


def test_sources_too_far_for_float32_are_refused_by_what_a_voxel_is() -> None:
    for unit in (1e-3, 1.0, 1e3):
        far = ConeGeometry(1e8 * unit, 1.5e8 * unit, SHAPE, (unit, unit))
        with pytest.raises(InputError, match="ParallelGeometry"):
            scan_of(far)
        scan_of(ConeGeometry(1e5 * unit, 1.5e5 * unit, SHAPE, (unit, unit)))


def test_warnings_of_places_that_no_view_sees(caplog) -> None:
    scan_of(CONE).warn_of_blind_places()
    scan_of(replace(CONE, detector_offset_mm=(0.0, 5.9))).warn_of_blind_places()
    assert not caplog.records
    scan_of(CONE, Grid((4, 8, 8), (0.6, 0.4, 0.4), (0.0, 30.0, 0.0))).warn_of_blind_places()
    assert "lies beside the field of view" in caplog.text and "a grid that fits" in caplog.text
    caplog.clear()
    scan_of(replace(CONE, detector_offset_mm=(0.0, 9.0))).warn_of_blind_places()
    assert "does not see the rotation axis" in caplog.text and "5.4 mm" in caplog.text
    caplog.clear()
    scan_of(CONE).warn_of_negative_integrals()
    assert not caplog.records
    scan_of(CONE, frames=-0.1 * np.ones((len(ANGLES), *SHAPE))).warn_of_negative_integrals()
    assert "is their sign wrong" in caplog.text


def test_logarithms_with_flats_of_ones_are_refused() -> None:
    frames = np.zeros((len(ANGLES), *SHAPE))
    frames[..., 5:15] = 0.8
    with pytest.raises(InputError, match="flats of ones"):
        static_scan(frames, CONE, ANGLES, flats=np.ones((1, *SHAPE)))
    transmitted = static_scan(np.exp(-frames), CONE, ANGLES, flats=np.ones((1, *SHAPE)), darks=np.zeros((1, *SHAPE)))
    np.testing.assert_allclose(transmitted.projections, frames, atol=1e-6)


def test_a_clockwise_gantry_is_the_mirror_of_the_other_and_two_turns_see_every_angle_twice() -> None:
    one, other = (Protocol(views=10, exposure_deg=14.0, start_deg=0.0, turns=turns) for turns in (1.0, -1.0))
    np.testing.assert_array_equal(one.frame_start_s(), other.frame_start_s())
    time_s = np.array([0.3, 0.9])
    for frame in (0, 4):
        angles = [p.orbit(CONE).kinematics.angle_rad(frame, p.frame_start_s()[frame] + time_s) for p in (one, other)]
        np.testing.assert_allclose(angles[0], -angles[1])
    twice = Protocol(views=8, exposure_deg=45.0, turns=2.0)
    np.testing.assert_allclose(np.rad2deg(twice.angle_start_rad()), np.arange(8) * 90.0)
    assert twice.window_s() == (0.0, pytest.approx(14.0 + 1.86))
    assert twice.at_rate(2.0).exposure_s == pytest.approx(0.25)
    for turns in (0.0, 1e-4, np.nan):
        with pytest.raises(InputError, match="--turns"):
            Protocol(turns=turns)
