"""FDK's weights: whatever a scan's arc, detector and order of views, bodies keep their attenuation."""

import numpy as np
import pytest
from balls import balls, frames_of
from balls import levels as levels_in
from tolerances import FDK_MEAN, FDK_PARTIAL, FLOAT64

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import fdk_volume, weights

GRID = Grid.cube(32, 2.0)
PHANTOM = balls(((0.45, 0.1, 0.1), 0.3), ((-0.3, 0.45, -0.15), 0.28), ((-0.15, -0.5, 0.0), 0.25))


def cone(columns: int = 48, offset_u_mm: float = 0.0) -> ConeGeometry:
    """Pixels of 0.075 mm; 48 columns see ±1.18 mm at the axis."""
    return ConeGeometry(6.0, 9.0, (44, columns), (0.075, 0.075), (0.0, offset_u_mm))


def levels(rt, pose: np.ndarray, columns: int = 48) -> np.ndarray:
    frames = frames_of(PHANTOM, pose, (44, columns))
    return levels_in(PHANTOM, fdk_volume(rt, frames, pose, GRID), GRID, 0.75)


def turn(views: int, arc_deg: float = 360.0) -> np.ndarray:
    return 0.3 + np.deg2rad(arc_deg) / views * np.arange(views)


@pytest.mark.parametrize("coverage_deg", [100.0, 170.0, 190.0, 210.0, 260.0, 350.0])
def test_a_ray_and_its_opposite_in_a_short_scan_count_two(coverage_deg) -> None:
    coverage, rng = np.deg2rad(coverage_deg), np.random.default_rng(3)
    half_fan = np.deg2rad(20.0) if coverage_deg < 180 else 0.08
    for fan, progress in zip(rng.uniform(-half_fan, half_fan, 200), rng.uniform(0, coverage, 200), strict=True):
        opposite = (progress + np.pi + 2 * fan) % (2 * np.pi)
        both = weights.short_scan_weight(progress, np.array(fan), coverage)
        if opposite <= coverage:
            both = both + weights.short_scan_weight(opposite, np.array(-fan), coverage)
        assert float(both) == pytest.approx(2.0, abs=FLOAT64)


@pytest.mark.parametrize("offset_mm", [0.03, -0.2, 0.8, -1.1])
def test_a_ray_and_its_opposite_on_a_displaced_detector_count_two(offset_mm) -> None:
    geometry = cone(offset_u_mm=offset_mm)
    fan = weights.measured_fan(geometry.pose(turn(5))[:, None, None], geometry.detector_shape)
    assert fan.is_displaced
    angle = np.linspace(-fan.half_rad, fan.half_rad, 401)
    weight = weights.displaced_weight(angle, fan)
    np.testing.assert_allclose(weight + weight[::-1], 2.0, atol=FLOAT64)
    unseen = (angle < fan.low_rad) | (angle > fan.high_rad)
    np.testing.assert_allclose(weight[unseen], 0.0, atol=FLOAT64)
    assert sum(fan.missing_columns) == int(np.ceil(2 * abs(offset_mm) / 0.075 - 1e-6))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("beyond", [-1.5, -0.75, -0.4, -0.1, 0.0, 0.1, 0.5])
def test_a_full_turn_sees_all_of_a_row_once_where_the_axis_is_at_the_panels_edge(side, beyond) -> None:
    """``beyond``: pixels from the axis to the panel's first or last pixel. Both views together weigh the seen width."""
    geometry = ParallelGeometry((1, 24), 0.25, (0.0, side * (11.5 + beyond) * 0.25))
    pose = geometry.pose(np.zeros(1))[:, None, None]
    fan = weights.measured_fan(pose, (1, 24), is_parallel=True)
    rays = weights.pixel_rays(pose[0], np.arange(1), np.arange(24), is_parallel=True)
    weight = weights.displaced_weight(weights.fan_angle(pose[0], rays, is_parallel=True), fan)
    assert fan.sees_axis == (beyond < 0.5)
    assert weight.sum() == pytest.approx(2 * (23 + beyond + 0.5), rel=FLOAT64)


def test_the_middle_of_a_volume_where_the_axis_is_the_panels_first_pixel(rt) -> None:
    """Its density was 1.7 while that pixel counted twice."""
    geometry, grid = ConeGeometry(6.0, 9.0, (8, 24), 0.075, (0.0, 11.5 * 0.075)), Grid((1, 7, 7), (0.05,) * 3)
    frames = frames_of(balls(((0.0, 0.0, 0.0), 0.5)), pose := geometry.pose(turn(90)), (8, 24))
    assert fdk_volume(rt, frames, pose, grid).mean() == pytest.approx(1.0, abs=FDK_PARTIAL)


NEARLY_PARALLEL = ConeGeometry(500.0, 700.0, (44, 48), (0.07, 0.07))


@pytest.mark.parametrize(("geometry", "arc_deg", "views"), [
    *((cone(34, offset_mm), 360.0, 120) for offset_mm in (0.0188, 0.45, 0.9, -0.9)), (NEARLY_PARALLEL, 180.0, 180),
    (cone(), 205.0, 40), (cone(), 205.0, 120), (cone(), 300.0, 120), (cone(), 400.0, 40), (cone(), 360.0, 60),
])  # fmt: skip
def test_displaced_detectors_short_scans_and_more_than_a_turn(rt, geometry, arc_deg, views, caplog) -> None:
    """34 columns of 0.075 mm see ±0.85 mm at the axis when centred: the balls need up to 0.77 + the offset. Rapid scans too:
    their first and last views stand for half a step beyond themselves. Nothing is missing of any."""
    found = levels(rt, geometry.pose(turn(views, arc_deg)), geometry.detector_shape[1])
    np.testing.assert_allclose(found, 1.0, atol=FDK_PARTIAL)
    assert not caplog.records


def test_short_scans_with_uneven_steps_and_their_end_views(rt) -> None:
    steps = np.random.default_rng(4).uniform(0.5, 1.5, 110)
    angles = np.cumsum(steps) / steps.sum() * np.deg2rad(225.0)
    found = levels(rt, cone().pose(np.random.default_rng(5).permutation(angles)))
    np.testing.assert_allclose(found, 1.0, atol=FDK_PARTIAL)
    whole = frames_of(PHANTOM, pose := cone().pose(turn(30, 215.0)), (44, 48))
    for end in (0, -1):
        frames = np.zeros_like(whole)
        frames[end] = whole[end]
        assert np.abs(fdk_volume(rt, frames, pose, GRID)).max() > 1e-3


def test_poses_that_are_no_plain_circle(rt) -> None:
    """A source off the panel's normal, along both of its axes; a gantry that breathes: every view has its own distances."""
    beside = cone().pose(turn(120))
    beside[:, 0:3] += 3.0 * beside[:, 6:9] + 2.0 * beside[:, 9:12]
    near, far = cone(), ConeGeometry(6.2, 9.1, (44, 48), (0.075, 0.075), (0.01, 0.0))
    breathing = np.where((np.arange(120) % 2 == 0)[:, None], near.pose(turn(120)), far.pose(turn(120)))
    for pose in (beside, breathing):
        np.testing.assert_allclose(levels(rt, pose), 1.0, atol=FDK_MEAN)


@pytest.mark.parametrize(("arc_deg", "offset_mm", "message"), [
    (160.0, 0.0, "the views cover 160.0°, complete data need"), (360.0, 2.5, "does not see the rotation axis"),
])  # fmt: skip
def test_incomplete_data_are_named_and_a_source_on_the_axis_is_refused(rt, caplog, arc_deg, offset_mm, message) -> None:
    """Of displaced detectors too: test_missing_views.py."""
    pose = cone(34, offset_mm).pose(turn(40, arc_deg))
    assert not fdk_volume(rt, np.zeros((40, 44, 34), np.float32), pose, GRID).any()
    assert message in caplog.text
    pose[2, :2] = 0
    with pytest.raises(InputError, match="rotation axis"):
        fdk_volume(rt, np.zeros((40, 44, 34), np.float32), pose, GRID)
