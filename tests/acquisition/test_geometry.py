"""Positions of source, detector and pixels, by hand; the field of view; a scan's grid replaced."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from phyradgs_cl.acquisition import (
    ConeGeometry,
    ParallelGeometry,
    Scan,
    Shutter,
    pixel_centres,
    transpose_pose,
)
from phyradgs_cl.acquisition.geometry import cuts, default_grid, field_of_view_mm, hidden, misses
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, GridChoice

TOLERANCE_MM = 1e-10  # rounding of float64 at 1200 mm
GEOMETRY = ConeGeometry(785.0, 1200.0, (7, 10), (0.6, 0.5), (1.25, -2.5))
ANGLES_RAD = [0.0, 0.3, math.pi / 2, 2.0, -1.1, 7.0]


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_source_and_pixel_centres_by_hand(angle_rad) -> None:
    pose, cos, sin = GEOMETRY.pose(angle_rad), math.cos(angle_rad), math.sin(angle_rad)
    np.testing.assert_allclose(pose[:3], [785 * cos, 785 * sin, 0], atol=TOLERANCE_MM)
    centres = pixel_centres(pose, GEOMETRY.detector_shape)
    assert centres.shape == (7, 10, 3)
    for row, column in [(0, 0), (6, 9), (2, 7)]:
        along_u_mm, along_v_mm = -2.5 + (column - 4.5) * 0.5, 1.25 + (row - 3.0) * 0.6
        expected = [-415 * cos - along_u_mm * sin, -415 * sin + along_u_mm * cos, along_v_mm]
        np.testing.assert_allclose(centres[row, column], expected, atol=TOLERANCE_MM)


def test_scaled_and_transposed_poses() -> None:
    np.testing.assert_allclose(GEOMETRY.scaled(0.01).pose(0.7), 0.01 * GEOMETRY.pose(0.7), atol=1e-14)
    assert GEOMETRY.scaled(0.01).magnification == pytest.approx(1200 / 785)
    pose = GEOMETRY.pose(0.7)
    turned = pixel_centres(transpose_pose(pose), (10, 7))
    np.testing.assert_allclose(turned, pixel_centres(pose, (7, 10)).swapaxes(0, 1), atol=TOLERANCE_MM)
    np.testing.assert_array_equal(transpose_pose(transpose_pose(pose)), pose)


WIDE = ConeGeometry(400.0, 800.0, (20, 30), (2.0, 40.0))  # half width 600: sin = 3/5
WIDE_GRID = Grid.cube(10, 400.0)


@pytest.fixture
def scan() -> Scan:
    reference = np.arange(1000, dtype=np.float32).reshape(10, 10, 10)
    orbit, frames = CircularOrbit(WIDE, ConstantSpeed(0.0, 1.0)), np.zeros((2, 20, 30), np.float32)
    return Scan(frames, WIDE, orbit, Shutter(0.1), np.arange(2.0), WIDE_GRID, reference=reference)


def test_the_box_that_the_cones_fill() -> None:
    wide = [[-240, 240]] * 2
    np.testing.assert_allclose(field_of_view_mm(WIDE), [[-16, 16], *wide])
    shifted = replace(WIDE, pixel_size_mm=(2.0, 20.0), detector_offset_mm=(-5.0, 300.0), detector_shape=(20, 30))
    np.testing.assert_allclose(field_of_view_mm(shifted), [[-25 * 640 / 800, 15 * 640 / 800], *wide])
    above = replace(shifted, detector_offset_mm=(30.0, 300.0))
    np.testing.assert_allclose(field_of_view_mm(above), [[10 * 160 / 800, 50 * 640 / 800], *wide])


@pytest.mark.parametrize("geometry", [ConeGeometry(300.0, 500.0, (40, 48), 1.6), ParallelGeometry((40, 48), 1.6)])
def test_the_default_grid_is_where_the_panel_looks(geometry) -> None:
    """A panel moved up sees the same height further up; the turn sees all that the panel sees at the axis."""
    straight = default_grid(geometry)
    for offset_mm in (-20.0, 0.4, 20.0, 60.0):
        moved = replace(geometry, detector_offset_mm=(offset_mm, 0.0))
        grid, ends_mm = default_grid(moved), (np.array([-32, 32]) + offset_mm) / geometry.magnification
        assert grid.shape[0] - straight.shape[0] in (0, 3) and grid.shape[1:] == straight.shape[1:]
        low_mm, high_mm = grid.box_mm[0]
        assert low_mm <= ends_mm[0] + 1 and high_mm >= ends_mm[1] - 1 and not cuts(grid, grid, moved)
        poses = moved.pose(np.deg2rad([0, 90, 200]))
        np.testing.assert_allclose(default_grid(moved, poses).box_mm, grid.box_mm, atol=1e-9)


def test_a_panel_that_stands_in_the_grid_is_said(scan, caplog) -> None:
    """As of a parallel beam, whose panel somebody puts at the axis."""
    for to_panel_mm, is_said in ((800.0, False), (601.0, False), (599.0, True), (400.5, True)):
        geometry = replace(WIDE, source_to_detector_mm=to_panel_mm)
        caplog.clear()
        replace(scan, geometry=geometry, trajectory=CircularOrbit(geometry, ConstantSpeed(0.3, 1.0))).check_sight()
        assert ("inside of it: rays end there" in caplog.text) == is_said, to_panel_mm


def test_a_grid_that_ends_inside_of_what_is_seen() -> None:
    for roi_mm, is_cut in [
        ((-200, 200, -200, 200, -200, 200), False),
        ((-16, 16, -200, 200, -200, 200), False),  # above and below there is nothing to see
        ((-16, 16, -200, 200, -200, 150), True),
        ((-16, 16, -200, 200, -150, 200), True),
        ((-16, 16, -192, 192, -192, 192), False),  # by a voxel
        ((-500, 500, -100, 100, -500, 500), True),
    ]:
        grid = GridChoice(roi_mm=roi_mm, voxel_mm=8).of(WIDE_GRID)
        assert cuts(grid, WIDE_GRID, WIDE) is is_cut and not misses(grid, WIDE), roi_mm
    for x_mm, is_missed in ((248, True), (-248, True), (240, False)):  # two touch what is seen, ±240
        assert misses(Grid((2, 2, 2), (8.0, 8.0, 8.0), (0.0, 0.0, x_mm)), WIDE) is is_missed


def test_where_a_grid_lies_that_no_ray_of_a_pose_meets(scan) -> None:
    """A cube of 8 mm, from the panel's and the rays' edges as seen from the source at x = 400 mm."""
    at = WIDE.pose(0.0)  # the panel at x = -400 mm is 40 mm high and 1200 mm wide
    for z_mm, y_mm, x_mm, place in [
        (0, 0, 0, ""), (0, 0, -395, ""), (0, 0, -405, "behind the panel"), (0, 0, 405, "beside the rays"),
        (0, 0, 400, ""), (13, 0, 0, ""), (15, 0, 0, "beside the rays"), (-15, 0, 0, "beside the rays"),
        (0, 303, 0, ""), (0, 308, 0, "beside the rays"), (0, -308, 0, "beside the rays"),
    ]:  # fmt: skip
        grid = Grid((2, 2, 2), (4.0, 4.0, 4.0), (z_mm, y_mm, x_mm))
        for pose, panel in ((at, (20, 30)), (transpose_pose(at), (30, 20))):  # either handedness
            assert hidden(grid, pose, panel) == place, (z_mm, y_mm, x_mm)
    scan.check_sight()
    one_side = replace(scan, grid=Grid((2, 2, 2), (4.0, 4.0, 4.0), (0.0, 0.0, -405.0)), reference=None)
    one_side.check_sight()  # a radian later it is before the panel
    with pytest.raises(InputError, match="grid: found a box in .* that no ray meets in any frame"):
        replace(one_side, grid=replace(WIDE_GRID, offset_mm=(500.0, 0.0, 0.0))).check_sight()


def test_a_reference_goes_with_a_part_of_its_grid_that_is_seen(scan) -> None:
    assert scan.with_grid(GridChoice()) is scan
    part = scan.with_grid(GridChoice(roi_mm=(-40, 40, -80, 40, 0, 40)))
    assert part.grid.shape == (2, 3, 1)
    np.testing.assert_array_equal(part.reference, scan.reference[4:6, 3:6, 5:6])
    for other in ({"size": 11}, {"voxel_mm": 41}, {"roi_mm": (-240, 40, -80, 40, 0, 40)}):
        assert scan.with_grid(GridChoice(**other)).reference is None
    with pytest.raises(InputError, match=r"--roi-mm: found .*field of view, .* -16 to 16, -240 to 240, -240 to 240 mm"):
        scan.with_grid(GridChoice(roi_mm=(40, 80, -10, 10, -10, 10)))


def test_an_exposure_is_longer_than_the_times_steps(scan) -> None:
    for exposure_s in (0.0, 1e-9):
        Shutter(exposure_s, 0.2).check_resolved(scan.frame_start_s)
    for exposure_s in (5e-324, 1e-13):
        with pytest.raises(InputError, match=r"^exposure_s: found .* s; expected 0, or at least the 2\.2e-13 s"):
            Shutter(exposure_s, 0.2).check_resolved(scan.frame_start_s)


def test_frames_are_searched_for_nan_where_they_enter(scan) -> None:
    """A replaced field leaves the frames unsearched; other frames are searched, also those of a scan of one's own."""
    bad = scan.projections.copy()
    bad[0, 0, 0] = np.nan
    for enter in (partial(replace, scan), partial(Scan, geometry=scan.geometry, trajectory=scan.trajectory)):
        with pytest.raises(InputError, match="projections: found 1 NaN"):
            enter(projections=bad, shutter=scan.shutter, frame_start_s=scan.frame_start_s, grid=scan.grid)
    scan.projections[0, 0, 0] = np.nan
    assert (again := replace(scan, title="another")).projections is scan.projections
    with pytest.raises(InputError, match=r"projections.*\(0, 0, 0\)"):
        again.warn_of_negative_integrals()  # as every run does
