"""Operators of whole scans: from voxels or Gaussians to frames, and from Gaussians to voxels."""

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, OwnTimes, PerRow, Scan
from phyradgs_cl.acquisition import motion as models
from phyradgs_cl.api.operators import (
    Device,
    LinearOperator,
    Map,
    Operator,
    Shape,
    Values,
    computed,
    moved_to,
    runtime_of,
)
from phyradgs_cl.api.runs import check_scan
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.fields.gaussians import QUATERNION, ROWS, SCALE
from phyradgs_cl.operators import DensityOperator, RayOperator, SplatOperator, VoxelOperator
from phyradgs_cl.operators import voxelise as voxelise_rows
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.operators.splats.projector import DEFAULT_CUTOFF_SIGMA, DEFAULT_TIME_ERROR
from phyradgs_cl.reconstructors.splats.method import first_cloud
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.step import tables_of
from phyradgs_cl.runtime import DeviceArray, Runtime

_FRAMES, _VOLUME, _ROWS, _DENSITY = "frames", "volume", "rows", "density"


@naming_arguments()
def ray_operator(
    scan: Scan, motion: str | Motion = "per-row", *, grid: Grid | None = None, device: Device = None
) -> LinearOperator:
    """Returns Joseph's projector of a scan: volumes (nz, ny, nx) in 1/mm to frames (F, rows, columns), and its transpose.

    motion: the motion model of docs/methods.md, any except ``exact``, or an object of your class. grid: the voxels; None
    is the scan's grid. device: what ``--device`` takes, or a Runtime. ``intensity`` of the result is for detectors that
    average photons. Joseph, IEEE Trans. Med. Imaging 1 (1982) 192.

    Raises InputError for anything but a Scan or a Grid, for an unknown motion, and for one that only splats support."""
    model, voxels = _checked(scan, motion, models.RAYS), scan.grid if grid is None else _a_grid(grid)
    tables = [model.cells(scan, frame).still() for frame in range(scan.frames)]
    like = runtime_of(device), voxels, scan.geometry.detector_shape, tables
    return _rays(RayOperator(*like, subrays=subrays_of(voxels, tables)))


def _rays(engine: RayOperator) -> LinearOperator:
    return LinearOperator(
        engine.rt,
        (_VOLUME, engine.volume_shape),
        (_FRAMES, engine.frames_shape),
        engine.forward,
        engine.adjoint,
        frames=lambda chosen: _rays(engine.subset(chosen)),
        intensity=lambda: _intensities(
            engine.rt,
            IntensityOperator(
                engine.rt, engine.grid, engine.detector_shape, engine.tables, subrays=engine.memory.layout.subrays
            ),
        ),
    )


def _intensities(rt: Runtime, engine: IntensityOperator) -> Operator:
    def at(volume: Values) -> tuple[Values, Map]:
        own, on_device = copy(engine), isinstance(volume, DeviceArray)  # the copy keeps the derivative at this volume

        def adjoint(frames: Values) -> Values:
            return _in_new_memory(rt, own.adjoint, frames, engine.volume_shape)

        expected = _in_new_memory(rt, own.expected, volume, engine.frames_shape)
        return expected, partial(computed, rt, on_device, adjoint)

    domain, frames = (_VOLUME, engine.volume_shape), (_FRAMES, engine.frames_shape)
    return Operator(rt, domain, frames, at, frames=lambda chosen: _intensities(rt, engine.subset(chosen)))


def _in_new_memory(rt: Runtime, function: Callable[..., Any], values: Values, shape: tuple[int, ...]) -> Values:
    """Returns ``function(values)`` in a new array: the engine reuses its memory while views of it may exist."""
    return function(values, rt.empty(shape)) if isinstance(values, DeviceArray) else function(values)


@naming_arguments()
def splat_operator(
    scan: Scan, motion: str | Motion = "exact", *, affine: bool = False,
    cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, device: Device = None,
) -> "SplatProjection":
    """Returns a scan's projector Φ (PhyRadGS, Eq. 3): ``Gaussians`` or rows (11, G) to frames (F, rows, columns).

    The rows are mean x y z and three scales in mm, quaternion w x y z of any length, density in 1/mm. motion: a model of
    docs/methods.md that splats support. affine: use R2-Gaussian's approximation. cutoff_sigma: the Mahalanobis radius at
    which a Gaussian ends; 0 never cuts. device: what ``--device`` takes, or a Runtime. ``of_densities(gaussians)`` of the
    result is its linear part: densities (G,) to frames.

    Raises InputError for anything but a Scan, for an unknown motion, and for a cutoff out of range."""
    model = _checked(scan, motion, models.RAYS, models.SPLATS)
    if type(model) is PerRow:  # splats cannot weigh the lines of a cell differently: each line gets cells of its own
        model = OwnTimes(model.of(scan).sub_intervals)
    _check_cutoff(cutoff_sigma)
    rt = runtime_of(device)

    def engine(detector: str, chosen: Sequence[int]) -> SplatOperator:
        tables, merges = tables_of(scan, model, detector)
        return SplatOperator(
            rt, scan.geometry.detector_shape, [tables[f] for f in chosen], scan.grid.half_longest_mm,
            intensity=merges, affine=affine, cutoff_sigma=cutoff_sigma,
            time_error=getattr(model, "time_error", DEFAULT_TIME_ERROR),
        )

    everything = range(scan.frames)
    return SplatProjection(engine("log", everything), everything, partial(engine, "intensity"))


class GaussianOperator(Operator):
    """An ``Operator`` on Gaussians, or on their parameter rows (11, G)."""

    def __init__(self, engine: SplatOperator | VoxelOperator, range_: tuple[str, Shape], **parts: Any) -> None:
        self._engine = engine
        super().__init__(engine.rt, (_ROWS, (ROWS, None)), range_, self._at_rows, **parts)

    def _at_rows(self, rows: Values) -> tuple[Values, Map]:
        rt, engine = self.rt, self._engine
        point = engine.rows.enter(moved_to(rt, rows, True))
        y = moved_to(rt, engine.forward(point), isinstance(rows, DeviceArray))
        return y, partial(computed, rt, True, partial(engine.back, point))

    def _to_array(self, side: tuple[str, Shape], values: Any) -> Values:
        array = super()._to_array(side, values.rows() if isinstance(values, Gaussians) else values)
        if isinstance(array, np.ndarray) and side is self._domain:
            _check_rows(array)
        return array


class SplatProjection(GaussianOperator):
    """The ``Operator`` from Gaussians to frames that ``splat_operator`` returns."""

    _instead = f"of_densities(gaussians) is linear in densities; {Operator._instead}"

    def __init__(
        self, engine: SplatOperator, chosen: Sequence[int], intensity: Callable[[Sequence[int]], SplatOperator] | None
    ) -> None:
        """Takes an engine for the ``chosen`` frames; ``intensity`` makes one that averages photons in given frames."""
        self._splats = engine
        super().__init__(
            engine, (_FRAMES, engine.frames_shape),
            frames=lambda few: SplatProjection(engine.subset(few), [chosen[f] for f in few], intensity),
            intensity=None if intensity is None else lambda: SplatProjection(intensity(chosen), chosen, None),
        )

    def by_poses(self, gaussians: Any, by_frames: Any) -> np.ndarray:
        """Returns dL/d(turn in rad, shifts along columns and rows in pixels), (F, 3), from dL/dframes (F, rows, columns).
        Raises InputError for an operator that averages intensities."""
        rt, engine = self.rt, self._splats
        if engine.is_layered:
            raise InputError("by_poses", "averages of intensity", "averages of line integrals")
        point = engine.rows.enter(moved_to(rt, self._to_array(self._domain, gaussians), True))
        return engine.by_poses(point, moved_to(rt, self._to_array(self._range, by_frames), True))

    def of_densities(self, gaussians: Gaussians) -> LinearOperator:
        """Returns the linear operator from densities (G,) in 1/mm to frames; centres and shapes are those of ``gaussians``.
        Raises InputError for an operator that averages intensities, which is not linear."""
        rt, engine, rows = self.rt, self._splats, self._to_array(self._domain, gaussians)
        if engine.is_layered:
            raise InputError("of_densities", "averages of intensity", "averages of line integrals, which are linear")
        linear = DensityOperator(engine, engine.rows.enter(moved_to(rt, rows, True)))
        return _densities(rt, linear, rows.shape[1], engine.frames_shape)


def _densities(rt: Runtime, engine: DensityOperator, count: int, frames_shape: Shape) -> LinearOperator:
    return LinearOperator(
        rt, (_DENSITY, (count,)), (_FRAMES, frames_shape), partial(computed, rt, True, engine.forward),
        partial(computed, rt, True, engine.adjoint),
        frames=lambda few: _densities(rt, engine.subset(few), count, (len(few), *frames_shape[1:])),
    )


@naming_arguments()
def voxel_operator(grid: Grid, *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, device: Device = None) -> Operator:
    """Returns the operator from Gaussians, or parameter rows (11, G), to their volume (nz, ny, nx) in 1/mm on ``grid``.

    The field is evaluated at the voxels' centres in mm, and the device holds the whole volume. cutoff_sigma, device: those
    of ``splat_operator``.

    Raises InputError for anything but a Grid, and for a cutoff out of range."""
    _check_cutoff(cutoff_sigma)
    engine = VoxelOperator(runtime_of(device), _a_grid(grid), cutoff_sigma=cutoff_sigma)
    return GaussianOperator(engine, (_VOLUME, grid.shape))


@naming_arguments()
def voxelise(
    gaussians: Gaussians, grid: Grid, *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, device: Device = None
) -> np.ndarray:
    """Returns the field of a cloud at the centres of a grid's voxels: (nz, ny, nx) float32, 1/mm.

    gaussians: in mm and 1/mm. grid: of any size, since the device holds one brick at a time. cutoff_sigma: the Mahalanobis
    radius at which a Gaussian ends; 0 never cuts. device: what ``--device`` takes, or a Runtime. ``voxel_operator`` also
    has the gradient.

    Raises InputError for anything but a cloud and a Grid, and for a cutoff out of range."""
    _check_cutoff(cutoff_sigma)
    length_mm = _a_grid(grid).half_longest_mm  # float32 kernels are most accurate for lengths near 1
    if not isinstance(gaussians, Gaussians):
        raise InputError("gaussians", type(gaussians).__name__, "Gaussians", "of rows (11, G): Gaussians.from_rows(rows)")
    rows = gaussians.scaled(1 / length_mm, 1.0).rows()
    return voxelise_rows(runtime_of(device), rows, grid.scaled(1 / length_mm), cutoff_sigma=cutoff_sigma)


@naming_arguments()
def initial_gaussians(scan: Scan, count: int = 0, *, seed: int = 0, device: Device = None) -> Gaussians:
    """Returns the cloud in mm and 1/mm from which ``phyradgs`` starts: Gaussians drawn from an FDK volume.

    count: their number; 0 derives it from the scan's grid, and there are fewer where too few voxels attenuate. seed: of
    the random draw. The result has mean and scale (G, 3). device: what ``--device`` takes, or a Runtime.

    Raises InputError for anything but a Scan, and for a count or a seed below 0."""
    check_scan(scan)
    checks.whole("count (0 chooses it from the grid)", count, 0, 100_000_000)
    checks.whole("seed", seed, 0, 2**63)
    options = SplatOptions(gaussians=count)
    scale, population, _ = first_cloud(runtime_of(device), scan, options, seed)
    rows = options.activation(scan.grid.scaled(1 / scale.length_mm)).apply(population.raw.astype(np.float64))
    return Gaussians.from_rows(rows).scaled(scale.length_mm, scale.density_per_mm)


def _checked(scan: Scan, motion: str | Motion, *kinds: str) -> Motion:
    """Returns the motion model that a name or object means. Raises InputError where scan or operators do not suit it."""
    check_scan(scan)
    model = models.motion_of(motion)
    models.check_motion(model, models.motions_for(*kinds))
    models.check_own_motion(model, scan)
    return model


def _a_grid(grid: Grid) -> Grid:
    if not isinstance(grid, Grid):
        raise InputError("grid", checks.short_repr(grid), "a Grid")
    return grid


def _check_cutoff(cutoff_sigma: float) -> None:
    checks.within("cutoff_sigma (0 cuts nothing off)", cutoff_sigma, 0, 100)


def _check_rows(rows: np.ndarray) -> None:
    """Raises InputError for rows whose rendering would be NaN."""
    checks.finite(_ROWS, rows)
    if (rows[SCALE] <= 0).any() or not rows[QUATERNION].any(axis=0).all():
        raise InputError(_ROWS, "a scale or a quaternion's length of 0 or less", "scales and lengths above 0")
