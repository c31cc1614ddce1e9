"""Laws of every operator: adjoint, linear, additive over frames and time cells. Some on random geometries, shutters,
motions, grids and clouds: a thousand cases of each in `make stress`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kernel_kit import assert_near, frame_cells, splat, splat_gradients
from ray_tables import leaning, noise
from ray_tables import tables as ray_tables
from stress import STRESSED
from tolerances import ADJOINT, FLOAT32, GRADIENT, RAYS_BACK

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.cells import micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.gaussians import DENSITY
from phyradgs_cl.objective import TvProx
from phyradgs_cl.objective.dct_prox import DctProx
from phyradgs_cl.operators import RayOperator, Voxeliser
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.twins.splat import splat_frame
from phyradgs_cl.runtime import Runtime

GRID, SHAPE = Grid((12, 15, 13), (0.16, 0.13, 0.15), (0.1, -0.05, 0.2)), (40, 18)
NEAR = 2 * RAYS_BACK  # of the largest: two ways whose sums are rounded in other orders


@dataclass(frozen=True)
class Operator:
    """An operator on the device, the shapes of what goes into its directions, and the operator ``of`` other cells."""

    forward: Callable[[np.ndarray], np.ndarray]
    adjoint: Callable[[np.ndarray], np.ndarray]
    shapes: tuple[tuple[int, ...], tuple[int, ...]]
    cells: Sequence[TimeCells] = ()
    of: Callable[[Sequence[TimeCells]], "Operator"] | None = None
    slack: float = 1.0


def rays(rt, cells, grid: Grid = GRID, shape: tuple[int, int] = SHAPE) -> Operator:
    made = RayOperator(rt, grid, shape, cells)
    return Operator(made.forward, made.adjoint, (grid.shape, made.frames_shape), cells, lambda c: rays(rt, c, grid, shape))


def intensities(rt, cells) -> Operator:
    """The derivative of averaged intensities at a volume, whose weights are rounded on both ways."""
    made = IntensityOperator(rt, GRID, SHAPE, cells)
    made.expected(noise(GRID.shape, 7))
    return Operator(made.forward, made.adjoint, (GRID.shape, made.frames_shape), cells, slack=10)


def with_densities(rows: np.ndarray, densities: np.ndarray | float) -> np.ndarray:
    rows = rows.copy()
    rows[DENSITY] = densities
    return rows


def densities(rt, cells, rows: np.ndarray, shape: tuple[int, int] = SHAPE) -> Operator:
    """Densities of Gaussians to frames, all of every Gaussian. rows (11, G): without their densities."""

    def adjoint(y: np.ndarray) -> np.ndarray:
        pairs, ones = zip(cells, y, strict=True), with_densities(rows, 1.0)
        return sum(splat_gradients(rt, ones, table, h, cutoff_sigma=0.0)[DENSITY] for table, h in pairs)

    return Operator(
        lambda x: np.stack([splat(rt, with_densities(rows, x), table, shape, cutoff_sigma=0.0) for table in cells]),
        adjoint, ((rows.shape[1],), (len(cells), *shape)), cells, lambda c: densities(rt, c, rows, shape),
    )  # fmt: skip


def voxels(rt, rows: np.ndarray) -> Operator:
    """Densities of Gaussians to voxels."""
    made, ones = Voxeliser(rt, GRID.shape, cutoff_sigma=0.0), with_densities(rows, 1.0)
    return Operator(
        lambda x: made.voxelise(with_densities(rows, x), GRID), lambda y: made.voxelise_adjoint(ones, GRID, y)[DENSITY],
        ((rows.shape[1],), GRID.shape),
    )  # fmt: skip


def is_adjoint(operator: Operator, seed: int = 0) -> None:
    """⟨Ax, y⟩ = ⟨x, Aᵀy⟩ relative to both, for arrays that are nowhere negative."""
    x, y = (noise(shape, seed + n) for n, shape in enumerate(operator.shapes))
    there, back = operator.forward(x).astype(np.float64), operator.adjoint(y).astype(np.float64)
    assert np.isfinite(there).all() and np.isfinite(back).all()
    one, other = np.vdot(there, y), np.vdot(back, x)
    assert abs(one - other) <= operator.slack * ADJOINT * max(abs(one), abs(other))


def is_linear(operator: Operator, seed: int = 0) -> None:
    a, b = np.random.default_rng(seed).uniform(0.1, 3, 2).astype(np.float32)
    for apply, shape in zip((operator.forward, operator.adjoint), operator.shapes, strict=True):
        x, y = noise(shape, seed), noise(shape, seed + 1)
        expected = a * apply(x) + b * apply(y)
        assert_near(apply(a * x + b * y), expected, 10 * FLOAT32, max(expected.max(), 1e-6))


def only(table: TimeCells, cell: int) -> TimeCells:
    arrays = {f.name: v for f in fields(table) if isinstance(v := getattr(table, f.name), np.ndarray)}
    return replace(table, **{name: values[cell : cell + 1] for name, values in arrays.items()})


RAYS = {
    "static": ("static", "rows", "cone"), "per-row": ("common", "rows", "cone"), "leaning": ("static", "rows", "leaning"),
    "leaning per-row": ("common", "rows", "leaning"), "parallel": ("static", "rows", "parallel"),
    "parallel per-row": ("common", "columns", "parallel"), "intensities": ("common", "rows", "cone"),
    "own times": ("per line", "columns", "cone"), "micro-views": ("micro-views", "columns", "cone"),
}  # fmt: skip
NAMES = [*RAYS, *(f"splats {motion}" for motion in ("static", "micro-views", "exact", "per-row")), "voxels"]


@pytest.fixture
def make(make_geometry, make_cloud) -> Callable[[str, Runtime], Operator]:
    def make(name: str, rt: Runtime) -> Operator:
        if name in RAYS:
            motion, axis, beam = RAYS[name]
            cells = ray_tables(motion, SHAPE, axis, -1, 2, beam="cone" if beam == "leaning" else beam)
            cells = leaning(cells, 2.0, 3.0) if beam == "leaning" else cells
            return (intensities if name == "intensities" else rays)(rt, cells)
        rows = make_cloud(3, 5, scale=(0.15, 0.3))
        if name == "voxels":
            return voxels(rt, rows)
        cells = [frame_cells(name.removeprefix("splats "), make_geometry(*SHAPE), speed=speed) for speed in (0.5, 0.7)]
        return densities(rt, cells, rows)

    return make


@pytest.mark.parametrize("name", NAMES)
def test_every_operator_is_linear_and_has_its_adjoint(any_rt, make, name) -> None:
    operator = make(name, any_rt)
    is_adjoint(operator)
    is_linear(operator)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("intensities", "voxels")])
def test_frames_and_time_cells_add_up(rt, make, name) -> None:
    """Frames are those of operators of one frame; a frame is the sum of those of its cells; Aᵀ is the sum of theirs."""
    operator = make(name, rt)
    x, y = (noise(shape, n) for n, shape in enumerate(operator.shapes))
    there, back = operator.forward(x), operator.adjoint(y)
    assert there.any() and back.any()
    frames = [operator.of([table]) for table in operator.cells]
    assert_near(np.concatenate([one.forward(x) for one in frames]), there, NEAR)
    assert_near(sum(one.adjoint(y[f : f + 1]) for f, one in enumerate(frames)), back, NEAR)
    cells = [operator.of([only(operator.cells[0], k)]) for k in range(operator.cells[0].count)]
    assert_near(sum(one.forward(x) for one in cells), there[:1], NEAR)
    assert_near(sum(one.adjoint(y[:1]) for one in cells), frames[0].adjoint(y[:1]), NEAR)


many = settings(
    max_examples=1000 if STRESSED else 20, deadline=None, derandomize=True, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
seeds = st.integers(0, 2**32 - 1)


@st.composite
def tables(draw: st.DrawFn) -> tuple[tuple[int, int], list[TimeCells]]:
    """A detector's shape and the time cells of two frames of a random scanner round a volume of side 2."""
    shape = (draw(st.integers(1, 9)), draw(st.integers(1, 20)))
    distance = draw(st.floats(2.5, 20.0))
    magnification = draw(st.floats(1.05, 3.0))
    side = 3.0 * magnification
    offset = (draw(st.floats(-0.4, 0.4)), draw(st.floats(-0.4, 0.4)))
    pitch = (side / shape[0] * draw(st.floats(0.5, 1.5)), side / shape[1] * draw(st.floats(0.5, 1.5)))
    cone = ConeGeometry(distance, distance * magnification, shape, pitch, offset)
    geometry = ParallelGeometry(shape, pitch, offset) if draw(st.booleans()) else cone
    orbit = CircularOrbit(geometry, ConstantSpeed(draw(st.floats(-7, 7)), draw(st.floats(-2, 2))))
    axis, direction = draw(st.sampled_from(["rows", "columns"])), draw(st.sampled_from([1, -1]))
    shutter = Shutter(draw(st.floats(0.01, 1.0)), draw(st.floats(0.0, 1.0)), axis, direction)
    motion = draw(st.sampled_from(["static", "micro-views", "per-row"]))
    found = []
    for frame in range(2):
        where = (orbit, shutter, frame, 1.7 * frame, shutter.lines(shape))
        if motion == "static":
            found.append(static_cells(*where))
        elif motion == "micro-views":
            found.append(micro_view_cells(*where, draw(st.integers(1, 4)), draw(st.integers(1, 3))))
        else:
            found.append(per_line_cells(*where, draw(st.integers(1, 3))))
    return shape, found


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    """Up to some thousand voxels, about as large as a volume of side 2, anywhere near the axis."""
    shape = tuple(draw(st.integers(1, 14)) for _ in range(3))
    size = tuple(draw(st.floats(0.8, 2.2)) / n for n in shape)
    offset = tuple(draw(st.floats(-0.3, 0.3)) for _ in range(3))
    return Grid(shape, size, offset)  # type: ignore[arg-type]


@pytest.mark.slow
@many
@given(scanner=tables(), grid=grids(), seed=seeds)
def test_rays_and_splats_of_random_scanners(rt, make_cloud, scanner, grid, seed) -> None:
    shape, cells = scanner
    rows = make_cloud(4, seed, spread=0.7, scale=(0.08, 0.5))
    for operator in (rays(rt, cells, grid, shape), densities(rt, cells[:1], rows, shape)):
        is_adjoint(operator, seed)
        is_linear(operator, seed)


@many
@given(scanner=tables(), seed=seeds)
def test_the_gradient_is_the_derivative(rt, make_cloud, scanner, seed) -> None:
    """Along a random direction of all parameters, against central differences of the float64 twin."""
    shape, (cells, _) = scanner
    rng, rows = np.random.default_rng(seed), make_cloud(2, seed, spread=0.7, scale=(0.15, 0.5))
    h = rng.normal(size=shape).astype(np.float32)
    direction = rng.normal(size=rows.shape) * np.where(np.arange(11)[:, None] < 6, 0.1, 1.0)
    ends = [float((h * splat_frame(rows + s * 1e-5 * direction, cells, shape)).sum()) for s in (1, -1)]
    gradient = splat_gradients(rt, rows, cells, h, cutoff_sigma=0.0).astype(np.float64)
    size = np.linalg.norm(gradient * direction)  # of what is added up, which may nearly cancel
    found, expected = float(np.vdot(gradient, direction)), (ends[0] - ends[1]) / 2e-5
    assert abs(found - expected) <= 2 * GRADIENT * max(size, 1e-3)


@pytest.mark.parametrize("name", ["total variation", "cosine blocks"])
def test_proximal_maps_are_odd_homogeneous_and_bring_no_two_volumes_apart(any_rt, name) -> None:
    """And a constant passes through them."""
    if name == "total variation":
        prox = lambda x, weight: TvProx(any_rt, GRID.shape, (1.0, 1.0, 1.0))(x, weight, 15, nonnegative=False)  # noqa: E731
    else:
        prox = lambda x, weight: DctProx(any_rt, GRID.shape)(x, weight, 0, nonnegative=False)  # noqa: E731
    x, y = noise(GRID.shape, 1), noise(GRID.shape, 2)
    mapped = prox(x, 0.1)
    assert np.abs(mapped - x).max() > 0.05
    assert_near(prox(-x, 0.1), -mapped, FLOAT32)
    assert_near(prox(2 * x, 0.2), 2 * mapped, FLOAT32)
    assert_near(prox(x + 3, 0.1), mapped + 3, FLOAT32)
    assert np.linalg.norm(mapped - prox(y, 0.1)) <= np.linalg.norm(x - y)
