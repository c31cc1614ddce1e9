"""FDK's voxel-driven backprojections against their float64 twins."""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from ray_tables import leaning, tables
from remembered import remembered
from tolerances import BACKPROJECTION

from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject, backproject_lines
from phyradgs_cl.operators.twins.rays import backprojection, lines_backprojection
from phyradgs_cl.runtime import Runtime

backprojection, lines_backprojection = remembered(backprojection), remembered(lines_backprojection)
GRID = Grid((5, 9, 19), (0.3, 0.2, 0.1), (0.1, -0.1, 0.2))
ANGLES = np.array([0.0, 1.3, 2.9, 4.4])
SHAPES = [(13, 18), (31, 5), (2, 2), (21, 26)]

Geometries = Callable[..., ConeGeometry]


def random_frames(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Frames (4, rows, columns) of numbers in ±1 and weights (4,)."""
    rng = np.random.default_rng(61)
    return rng.uniform(-1, 1, (4, *shape)).astype(np.float32), rng.uniform(0.5, 1, 4)


def line_poses(geometry: ConeGeometry, lines: int, turn_rad: float) -> np.ndarray:
    """Poses (4, lines, 12) of a gantry that turns while lines are read out."""
    return np.stack([geometry.pose(a + np.linspace(-0.5, 0.5, lines) * turn_rad) for a in ANGLES])


def assert_same(found: np.ndarray, expected: np.ndarray, scale: float = 1.0) -> None:
    assert np.count_nonzero(expected) > 10
    np.testing.assert_allclose(found, expected, rtol=0, atol=BACKPROJECTION * scale)


@pytest.mark.parametrize("shape", SHAPES)
def test_frames(any_rt, make_geometry: Geometries, shape) -> None:
    """Upright and leaning detectors have kernels of their own; others take the general one. Some voxels miss the panel."""
    frames, weight = random_frames(shape)
    for tilt, power in product((0.0, 0.02, 0.05, 0.3), (2, 1)):  # and of the distance
        pose = make_geometry(*shape, offset=(0.1, 0.2)).pose(ANGLES)
        pose[:, 9:12] += tilt * pose[:, 6:9]
        expected = backprojection(frames, pose, weight, GRID, power=power)
        assert_same(backproject(any_rt, frames, pose, weight, GRID, power=power), expected)
        if shape[0] > 2:
            even = np.ones_like(frames)
            even[:, [0, -1]] = 0
            expected = backprojection(even, pose, weight, GRID, power=power)
            assert_same(backproject(any_rt, even, pose, weight, GRID, power=power, is_even=True), expected)


@pytest.fixture(scope="module", params=[8, *(pytest.param(n, marks=pytest.mark.slow) for n in (4, 16))])
def cpu_rt(request: pytest.FixtureRequest) -> Runtime:
    return Runtime(lanes=request.param, pixel_items=False)


def test_panels_rolled_and_tilted_to_either_side(cpu_rt) -> None:
    """Tilted by 6 degrees, a voxel's detector column hardly changes along z; rolled, it passes several columns."""
    shape, grid = (120, 50), Grid((70, 3, 45), (0.03, 0.05, 0.045), (0.0, 0.005, 0.03))
    rt, (frames, weight) = cpu_rt, (part[:2] for part in random_frames(shape))
    for roll_deg, tilt_deg in ((-0.2, -6.0), (5.0, 0.5)):
        cells = leaning(tables("static", shape, "rows", frames=2, direction=-1), roll_deg, tilt_deg)
        pose = np.concatenate([table.pose for table in cells])
        assert_same(backproject(rt, frames, pose, weight, grid), backprojection(frames, pose, weight, grid), 5)
        even = np.ones_like(frames)
        even[:, [0, -1]] = 0
        found = backproject(rt, even, pose, weight, grid, is_even=True)
        assert_same(found, backprojection(even, pose, weight, grid), 5)


def test_rows_that_run_downwards_and_tall_detectors(two_rt, make_geometry: Geometries) -> None:
    """v falls with z; so many rows that a column of voxels is cut into blocks."""
    shape, grid = (1500, 7), Grid((11, 3, 5), (0.12, 0.3, 0.3))
    frames, weight = random_frames(shape)
    pose = make_geometry(*shape).pose(ANGLES)
    pose[:, 3:6] += (shape[0] - 1) * pose[:, 9:12]
    pose[:, 9:12] *= -1
    smooth = np.cumsum(frames, axis=1, dtype=np.float64).astype(np.float32) / 40  # 1e-5 pixels matter less
    expected = backprojection(smooth, pose, weight, grid)
    assert_same(backproject(two_rt, smooth, pose, weight, grid), expected, 5)


@pytest.mark.parametrize(("voxel_mm", "rows"), [(0.02, 97), (0.05, 9), (0.05, 97), (0.09, 9), (0.15, 97)])
def test_columns_of_many_voxels_at_any_pitch(cpu_rt, voxel_mm, rows, make_geometry: Geometries) -> None:
    """Where a vector of voxels meets few rows, and where it meets more than two vectors hold."""
    grid, (frames, weight) = Grid((43, 3, 5), (voxel_mm, 0.2, 0.2)), random_frames((rows, 7))
    pose = make_geometry(rows, 7).pose(ANGLES)
    for down in (False, True):
        if down:
            pose[:, 3:6] += (rows - 1) * pose[:, 9:12]
            pose[:, 9:12] *= -1
        expected = backprojection(frames, pose, weight, grid)
        assert_same(backproject(cpu_rt, frames, pose, weight, grid), expected, 4)


def test_voxels_behind_the_source_receive_nothing(two_rt, make_geometry: Geometries) -> None:
    weight = random_frames((13, 18))[1]
    frames = np.ones((4, 13, 18), np.float32)  # a position is ill-conditioned beside the source
    grid = Grid((3, 5, 21), (0.4, 0.4, 1.1))  # ±11 mm along x, sources at a radius of 5
    pose = make_geometry(13, 18).pose(ANGLES)
    expected = backprojection(frames, pose, weight, grid)
    near = 2 * np.abs(expected).max()  # 1/z² is large beside the source
    assert_same(backproject(two_rt, frames, pose, weight, grid), expected, near)
    lines = line_poses(make_geometry(13, 18), 13, 0.1)
    expected = lines_backprojection(frames, lines, weight, grid)
    assert_same(backproject_lines(two_rt, frames, lines, weight, grid), expected, near)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1), (5, 9)])
def test_rounding_moves_no_voxel_off_the_panel(two_rt, make_geometry: Geometries, shape) -> None:
    """The voxel lies on the first row, or the middle column, exactly or but for 0.0004 pixels; by every kernel."""
    frames, weight = random_frames(shape)
    pose = make_geometry(*shape).pose(np.zeros(4))
    pose[:, 3:6] += (shape[0] - 1) / 2 * pose[:, 9:12]
    for tilt, away in product((0.0, 0.02, 0.3), (-4e-4, 0.0, 4e-4)):
        moved = pose + np.concatenate([np.zeros((4, 9)), tilt * pose[:, 6:9]], 1)
        for side in (6, 9):
            moved[:, 3:6] += away * moved[:, side : side + 3]
        for voxel_mm in (0.1, 2.0):  # two ways of the upright kernel
            grid = Grid((1, 1, 1), (voxel_mm, 0.1, 0.1))
            expected = backprojection(frames, pose, weight, grid)
            for found in (
                backproject(two_rt, frames, moved, weight, grid), backprojection(frames, moved, weight, grid),
                backproject_lines(two_rt, frames, np.repeat(moved[:, None], shape[0], 1), weight, grid),
            ):  # fmt: skip
                np.testing.assert_allclose(found, expected, rtol=5e-3)


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("shape", SHAPES)
def test_lines(any_rt, make_geometry: Geometries, shape, axis) -> None:
    """Turning either way, which counts their speed once by either power, and at rest, where they are frames."""
    frames, weight = random_frames(shape)
    geometry, lines = make_geometry(*shape, offset=(0.1, 0.2)), shape[axis == "columns"]
    for turn_rad, power in ((0.15, 2), (-0.15, 1)):
        pose = line_poses(geometry, lines, turn_rad)
        expected = lines_backprojection(frames, pose, weight, GRID, axis, power=power)
        found = backproject_lines(any_rt, frames, pose, weight, GRID, axis, power=power)
        assert_same(found, expected, 2)  # the line is rounded too
    expected = backprojection(frames, geometry.pose(ANGLES), weight, GRID)
    at_rest = backproject_lines(any_rt, frames, line_poses(geometry, lines, 0.0), weight, GRID, axis)
    assert_same(at_rest, expected, 2)


def test_many_views_go_to_the_device_in_parts(two_rt, make_geometry: Geometries) -> None:
    rng = np.random.default_rng(65)
    frames, weight = rng.uniform(-1, 1, (131, 5, 6)).astype(np.float32), rng.uniform(0.5, 1, 131) / 131
    pose = make_geometry(5, 6).pose(np.arange(131) * 2 * np.pi / 131)
    grid = Grid((3, 4, 5), (0.3, 0.3, 0.3))
    expected = backprojection(frames, pose, weight, grid)
    assert_same(backproject(two_rt, frames, pose, weight, grid), expected)
    lines = np.repeat(pose[:, None], 5, axis=1)
    assert_same(backproject_lines(two_rt, frames, lines, weight, grid), expected)
