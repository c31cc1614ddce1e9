"""The intensity model, its derivative and the transpose: twins, finite differences, ⟨Jd, y⟩ = ⟨d, Jᵀy⟩."""

from dataclasses import replace

import numpy as np
import pytest
import ray_tables
from kernel_kit import assert_near
from remembered import remembered
from tolerances import RAYS, RAYS_BACK

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import IntensityOperator
from phyradgs_cl.operators.twins.rays import intensity_volume, ray_frame

intensity_volume, ray_frame = map(remembered, (intensity_volume, ray_frame))
GRID = Grid((5, 7, 6), (0.35, 0.26, 0.3), (0.1, -0.05, 0.1))
SHAPE = (6, 7)
DIFFERENCE = 1e-4  # step of finite differences in float64: their error is of its square


def noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Line integrals of some units."""
    return 6 * ray_tables.noise(shape, seed)


def tables(motion: str, axis: str = "rows", frames: int = 2) -> list[TimeCells]:
    return ray_tables.tables(motion, SHAPE, axis, -1, frames)


def derivative(x: np.ndarray, d: np.ndarray, table: TimeCells) -> np.ndarray:
    """The derivative (rows, columns) of the twin's frame at x along d, by finite differences."""
    x, d = x.astype(float), d.astype(float)
    ahead, behind = (ray_frame(x + s * DIFFERENCE * d, GRID, table, SHAPE, "intensity") for s in (1.0, -1.0))
    return (ahead - behind) / (2 * DIFFERENCE)


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("motion", ["static", "micro-views", "per line"])
def test_what_is_expected_and_its_derivative_and_transpose_are_the_twins(two_rt, motion, axis) -> None:
    cells = tables(motion, axis)
    x, d, y = noise(GRID.shape, 2), noise(GRID.shape, 3), noise((2, *SHAPE), 4)
    operator = IntensityOperator(two_rt, GRID, SHAPE, cells)
    expected = np.stack([ray_frame(x, GRID, table, SHAPE, "intensity") for table in cells])
    assert expected.max() > 4
    assert_near(operator.expected(x), expected, RAYS)
    expected = np.stack([derivative(x, d, table) for table in cells])
    assert_near(operator.forward(d), expected, 3 * RAYS)
    back = sum(intensity_volume(frame, x, GRID, table) for frame, table in zip(y, cells, strict=True))
    assert_near(operator.adjoint(y), back, 3 * RAYS_BACK)


def test_very_opaque_volumes_stay_finite_and_frames_may_have_fewer_cells_and_lines_without_any(rt) -> None:
    (first, second), x = tables("per line"), 50 * noise(GRID.shape, 12)
    operator = IntensityOperator(rt, GRID, SHAPE, [first, second])
    expected = np.stack([ray_frame(x / 100, GRID, t, SHAPE) for t in (first, second)]) * 100
    assert expected.max() > 300
    assert np.isfinite(operator.expected(x)).all() and np.isfinite(operator.adjoint(expected)).all()
    keep = (second.line_start > 2) & (np.arange(second.count) % 3 < 2)
    names = ("pose", "time_s", "line_start", "line_stop", "weight")
    fewer = replace(second, **{n: getattr(second, n)[keep] for n in names})
    fewer = replace(fewer, weight=np.full(fewer.count, 0.5))
    operator, x = IntensityOperator(rt, GRID, SHAPE, [first, fewer]), noise(GRID.shape, 13)
    found = operator.expected(x)
    expected = ray_frame(x, GRID, first, SHAPE, "intensity")
    assert_near(found[0], expected, RAYS)
    assert not found[1, :3].any() and found[1, 3:].any()
    assert not operator.forward(x)[1, :3].any()
