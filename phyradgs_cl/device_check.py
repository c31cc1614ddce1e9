"""Compares every kernel on a device, on small problems, with its twin: the same mathematics in float64 NumPy on the host.

Gradients are compared with central differences of the twins. The limits are several times the rounding of float32, and far
below the error of a wrong kernel."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from phyradgs_cl import operators
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.cells import common_time_cells, exact_cells, micro_view_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.device_probes import PAIRS, carried, pair_error
from phyradgs_cl.errors import DeviceError, OutOfMemoryError
from phyradgs_cl.fields import Activation, Deformation, Grid
from phyradgs_cl.fields.gaussians import DENSITY, MEAN, QUATERNION, SCALE
from phyradgs_cl.objective import terms
from phyradgs_cl.objective.dct_prox import DctProx, dct_prox
from phyradgs_cl.objective.ridge import RidgeStep, learned_ridge, ridge_step
from phyradgs_cl.objective.tv import TvDescent, TvProx, tv_descent, tv_prox
from phyradgs_cl.operators.splats.binning import TileLists
from phyradgs_cl.operators.splats.states import CloudStates, states_of
from phyradgs_cl.operators.twins import rays as twins
from phyradgs_cl.operators.twins.rays import deformed_frame, warp_adjoint, warp_forward
from phyradgs_cl.operators.twins.splat import moving_frame, splat_frame, splat_image, voxel_field
from phyradgs_cl.operators.warp.backproject import MovingBackprojector
from phyradgs_cl.operators.warp.operator import WarpedOperator
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.operators.warp.volume import VolumeWarp
from phyradgs_cl.optim import DeviceAdam, adam_step
from phyradgs_cl.runtime import DeviceSpace, HostSpace, Runtime
from phyradgs_cl.runtime.layout import pad_rows, pitch_of, unpad_rows

VALUE, GRADIENT = 1e-4, 1e-3  # largest differences of values and gradients from the twin's, relative to the twin's largest
_GRIDDED = 5e-3  # largest relative difference from the twin where a kernel interpolates a deformation's inverse from a grid
SHAPE, GRID = (9, 12), Grid((5, 7, 6), (0.3, 0.24, 0.28), (0.1, -0.05, 0.1))
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (3.9 / 9, 4.1 / 12), (0.1, 0.2))
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 0.5))
PARALLEL = CircularOrbit(ParallelGeometry(SHAPE, (2.6 / 9, 2.7 / 12), (0.1, 0.2)), ConstantSpeed(0.3, 0.5))
UNIT = 2.0  # to kernels that average intensities exp(−line integral), a pixel of value p means the line integral UNIT · p
STEP = 1e-6  # step of central differences to each side
Comparison = tuple[np.ndarray, np.ndarray, float]
"""The computed and the expected numbers, and the largest difference allowed, relative to the largest expected number."""


@dataclass(frozen=True)
class Verdict:
    """The result of a device's check.

    agreeing: the kernels that agree with their twins. failures: for each check that failed, a text that names the suspected
    kernels. group_limits: for each kernel that uses work-groups, the largest group in work-items that the driver allows."""

    device: str
    agreeing: frozenset[str]
    failures: tuple[str, ...]
    group_limits: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.failures:
            return f"{self.device} can be trusted: all {len(self.agreeing)} kernels agree with float64"
        return f"{self.device} cannot be trusted: {'; '.join(self.failures)}"


def check_device(device: str | None = None, **launch_shape: bool | int) -> Verdict:
    """Builds and runs every kernel on ``device`` (None: the best) and compares it with its twin. Others: as in Runtime."""
    agreeing: set[str] = set()
    failures: list[str] = []
    limits: dict[str, int] = {}
    for check in CHECKS:
        rt = Runtime(device, **launch_shape)  # type: ignore[arg-type]  # a new Runtime for each check: its list of built kernels then says which ones this check ran
        if problem := _problem(check, rt, agreeing):
            suspects = sorted(rt.built_kernels - agreeing) or sorted(rt.built_kernels)
            failures.append(f"{', '.join(suspects)} ({problem})" if suspects else problem)
        limits |= rt.group_limits
    return Verdict(rt.device.name, frozenset(agreeing), tuple(failures), limits)


def _problem(check: Callable[[Runtime], Iterator[Comparison]], rt: Runtime, agreeing: set[str]) -> str:
    """Runs ``check`` up to its first problem, and returns the problem in words, "" without one. Adds to ``agreeing`` the
    kernels that had run by the last comparison within its limit."""
    try:
        for computed, expected, limit in check(rt):
            off = float(np.abs(np.asarray(computed, np.float64) - expected).max() / (np.abs(expected).max() or 1.0))
            if not off <= limit:
                return f"off by {off:.1e}, at most {limit:.0e}"
            agreeing |= rt.built_kernels
    except (DeviceError, OutOfMemoryError) as error:
        return str(error)
    return ""


def _algebra(rt: Runtime) -> Iterator[Comparison]:
    host, there = HostSpace(), DeviceSpace(rt)
    a, b, c = (_noise((3, 1999), seed) - np.float32(0.3) for seed in range(3))
    x, y, z = there.array(a), there.array(b), there.array(c)
    yield there.numpy(there.add(x, y, 0.7, nonnegative=True)), host.add(a, b, 0.7, nonnegative=True), VALUE
    yield there.numpy(there.add_product(x, y, z, 0.7)), host.add_product(a, b, c, 0.7), VALUE
    yield there.numpy(there.multiply(x, y)), host.multiply(a, b), VALUE
    yield there.numpy(there.reciprocal(x, 0.01)), host.reciprocal(a, 0.01), VALUE
    yield there.numpy(there.extrapolate(x, y, 0.7)), host.extrapolate(a, b, 0.7), VALUE
    yield np.array(there.inner(x, y)), np.array(host.inner(a, b)), VALUE
    yield np.array(there.turn(x, y, z)), np.array(host.turn(a, b, c)), VALUE
    yield np.array(there.largest(x, absolute=True)), np.array(host.largest(a, absolute=True)), VALUE
    yield there.numpy(there.descend(x, y, 0.7)), a - 0.7 * b / host.norm(b), VALUE
    out = rt.zeros(64)
    rt.launch(rt.kernel("rates", "multiply_add"), 64, 3, np.float32(0.5), out, group=rt.group())
    chains = 0.5**3 * (np.arange(64)[:, None] % 7 + np.arange(8)) + 1 - 0.5**3
    yield rt.download(out), rt.lanes * chains.sum(1), VALUE


def _numbers(rt: Runtime) -> Iterator[Comparison]:
    """Checks what kernels rely on: whole numbers in local memory, and pairs of floats if the device lacks float64."""
    error = pair_error(rt)
    yield np.array(0.0 if rt.fp64 else error), np.zeros(()), PAIRS
    yield np.array(float(carried(rt)[0])), np.ones(()), 0.0


def _binning(rt: Runtime) -> Iterator[Comparison]:
    rng, tile, tiles, count = np.random.default_rng(1), (4, 3, 2), (3, 4, 2), 700
    extents = np.zeros((6, 704), np.int32)
    for axis, size in enumerate(np.multiply(tile, tiles)):
        extents[2 * axis : 2 * axis + 2] = np.sort(rng.integers(0, size, (2, 704)), axis=0)
    extents[1, ::5] = extents[0, ::5] - 1  # an empty interval: this Gaussian is in no tile
    lists = TileLists(rt, tile, tiles)
    lists.build(rt.upload(extents), count, 704)
    first, last = (extents[k::2, :count] // np.array(tile)[:, None] for k in (0, 1))
    seen = extents[1, :count] >= extents[0, :count]
    expected = [
        np.flatnonzero(seen & np.all((at >= first.T) & (at <= last.T), axis=1))
        for at in ((i, j, k) for k in range(tiles[2]) for j in range(tiles[1]) for i in range(tiles[0]))
    ]
    starts = np.cumsum([0, *map(len, expected)])
    yield rt.download(lists.tile_offsets), starts, 0.0
    yield rt.download(lists.splat_ids)[: starts[-1]], np.concatenate(expected), 0.0


def _splats(rt: Runtime) -> Iterator[Comparison]:
    for table in (*_tables(), *_tables(PARALLEL)):
        frame = splat_frame if table.end_poses is None else moving_frame
        for affine in (False, True):
            twin = partial(frame, table=table, detector_shape=SHAPE, affine=affine)
            yield from _frame_and_gradients(rt, table, twin, affine=affine)


def _splats_of_moving_objects(rt: Runtime) -> Iterator[Comparison]:
    control, times_s = 0.2 * (_noise((2, 4, 4, 4, 3), 24) - 0.5), np.array([0.0, 2.0])
    one = Deformation(control, (-0.8,) * 3, 0.5, times_s, np.array([[1.0, 0.5], [-0.5, 1.0]]))
    for table in _tables()[1:]:
        twin = partial(deformed_frame, table=table, detector_shape=SHAPE, deformation=one)
        yield from _frame_and_gradients(rt, table, twin, one)


def _layered_splats(rt: Runtime) -> Iterator[Comparison]:
    table = _tables()[1]

    def twin(rows: np.ndarray) -> np.ndarray:
        light = np.zeros(SHAPE)
        for pose, weight, start, stop in zip(table.pose, table.weight, table.line_start, table.line_stop, strict=True):
            light[:, start:stop] += weight * np.exp(-UNIT * splat_image(rows, pose, SHAPE)[:, start:stop])
        return -np.log(light) / UNIT

    yield from _frame_and_gradients(rt, table, twin, intensity_unit=UNIT)


def _frame_and_gradients(
    rt: Runtime, table: TimeCells, twin: Callable[[np.ndarray], np.ndarray], deformation: Deformation | None = None,
    **options: float | bool,
) -> Iterator[Comparison]:
    rows, h, shape = _cloud(3 if deformation is None else 1), _noise(SHAPE, 2), table.readout.shape(SHAPE)
    states = None if deformation is None else CloudStates(rt, deformation)
    of_cells = None if deformation is None else states_of(table, deformation)
    cells = operators.DeviceCells.upload(rt, table, of_cells)
    exactly = {"cutoff_sigma": 0.0, "time_error": 1e-6, **options}
    projector = operators.SplatProjector(rt, *shape, states=states, **exactly)  # type: ignore[arg-type]
    yield table.readout.frames(projector.project(rows, cells)), twin(rows), VALUE
    found = projector.project_adjoint(rows, cells, table.readout.frames(h))
    yield from _by_class(found, _differences(twin, rows, h))


def _plain_splats(rt: Runtime) -> Iterator[Comparison]:
    rows, h = _cloud(), _noise((1, *SHAPE), 3)
    rows[QUATERNION] *= 1.7
    for axis in ("rows", "columns"):
        table = static_cells(ORBIT, Shutter(0.8, 0.6, axis), 0, 0.2, SHAPE[axis == "columns"])
        operator = operators.SplatProjection(rt, SHAPE, [table], 0.7, cutoff_sigma=0.0)
        point = operator.rows.enter(rt.upload(rows, np.float32))
        yield rt.download(operator.forward(point))[0], splat_frame(rows, table, SHAPE), VALUE
        found = rt.download(operator.back(point, rt.upload(h)))
        yield from _by_class(found, _differences(partial(splat_frame, table=table, detector_shape=SHAPE), rows, h))
    ones = rows.copy()
    ones[DENSITY] = 1
    densities = rt.upload(ones[DENSITY], np.float32)
    found = rt.download(operator.forward(operator.rows.with_densities(point, densities)))
    yield found[0], splat_frame(ones, table, SHAPE), VALUE


def _voxels(rt: Runtime) -> Iterator[Comparison]:
    rows, h = _cloud(), _noise(GRID.shape, 4)
    voxeliser = operators.Voxeliser(rt, GRID.shape, cutoff_sigma=0.0)
    yield voxeliser.voxelise(rows, GRID), voxel_field(rows, *GRID.axes_mm()), VALUE
    found = voxeliser.voxelise_adjoint(rows, GRID, h)
    yield from _by_class(found, _differences(lambda r: voxel_field(r, *GRID.axes_mm()), rows, h))


def _rays(rt: Runtime) -> Iterator[Comparison]:
    volume, frames = _noise(GRID.shape, 5), _noise((1, *SHAPE), 13)
    still, table, _ = _tables()
    tall = (32, 5)  # rows and columns: enough rows to fill a CPU's widest vectors
    orbit = CircularOrbit(ConeGeometry(5.0, 7.5, tall, (3.9 / 32, 4.1 / 5)), ConstantSpeed(0.3, 0.5))
    upright = static_cells(orbit, Shutter(0.8, 0.6), 0, 0.2, tall[0])
    common = common_time_cells(orbit, Shutter(0.8, 0.6), 0, np.array([0.2]), tall[0], 3)
    leaning = replace(common, pose=common.pose.copy())
    leaning.pose[:, 9:12] += 0.02 * common.pose[:, 6:9]
    parallel = CircularOrbit(ParallelGeometry(tall, (2.6 / 32, 2.7 / 5)), ConstantSpeed(0.3, 0.5))
    along = common_time_cells(parallel, Shutter(0.8, 0.6), 0, np.array([0.2]), tall[0], 3)
    inclined = replace(along, pose=along.pose.copy())
    inclined.pose[:, 9:12] += 0.02 * along.pose[:, 6:9]
    of_tall = ((cells, tall) for cells in (upright, common, leaning, along, inclined))
    for cells, shape in ((still, SHAPE), (table, SHAPE), (_tables(PARALLEL)[1], SHAPE), *of_tall):
        y = _noise((1, *shape), 6)
        operator = operators.RayOperator(rt, GRID, shape, [cells])
        yield operator.forward(volume)[0], twins.ray_frame(volume, GRID, cells, shape), VALUE
        yield operator.adjoint(y), twins.ray_volume(y[0], GRID, cells), VALUE
    on_device, pair = rt.upload(volume), (3, 2)
    finer, blocks = still.finer(*pair), (1, SHAPE[0], pair[0], SHAPE[1], pair[1])
    operator = operators.RayOperator(rt, GRID, SHAPE, [still], subrays=pair)
    expected = twins.ray_frame(volume, GRID, finer, (pair[0] * SHAPE[0], pair[1] * SHAPE[1]))
    yield rt.download(operator.forward(on_device)), expected.reshape(blocks).mean((2, 4)), VALUE
    shares = np.kron(frames[0], np.ones(pair)) / np.prod(pair)
    yield rt.download(operator.adjoint(rt.upload(frames))), twins.ray_volume(shares, GRID, finer), VALUE
    intensity = operators.IntensityOperator(rt, GRID, SHAPE, [table])
    mean, averaged = (twins.ray_frame(volume, GRID, table, SHAPE, model) for model in ("log", "intensity"))
    yield rt.download(intensity.forward(on_device))[0], mean, VALUE  # it averages line integrals until ``expected`` runs
    yield rt.download(intensity.expected(on_device))[0], averaged, VALUE
    found = rt.download(intensity.adjoint(rt.upload(frames)))
    yield found, twins.intensity_volume(frames[0], volume, GRID, table), VALUE


def _warps(rt: Runtime) -> Iterator[Comparison]:
    """Checks ``VolumeWarp``, its transpose and ``WarpedOperator``, with a small deformation that keeps neighbouring voxels
    neighbours, and with a large one that scatters them."""
    volume, times_s = _noise(GRID.shape, 22), np.array([0.0, 1.0, 2.0])
    for size_mm in (0.1, 3.0):
        control_mm = size_mm * (_noise((2, 5, 5, 5, 3), 20) - 0.5)
        weights = np.array([[1.0, 0.5], [0.3, -1.0], [0.0, 0.2]])
        states = MotionStates.of_times(Deformation(control_mm, (-1.0,) * 3, 0.5, times_s, weights), GRID, times_s)
        fields = states.fields_mm / GRID.voxel_size_mm[::-1]
        warp = VolumeWarp(rt, states)
        for state, weights in enumerate(states.weights):
            displacement = np.tensordot(weights, fields, 1)
            moved = rt.download(warp.forward(state, warp.source(rt.upload(volume))))
            yield moved, warp_forward(volume, displacement), VALUE
            rt.write(warp.moved(), moved)
            total, back = warp.zeros(), rt.empty(GRID.shape)
            warp.adjoint(state, warp.moved(), total)
            warp.read(total, back)
            yield rt.download(back), warp_adjoint(moved, displacement), VALUE
    tables = [static_cells(ORBIT, Shutter(0.8, 0.6), 0, start_s, SHAPE[0]) for start_s in (0.2, 1.2)]
    operator = WarpedOperator(rt, GRID, SHAPE, tables, warp=VolumeWarp(rt, states))
    shares = states.shares(np.concatenate([table.time_s for table in tables]))
    expected = [
        sum(
            share * twins.ray_frame(warp_forward(volume, np.tensordot(weights, fields, 1)), GRID, table, SHAPE)
            for share, weights in zip(of_states, states.weights, strict=True)
        )
        for of_states, table in zip(shares, tables, strict=True)
    ]
    yield operator.forward(volume), np.stack(expected), VALUE


def _backprojections(rt: Runtime) -> Iterator[Comparison]:
    frames, weight, angles = _noise((3, *SHAPE), 7), np.array([0.5, 0.8, 1.0]), np.array([0.0, 1.3, 2.9])
    for tilt in (0.0, 0.02, 0.6):
        pose = GEOMETRY.pose(angles)
        pose[:, 9:12] += tilt * pose[:, 6:9]
        seen = frames, pose, weight, GRID
        yield operators.backproject(rt, *seen), twins.backprojection(*seen), VALUE
    lines = np.stack([GEOMETRY.pose(a + np.linspace(-0.1, 0.1, SHAPE[0])) for a in angles])
    seen = frames, lines, weight, GRID
    yield operators.backproject_lines(rt, *seen), twins.lines_backprojection(*seen), VALUE


def _moving_backprojections(rt: Runtime) -> Iterator[Comparison]:
    frames, weight, angles = _noise((3, *SHAPE), 7), np.array([0.5, 0.8, 1.0]), np.array([0.0, 1.3, 2.9])
    control_mm, times_s = 0.2 * (_noise((2, 6, 6, 6, 3), 23) - 0.5), np.array([0.0, 1.0, 2.0])
    phases = np.array([[1.0, 0.0], [0.4, 0.3], [-0.5, 0.7]])
    states = MotionStates.of_times(Deformation(control_mm, (-2.0,) * 3, 0.8, times_s, phases), GRID, times_s)
    shares = states.shares(np.array([0.0, 0.5, 1.4]))
    inverse_mm = [states.deformation.inverse_on_grid_mm(GRID, weights) for weights in states.weights]
    push_mm = np.tensordot(shares, inverse_mm, 1)
    moving = MovingBackprojector(rt, states, shares)
    pose = GEOMETRY.pose(angles)
    expected = twins.backprojection(frames, pose, weight, GRID, push_mm=push_mm)
    yield moving(frames, pose, weight, GRID), expected, _GRIDDED
    lines = np.stack([GEOMETRY.pose(a + np.linspace(-0.1, 0.1, SHAPE[0])) for a in angles])
    expected = twins.lines_backprojection(frames, lines, weight, GRID, push_mm=push_mm)
    yield moving(frames, lines, weight, GRID), expected, _GRIDDED


def _image_terms(rt: Runtime) -> Iterator[Comparison]:
    rendered, measured = _noise(SHAPE, 8), _noise(SHAPE, 9)
    mask = (_noise(SHAPE, 11) > 0.2).astype(np.float32)
    weights = 0.25, 1.0
    loss = terms.ImageLoss(rt, *SHAPE, pitch_of(SHAPE[1]), *weights)
    x, y, m = (rt.upload(pad_rows(image)) for image in (rendered, measured, mask))
    found = rt.download(loss.evaluate(x, y, m, float(mask.sum())))
    wide = rendered.astype(np.float64), measured.astype(np.float64), mask.astype(np.float64)
    value, gradient = terms.image_loss(*wide, *weights)
    yield unpad_rows(found, SHAPE), gradient, VALUE
    yield np.array(loss.value()), np.array(value), VALUE


def _variation(rt: Runtime) -> Iterator[Comparison]:
    volume = _noise(GRID.shape, 12)
    term = terms.TotalVariation(rt, GRID.shape, pitch_of(GRID.shape[2]))
    gradient = rt.download(term.evaluate(rt.upload(pad_rows(volume))))
    value, expected = terms.total_variation(volume)
    yield unpad_rows(gradient, GRID.shape), expected, VALUE
    yield np.array(term.value()), np.array(value), VALUE
    yield TvDescent(rt, GRID.shape)(volume, 0.1, 2), tv_descent(volume, 0.1, 2), VALUE
    found = TvProx(rt, GRID.shape)(volume, 0.2, 4, nonnegative=True)
    yield found, tv_prox(volume, 0.2, 4, nonnegative=True), VALUE
    states, weights = np.stack([volume, volume[::-1]]), (2.0, 1.0, 1.0, 1.0)
    found = TvProx(rt, states.shape, weights)(states, 0.2, 4, nonnegative=True)
    yield found, tv_prox(states, 0.2, 4, nonnegative=True, axis_weights=weights), VALUE
    yield DctProx(rt, GRID.shape)(volume, 0.2, 1, nonnegative=True), dct_prox(volume, 0.2, 1, nonnegative=True), VALUE
    descended = RidgeStep(rt, GRID.shape, learned_ridge())(volume, 0.1, 0.3, nonnegative=False)
    yield descended, ridge_step(volume, 0.1, 0.3, ridge=learned_ridge(), nonnegative=False), VALUE


def _optimiser(rt: Runtime) -> Iterator[Comparison]:
    activation, stride, count = Activation(0.01, 0.6), 16, 16
    raw = activation.invert(_cloud(count)).astype(np.float32).astype(np.float64)
    raw[QUATERNION] *= 1.7
    adam, on_device = DeviceAdam(rt, activation), rt.upload(raw, np.float32)
    parameters, gradients, statistics = (rt.zeros((n, stride)) for n in (11, 13, 2))
    adam.activate(on_device, parameters, count, stride)
    yield rt.download(parameters), activation.apply(raw), VALUE
    adam.chain(on_device, parameters, gradients, statistics, count, stride, density_weight=0.3)
    found = rt.download(gradients)[:11]
    value = lambda rows: np.array(terms.mean_density(activation.apply(rows), 0.3)[0])  # noqa: E731
    yield found, _differences(value, raw), GRADIENT
    rates, moments = np.linspace(0.01, 0.03, 11), rt.zeros((2, 11, stride))
    adam.step(on_device, gradients, moments, stride, rates, 1)
    expected = adam_step(raw, found.astype(np.float64), np.zeros((2, 11, stride)), rates, 1)
    yield rt.download(on_device) - raw, expected[0] - raw, GRADIENT
    yield rt.download(moments), expected[1], VALUE


CHECKS = (
    _numbers, _algebra, _binning, _splats, _splats_of_moving_objects, _layered_splats, _plain_splats, _voxels, _rays, _warps,
    _backprojections, _moving_backprojections, _image_terms, _variation, _optimiser,
)  # fmt: skip
"""All checks. A kernel that agreed in a check is not suspected in later ones. So kernels that others rely on come first."""


def _noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)


def _cloud(count: int = 3) -> np.ndarray:
    """Returns parameters (11, ``count``) of random Gaussians, in float64. Float32 can hold each of these values exactly."""
    rng = np.random.default_rng(count)
    turn = rng.normal(size=(4, count))
    parts = [
        rng.uniform(-0.5, 0.5, (3, count)), rng.uniform(0.1, 0.4, (3, count)),
        turn / np.linalg.norm(turn, axis=0), rng.uniform(0.5, 1.5, (1, count)),
    ]  # fmt: skip
    return np.concatenate(parts).astype(np.float32).astype(np.float64)


def _tables(orbit: CircularOrbit = ORBIT) -> tuple[TimeCells, TimeCells, TimeCells]:
    """Returns a frame's time cells in three kinds: a single pose, micro-views, and segments in which the gantry moves."""
    rolling = orbit, Shutter(0.8, 0.6, "columns", -1), 0, 0.2, SHAPE[1]
    still = static_cells(orbit, Shutter(0.8, 0.6), 0, 0.2, SHAPE[0])
    return still, micro_view_cells(*rolling, 3, 2), exact_cells(*rolling, 3)


def _differences(
    function: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, h: np.ndarray | float = 1.0
) -> np.ndarray:
    """Returns derivatives (11, G) of Σ ``h`` · ``function(rows)`` by the Gaussians' ``rows``, by central differences."""
    result = np.zeros_like(rows)
    for index in np.ndindex(*rows.shape):
        ends = []
        for sign in (1, -1):
            moved = rows.copy()
            moved[index] += sign * STEP
            ends.append((h * function(moved)).sum())
        result[index] = (ends[0] - ends[1]) / (2 * STEP)
    return result


def _by_class(found: np.ndarray, expected: np.ndarray) -> Iterator[Comparison]:
    """Yields a comparison of gradients (11, G) for each kind of parameter, because the kinds' magnitudes differ."""
    for part in (MEAN, SCALE, QUATERNION, DENSITY):
        yield found[part], expected[part], GRADIENT
