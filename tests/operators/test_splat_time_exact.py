"""Splats that move through the segments of a frame, whole or by their centres: quadrature in time, hundreds of poses."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import MODELS, READOUTS, assert_between, assert_classes, assert_near, by_gaussian, frame_cells
from kernel_kit import random_weights as weights
from kernel_kit import splat as render
from kernel_kit import splat_gradients as gradients
from remembered import remembered
from tolerances import (
    CUTOFF_EDGE_MOVING,
    EXACT_OVER_MICRO_VIEWS,
    GRADIENT,
    MOVING_GRADIENT,
    SEGMENTS_ORDER,
    SPLAT_MOVING,
    TIME_RULE,
)

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import exact_cells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA, DeviceCells, SplatProjector
from phyradgs_cl.operators.twins.splat import moving_frame

moving_frame = remembered(moving_frame)
SHAPE = (13, 18)
WIDE = (16, 96)
# a bound that leaves one or two times to splats that hardly move, and the closed form to the rest
CLOSED_ONLY = 1e-9


def table_of(
    geometry: ConeGeometry, shutter: Shutter, speed_rad_per_s: float, segments: int, start_rad: float = 0.3
) -> TimeCells:
    orbit = CircularOrbit(geometry, ConstantSpeed(start_rad, speed_rad_per_s))
    return exact_cells(orbit, shutter, 0, 0.2, shutter.lines(geometry.detector_shape), segments)


def check_gradients(finite_differences, rt, rows, table, shape, affine=False) -> None:
    h = weights(shape)
    found = gradients(rt, rows, table, h, affine=affine, cutoff_sigma=0.0, time_error=CLOSED_ONLY)
    expected = by_gaussian(
        finite_differences, lambda r: (h * moving_frame(r, table, shape, affine=affine)).sum(), rows
    )
    assert_classes(found, expected, MOVING_GRADIENT)


def fast_geometry() -> ConeGeometry:
    """A thin, long panel of small pixels: near the axis a turn of 1 rad is some 35 pixels for each 0.5 of radius."""
    return ConeGeometry(5.0, 7.5, WIDE, (0.04, 0.04))


@pytest.fixture
def fast_cloud(make_cloud) -> Callable[[int, int], np.ndarray]:
    """A factory of Gaussians of 1 to 3 pixels near the axis, half as far along z as across it."""
    nearer = np.where(np.arange(11) == 2, 0.5, 1.0)[:, None]
    return lambda seed, count: nearer * make_cloud(count, seed, spread=0.4, scale=(0.025, 0.08))


@MODELS
@pytest.mark.parametrize("speed", [1e-6, 0.5, 2.0])
def test_frames_and_gradients_are_the_quadrature(any_rt, make_cloud, make_geometry, finite_differences, speed, affine):
    rows = make_cloud(4, 41, scale=(0.05, 0.3))
    table = table_of(make_geometry(*SHAPE, offset=(0.15, -0.25)), Shutter(0.8, 0.6), speed, 3)
    if speed == 0.5:
        check_gradients(finite_differences, any_rt, rows[:, :2], table, SHAPE, affine)
    frame = render(any_rt, rows, table, SHAPE, affine=affine, cutoff_sigma=0.0, time_error=CLOSED_ONLY)
    assert_near(frame, moving_frame(rows, table, SHAPE, affine=affine), SPLAT_MOVING)


@pytest.mark.parametrize(("axis", "direction"), READOUTS)
def test_any_readout_and_lines_that_open_for_a_moment(
    rt, make_cloud, make_geometry, finite_differences, axis, direction
) -> None:
    rows = make_cloud(4, 42)
    for exposure_s in (0.0, 0.8):
        table = table_of(make_geometry(*SHAPE), Shutter(exposure_s, 0.6, axis, direction), 0.6, 3)
        frame = render(rt, rows, table, SHAPE, cutoff_sigma=0.0, time_error=CLOSED_ONLY)
        assert_near(frame, moving_frame(rows, table, SHAPE), SPLAT_MOVING)
    table = table_of(make_geometry(*SHAPE), Shutter(0.4, 0.9, axis, direction), 0.8, 3)
    check_gradients(finite_differences, rt, make_cloud(1, 47), table, SHAPE)


@pytest.mark.parametrize("speed", [0.05, 0.4, 1.5])
def test_cutoff_is_the_outline_of_the_path(two_rt, fast_cloud, speed) -> None:
    """Boxes and the spans of lines hold all that is drawn, and nothing else is drawn."""
    rows = fast_cloud(43, 8)
    rows[3, :2], rows[4, :2] = 0.002, 0.2  # two needles
    table = table_of(fast_geometry(), Shutter(0.8, 0.6), speed, 2)
    frame = render(two_rt, rows, table, WIDE, time_error=CLOSED_ONLY)
    low, high = (
        moving_frame(rows, table, WIDE, DEFAULT_CUTOFF_SIGMA + edge)
        for edge in (-CUTOFF_EDGE_MOVING, CUTOFF_EDGE_MOVING)
    )
    assert_between(frame, low, high, SPLAT_MOVING * high.max())
    assert (high == 0).any()


@pytest.mark.parametrize("speed", [0.01, 0.05, 0.2])
def test_rules_keep_their_bound(rt, fast_cloud, speed) -> None:
    table = table_of(fast_geometry(), Shutter(0.8, 0.6), speed, 2)
    orbit = CircularOrbit(fast_geometry(), ConstantSpeed(0.3, speed))
    still = static_cells(orbit, Shutter(0.8), 0, 0.2, WIDE[0])
    for row in fast_cloud(44, 6).T[..., None]:
        peak = render(rt, row, still, WIDE, cutoff_sigma=0.0).max()
        for time_error in (1e-2, 1e-3, 1e-4):
            frame = render(rt, row, table, WIDE, cutoff_sigma=0.0, time_error=time_error)
            assert_near(frame, moving_frame(row, table, WIDE), TIME_RULE * time_error + SPLAT_MOVING, peak)


@pytest.mark.parametrize(("pixels", "affine"), [(1e-3, False), (4.0, False), (4.0, True), (50.0, False)])
def test_gradients_from_rest_to_fifty_pixels_a_segment(rt, fast_cloud, finite_differences, pixels, affine) -> None:
    """Windows end within the footprints: with a readout as long as that, neighbouring lines differ in what they see."""
    rows = fast_cloud(45, 2)
    rows[:2] = [[0.35, -0.3], [0.1, 0.2]]
    table = table_of(fast_geometry(), Shutter(0.5, 0.9), 1.0, 2)
    path = np.ptp([_seen_u(p, rows[:3, 0]) for p in table.end_poses[0]])
    table = table_of(fast_geometry(), Shutter(0.5, 0.9), pixels / path, 2)
    check_gradients(finite_differences, rt, rows, table, WIDE, affine)


def _seen_u(pose: np.ndarray, point: np.ndarray) -> float:
    p = np.linalg.solve(np.stack([pose[6:9], pose[9:12], pose[3:6] - pose[:3]], -1), point - pose[:3])
    return float(p[0] / p[2])


@pytest.mark.parametrize("time_error", [1e-2, 1e-3])
def test_gradients_are_those_of_the_rule_in_use(rt, fast_cloud, time_error) -> None:
    """By differences of the float32 frames themselves, on Gaussians wide enough for them, whichever rule serves them."""
    rows, h = fast_cloud(48, 3), weights(WIDE)
    table = table_of(fast_geometry(), Shutter(0.8, 0.6), 0.15, 2)
    options = {"cutoff_sigma": 0.0, "time_error": time_error}
    found = gradients(rt, rows, table, h, **options)
    step = 1e-3
    for parameter in (0, 1, 10):
        change = np.zeros_like(rows)
        change[parameter] = step
        ends = [(h * render(rt, rows + s * change, table, WIDE, **options)).sum() for s in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        assert abs(found[parameter].sum() - expected) <= 0.01 * np.abs(found[parameter]).sum()


@pytest.mark.parametrize("pulse_s", [None, (0.5, 0.4)])
def test_more_segments_come_to_every_row_at_hundreds_of_times(rt, make_cloud, make_geometry, pulse_s) -> None:
    rows, orbit = make_cloud(6, 49, scale=(0.03, 0.2)), CircularOrbit(make_geometry(40, 44), ConstantSpeed(0.3, 0.5))
    where = (orbit, Shutter(0.8, 0.6, pulse_s=pulse_s), 0, 0.2, 40)
    reference = render(rt, rows, per_line_cells(*where, 300), (40, 44))
    two, eight = (
        np.linalg.norm(render(rt, rows, exact_cells(*where, count), (40, 44), time_error=1e-5) - reference)
        for count in (2, 8)
    )
    assert eight <= SEGMENTS_ORDER * two


def test_a_third_of_the_micro_views_error_with_a_tenth_of_their_poses(rt, make_cloud) -> None:
    """Single Gaussians of 0.5 to 4 % of the half-width, rapid protocol, the default bound."""
    geometry, shutter = ConeGeometry(5.0, 7.0, (128, 128), (4 / 128,) * 2), Shutter(1.0, 0.86)
    where = (CircularOrbit(geometry, ConstantSpeed(0.3, np.deg2rad(14.4))), shutter, 0, 0.0, 128)
    tables = [per_line_cells(*where, 100), exact_cells(*where, 4), micro_view_cells(*where, 8, 5)]
    projector, cells = SplatProjector(rt, 128, 128), [DeviceCells.upload(rt, table) for table in tables]
    errors = []
    for row in make_cloud(5, 50, spread=0.55, scale=(0.01, 0.04)).T:
        reference, *frames = (projector.project(row[:, None], c).astype(np.float64) for c in cells)
        errors.append([np.linalg.norm(frame - reference) / np.linalg.norm(reference) for frame in frames])
    exact, micro = np.mean(errors, axis=0)
    assert exact <= EXACT_OVER_MICRO_VIEWS * micro


@pytest.mark.slow
@pytest.mark.parametrize(("readout", "affine"), [(("rows", 1), False), (("columns", -1), False), (("rows", -1), True)])
def test_splats_of_which_only_the_centres_move(two_rt, make_cloud, make_geometry, finite_differences, readout, affine):
    """A cutoff at six sigmas leaves gradients as they are."""
    shutter = Shutter(0.8, 0.6, *readout)
    table = frame_cells("centres", make_geometry(*SHAPE, offset=(0.15, -0.25)), 3, 2, shutter=shutter)
    rows, h = make_cloud(1 + (readout == ("rows", 1)), 21, scale=(0.05, 0.3)), weights(SHAPE)
    options = {"affine": affine, "cutoff_sigma": 0.0}
    assert_near(render(two_rt, rows, table, SHAPE, **options), moving_frame(rows, table, SHAPE, affine=affine), SPLAT_MOVING)
    expected = by_gaussian(finite_differences, lambda r: (h * moving_frame(r, table, SHAPE, affine=affine)).sum(), rows)
    whole = gradients(two_rt, rows, table, h, **options)
    assert_classes(whole, expected, GRADIENT)
    assert_classes(gradients(two_rt, rows, table, h, affine=affine, cutoff_sigma=6.0), whole, 1e-4)


@pytest.mark.slow
def test_only_the_centre_follows_the_gantry(rt, make_cloud, make_geometry) -> None:
    """A round Gaussian on the axis looks alike from everywhere: nothing is lost. A long one is wrong, more than by poses. A
    gantry at rest gives a static frame."""
    geometry, (round_one, long_one) = make_geometry(*SHAPE), (make_cloud(1, 23) for _ in range(2))
    for rows, scale in ((round_one, 0.2), (long_one, [[0.5], [0.1], [0.1]])):
        rows[:3], rows[3:6], rows[6:10] = 0.0, scale, [[1.0], [0.0], [0.0], [0.0]]
    tables = [frame_cells(motion, geometry, speed=0.8) for motion in ("centres", "micro-views", "static")]
    assert_near(*(render(rt, round_one, table, SHAPE) for table in tables[:2]), SPLAT_MOVING)
    moved, right, still = (render(rt, long_one, table, SHAPE) for table in tables)
    assert_near(moved, still, SPLAT_MOVING)  # the centre does not move on the panel
    assert np.abs(moved - right).max() > 0.01 * right.max()
    at_rest = (frame_cells(motion, geometry, speed=0.0) for motion in ("centres", "static"))
    assert_near(*(render(rt, make_cloud(3, 24), table, SHAPE) for table in at_rest), SPLAT_MOVING)
    table = frame_cells("centres", geometry, 2, 2)
    np.testing.assert_array_equal(table.scaled(50.0).conic_pose, 50.0 * table.conic_pose)
    with pytest.raises(InputError, match="conic pose"):
        table.still()
    assert replace(table, conic_pose=None).still().count == 4
