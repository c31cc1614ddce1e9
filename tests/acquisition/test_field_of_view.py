"""What a scan sees, and its grid replaced."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Scan, Shutter, transpose_pose
from phyradgs_cl.acquisition.geometry import cuts, field_of_view_mm, hidden, misses
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, GridChoice

GEOMETRY = ConeGeometry(400.0, 800.0, (20, 30), (2.0, 40.0))  # half width 600: sin = 3/5
GRID = Grid.cube(10, 400.0)


@pytest.fixture
def scan() -> Scan:
    reference = np.arange(1000, dtype=np.float32).reshape(10, 10, 10)
    orbit = CircularOrbit(GEOMETRY, ConstantSpeed(0.0, 1.0))
    frames = np.zeros((2, 20, 30), np.float32)
    return Scan(frames, GEOMETRY, orbit, Shutter(0.1), np.arange(2.0), GRID, reference=reference)


def test_the_box_that_the_cones_fill() -> None:
    assert field_of_view_mm(GEOMETRY) == pytest.approx((20 * 640 / 800, 240, 240))
    shifted = ConeGeometry(400.0, 800.0, (20, 30), (2.0, 20.0), (-5.0, 300.0))
    assert field_of_view_mm(shifted) == pytest.approx((25 * 640 / 800, 240, 240))


def test_a_panel_that_stands_in_the_grid_is_said(scan, caplog) -> None:
    """As of a parallel beam, whose panel somebody puts at the axis."""
    for to_panel_mm, is_said in ((800.0, False), (601.0, False), (599.0, True), (400.5, True)):
        geometry = replace(GEOMETRY, source_to_detector_mm=to_panel_mm)
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
        grid = GridChoice(roi_mm=roi_mm, voxel_mm=8).of(GRID)
        assert cuts(grid, GRID, GEOMETRY) is is_cut and not misses(grid, GEOMETRY), roi_mm
    for x_mm, is_missed in ((248, True), (-248, True), (240, False)):  # two touch what is seen, ±240
        assert misses(Grid((2, 2, 2), (8.0, 8.0, 8.0), (0.0, 0.0, x_mm)), GEOMETRY) is is_missed


def test_where_a_grid_lies_that_no_ray_of_a_pose_meets(scan) -> None:
    """A cube of 8 mm, from the panel's and the rays' edges as seen from the source at x = 400 mm."""
    at = GEOMETRY.pose(0.0)  # the panel at x = -400 mm is 40 mm high and 1200 mm wide
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
        replace(one_side, grid=replace(GRID, offset_mm=(500.0, 0.0, 0.0))).check_sight()


def test_a_reference_goes_with_a_part_of_its_grid_that_is_seen(scan) -> None:
    assert scan.with_grid(GridChoice()) is scan
    part = scan.with_grid(GridChoice(roi_mm=(-40, 40, -80, 40, 0, 40)))
    assert part.grid.shape == (2, 3, 1)
    np.testing.assert_array_equal(part.reference, scan.reference[4:6, 3:6, 5:6])
    for other in ({"size": 11}, {"voxel_mm": 41}, {"roi_mm": (-240, 40, -80, 40, 0, 40)}):
        assert scan.with_grid(GridChoice(**other)).reference is None
    with pytest.raises(InputError, match=r"--roi-mm: found .*field of view, \(z, y, x\) ±16, ±240, ±240 mm"):
        scan.with_grid(GridChoice(roi_mm=(40, 80, -10, 10, -10, 10)))


def test_an_exposure_is_longer_than_the_times_steps(scan) -> None:
    for exposure_s in (0.0, 1e-9):
        Shutter(exposure_s, 0.2).check_resolved(scan.frame_start_s)
    for exposure_s in (5e-324, 1e-13):
        with pytest.raises(InputError, match=r"^exposure_s: found .* s; expected 0, or at least the 2\.2e-13 s"):
            Shutter(exposure_s, 0.2).check_resolved(scan.frame_start_s)
