"""Sub-rays: a pixel as the mean of rays is the twin's mean over a finer panel, exactly transposed, in every launch shape."""

import numpy as np
import pytest
from memory_limits import room_for
from ray_tables import noise, tables
from remembered import remembered
from tolerances import ADJOINT, BRICKS, RAYS, RAYS_BACK

from phyradgs_cl.detector import intensity_average
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.operators.rays.layout import layered
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.operators.twins.rays import ray_frame, ray_volume
from phyradgs_cl.operators.warp.operator import projector_of

ray_frame, ray_volume = remembered(ray_frame), remembered(ray_volume)
GRID = Grid((7, 9, 8), (0.27, 0.2, 0.22), (0.1, -0.05, 0.2))
UPRIGHT = Grid((20, 11, 9), (0.09, 0.15, 0.2))
SHAPE, PAIR = (6, 5), (3, 2)  # pixels; rays of a pixel along v and along u


def of(rt, motion: str, axis: str = "rows", grid: Grid = GRID, shape: tuple[int, int] = SHAPE, beam: str = "cone"):
    return RayOperator(rt, grid, shape, tables(motion, shape, axis, frames=2, beam=beam), subrays=PAIR)


def mismatch(operator) -> float:
    x, y = noise(operator.volume_shape, 3), noise(operator.frames_shape, 4)
    forward = float(np.vdot(operator.forward(x).astype(np.float64), y))
    assert forward > 0
    return abs(forward - float(np.vdot(operator.adjoint(y).astype(np.float64), x))) / forward


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize(
    ("motion", "grid", "beam"),
    [("static", UPRIGHT, "cone"), ("static", GRID, "parallel"), ("micro-views", GRID, "cone"), ("common", UPRIGHT, "cone")],
)
def test_a_pixel_is_the_mean_over_a_finer_panel(two_rt, motion, grid, beam, axis) -> None:
    operator = of(two_rt, motion, axis, grid, beam=beam)
    rows, columns = SHAPE
    fine = [table.finer(*PAIR) for table in operator.tables]
    x, y = noise(grid.shape, 5), noise(operator.frames_shape, 6)
    frames = [ray_frame(x, grid, table, (PAIR[0] * rows, PAIR[1] * columns)) for table in fine]
    expected = np.stack(frames).reshape(-1, rows, PAIR[0], columns, PAIR[1]).mean((2, 4))
    assert np.abs(operator.forward(x) - expected).max() <= RAYS * expected.max()
    assert np.abs(operator.subset([1]).forward(x) - expected[[1]]).max() <= RAYS * expected.max()
    shares = y.repeat(PAIR[0], 1).repeat(PAIR[1], 2) / np.prod(PAIR)
    expected = sum(ray_volume(frame, grid, table) for frame, table in zip(shares, fine, strict=True))
    assert np.abs(operator.adjoint(y) - expected).max() <= RAYS_BACK * expected.max()
    assert mismatch(operator) <= ADJOINT


@pytest.mark.slow
def test_a_volume_in_bricks(two_rt) -> None:
    grid = Grid((21, 70, 37), (0.09, 0.03, 0.05), (0.05, 0.1, -0.1))
    whole = of(two_rt, "static", grid=grid, shape=(7, 37))
    x, y = noise(grid.shape, 9), noise(whole.frames_shape, 10)
    frames, volume = whole.forward(x), whole.adjoint(y)
    with room_for(two_rt, 320_000):
        parts = of(two_rt, "static", grid=grid, shape=(7, 37))
        assert len(parts.memory.plan()) > 1
        assert np.abs(parts.forward(x) - frames).max() <= BRICKS * frames.max()
        assert np.abs(parts.adjoint(y) - volume).max() <= BRICKS * volume.max()


def test_intensity_averages_the_times_of_a_line_and_not_its_rays(any_rt) -> None:
    (rows, columns), x = SHAPE, noise(GRID.shape, 11)
    cells = tables("micro-views", SHAPE, frames=2)
    model = IntensityOperator(any_rt, GRID, SHAPE, cells, subrays=PAIR)
    layers, weights = layered(cells)
    fine = [[ray_frame(x, GRID, one.finer(*PAIR), (PAIR[0] * rows, PAIR[1] * columns)) for one in layer] for layer in layers]
    means = [np.stack(frames).reshape(-1, rows, PAIR[0], columns, PAIR[1]).mean((2, 4)) for frames in fine]
    expected, _ = intensity_average(means, weights)
    assert np.abs(model.expected(x) - expected).max() <= RAYS * expected.max()
    assert mismatch(model) <= ADJOINT


@pytest.mark.slow
def test_an_object_that_moves(two_rt) -> None:
    control_mm = 0.1 * noise((1, 4, 4, 4, 3), 12)
    motion = Deformation(control_mm, (-1.0, -1.0, -1.0), 0.7, np.array([0.0, 6.0]), np.array([[0.0], [1.0]]))
    cells = tables("static", SHAPE, frames=3)
    moving = projector_of(two_rt, GRID, cells, motion)(two_rt, GRID, SHAPE, cells, subrays=PAIR)
    assert mismatch(moving) <= ADJOINT
    assert moving.memory.layout.subrays == PAIR


@pytest.mark.parametrize(("is_dense", "counts"), [
    (False, {0.5: 1, 1.0: 1, 1.4: 1, 1.45: 1, 1.5: 2, 2.0: 2, 2.5: 2, 2.6: 3, 4.0: 4, 40.0: 8}),
    (True, {0.5: 1, 1.4: 1, 2.0: 1, 2.1: 2, 3.0: 3, 4.0: 4, 40.0: 8}),
])  # fmt: skip
def test_rays_are_as_many_as_voxels_need(is_dense, counts) -> None:
    """Pixels of 0.3 by 0.2 mm; in the cone they are two thirds of that at the axis, and less nearer to the source."""
    shape = (13, 18)
    cone, parallel = (tables("static", shape, source_mm=1000.0, beam=beam) for beam in ("cone", "parallel"))
    pitch_v, pitch_u = 3.9 / 13 / 1.5, 4.1 / 18 / 1.5
    for cells, scale in ((parallel, 1.0), (cone, 1.5 * 1000 / 1002.5)):
        for ratio, count in counts.items():
            sides_mm = scale * pitch_v / ratio, scale * pitch_u, scale * pitch_u
            assert subrays_of(Grid((20, 2, 2), sides_mm), cells, is_dense=is_dense) == (count, 1)
            sides_mm = scale * pitch_v, scale * pitch_u / ratio, scale * pitch_u / ratio
            assert subrays_of(Grid((20, 2, 2), sides_mm), cells, is_dense=is_dense) == (1, count)
    near = tables("static", shape, source_mm=5.0)  # the grid reaches to 1 mm from the source
    expected = (1, 1) if is_dense else (4, 1)
    assert subrays_of(Grid((20, 20, 20), (pitch_v / 4, 0.4, 0.4)), near, is_dense=is_dense) == expected
