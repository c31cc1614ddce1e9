"""Operators for whole scans: from voxels or Gaussians to frames, and from Gaussians to voxels. ``as_torch`` passes them to
PyTorch."""

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, OwnTimes, PerRow, Scan
from phyradgs_cl.acquisition import motion as models
from phyradgs_cl.api.runs import Device, check_scan, runtime_of
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.operators import RayOperator, SplatProjection, VoxelOperator
from phyradgs_cl.operators import voxelise as voxelise_rows
from phyradgs_cl.operators.public import LinearOperator, Map, Operator, Values, computed
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.operators.splats.projector import DEFAULT_CUTOFF_SIGMA, DEFAULT_TIME_ERROR
from phyradgs_cl.reconstructors.splats.method import first_cloud
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.step import tables_of
from phyradgs_cl.runtime import DeviceArray, Runtime

_FRAMES, _VOLUME = "frames", "volume"


@naming_arguments()
def ray_operator(
    scan: Scan, motion: str | Motion = "per-row", *, grid: Grid | None = None, device: Device = None
) -> LinearOperator:
    """Returns Joseph's projector of a scan, from volumes (nz, ny, nx) in 1/mm to frames (F, rows, columns), with transpose.

    motion: a motion model of docs/methods.md except ``exact`` and ``centres``, or an object of your own class. grid: the
    voxels; None takes the scan's grid. device: what ``--device`` takes, or a Runtime. The result's ``intensity`` is the
    operator for detectors that average photons instead of line integrals. Where pixels are wider than voxels, a pixel is the
    mean of several rays (docs/mathematics.md). Joseph, IEEE Trans. Med. Imaging 1 (1982) 192.

    Raises InputError for anything but a Scan or a Grid, for an unknown motion, and for one that only splats support."""
    model, voxels = _checked(scan, motion, models.RAYS), scan.grid if grid is None else _a_grid(grid)
    tables = [model.cells(scan, frame).still() for frame in range(scan.frames)]
    like = runtime_of(device), voxels, scan.geometry.detector_shape, tables
    return _rays(RayOperator(*like, subrays=subrays_of(voxels, tables)))


def _rays(engine: RayOperator) -> LinearOperator:
    def intensity() -> Operator:
        like, subrays = (engine.rt, engine.grid, engine.detector_shape, engine.tables), engine.memory.layout.subrays
        return _intensities(engine.rt, IntensityOperator(*like, subrays=subrays))

    domain, frames = (_VOLUME, engine.volume_shape), (_FRAMES, engine.frames_shape)
    subset = lambda chosen: _rays(engine.subset(chosen))  # noqa: E731
    maps = engine.forward, engine.adjoint
    return LinearOperator(engine.rt, domain, frames, *maps, frames=subset, intensity=intensity)


def _intensities(rt: Runtime, engine: IntensityOperator) -> Operator:
    def at(volume: Values) -> tuple[Values, Map]:
        own, on_device = copy(engine), isinstance(volume, DeviceArray)  # a copy: later calls change the operator's state

        def adjoint(frames: Values) -> Values:
            return _in_new_memory(rt, own.adjoint, frames, engine.volume_shape)

        expected = _in_new_memory(rt, own.expected, volume, engine.frames_shape)
        return expected, partial(computed, rt, on_device, adjoint)

    domain, frames = (_VOLUME, engine.volume_shape), (_FRAMES, engine.frames_shape)
    return Operator(rt, domain, frames, at, frames=lambda chosen: _intensities(rt, engine.subset(chosen)))


def _in_new_memory(rt: Runtime, function: Callable[..., Any], values: Values, shape: tuple[int, ...]) -> Values:
    """Returns ``function(values)``. A result on the device is in a new array of ``shape``, because the next call would
    overwrite the operator's own array."""
    return function(values, rt.empty(shape)) if isinstance(values, DeviceArray) else function(values)


@naming_arguments()
def splat_operator(
    scan: Scan, motion: str | Motion = "exact", *, affine: bool = False,
    cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, device: Device = None,
) -> SplatProjection:
    """Returns a scan's projector Φ (PhyRadGS, Eq. 3), from ``Gaussians`` or rows (11, G) to frames (F, rows, columns).

    The rows are mean x y z and three scales in mm, quaternion w x y z of a length from 1e-12 to 1e12, density in 1/mm.
    motion: a model of docs/methods.md that splats support. affine: use R2-Gaussian's approximation of the projection.
    cutoff_sigma: the Mahalanobis radius at which a Gaussian ends; 0 never cuts. device: what ``--device`` takes, or a
    Runtime. The result's ``of_densities(gaussians)`` is its linear part, from densities (G,) to frames.

    Raises InputError for anything but a Scan, an unknown motion, an ``affine`` that is neither True nor False, and a cutoff
    out of range. The operator does so for rows out of range on the host; it does not look at Arrays on the device."""
    model = _checked(scan, motion, models.RAYS, models.SPLATS)
    if type(model) is PerRow:  # splats cannot share poses between lines by weights, so each line gets its own
        model = OwnTimes(model.of(scan).sub_intervals)
    checks.flag("affine", affine)
    _check_cutoff(cutoff_sigma)
    rt = runtime_of(device)

    def projection(detector: str, chosen: Sequence[int], **average: Any) -> SplatProjection:
        tables, merges = tables_of(scan, model, detector)
        return SplatProjection(
            rt, scan.geometry.detector_shape, [tables[f] for f in chosen], scan.grid.half_longest_mm,
            intensity=merges, affine=affine, cutoff_sigma=cutoff_sigma,
            time_error=getattr(model, "time_error", DEFAULT_TIME_ERROR), **average,
        )

    return projection("log", range(scan.frames), average=partial(projection, "intensity"))


@naming_arguments()
def voxel_operator(grid: Grid, *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, device: Device = None) -> Operator:
    """Returns the operator from Gaussians, or parameter rows (11, G), to a volume (nz, ny, nx) in 1/mm on ``grid``.

    Values are those at the voxels' centres in mm. The volume must fit on the device. cutoff_sigma, device: as in
    ``splat_operator``.

    Raises InputError for anything but a Grid, and for a cutoff out of range."""
    _check_cutoff(cutoff_sigma)
    return VoxelOperator(runtime_of(device), _a_grid(grid), cutoff_sigma=cutoff_sigma)


@naming_arguments()
def voxelise(
    gaussians: Gaussians, grid: Grid, *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, device: Device = None
) -> np.ndarray:
    """Returns the sum of Gaussians at the centres of a grid's voxels: (nz, ny, nx) float32, 1/mm.

    gaussians: in mm and 1/mm. grid: the voxels, of any number, since only a part of the volume is on the device at a time.
    cutoff_sigma: the Mahalanobis radius at which a Gaussian ends; 0 never cuts. device: what ``--device`` takes, or a
    Runtime. For the gradient use ``voxel_operator``.

    Raises InputError for anything but Gaussians and a Grid, and for a cutoff out of range."""
    _check_cutoff(cutoff_sigma)
    length_mm = _a_grid(grid).half_longest_mm  # float32 kernels are most accurate for lengths near 1
    if not isinstance(gaussians, Gaussians):
        raise InputError("gaussians", type(gaussians).__name__, "Gaussians", "of rows (11, G): Gaussians.from_rows(rows)")
    rows = gaussians.scaled(1 / length_mm, 1.0).rows()
    return voxelise_rows(runtime_of(device), rows, grid.scaled(1 / length_mm), cutoff_sigma=cutoff_sigma)


@naming_arguments()
def initial_gaussians(scan: Scan, count: int = 0, *, seed: int = 0, device: Device = None) -> Gaussians:
    """Returns the Gaussians, in mm and 1/mm, from which ``phyradgs`` starts. They are drawn from an FDK volume.

    count: the number of Gaussians; 0 derives it from the scan's grid. There are fewer if too few voxels attenuate. seed: the
    seed of the random draw. The result has mean and scale (G, 3). device: what ``--device`` takes, or a Runtime.

    Raises InputError for anything but a Scan, and for a count or a seed below 0."""
    check_scan(scan)
    checks.whole("count (0 chooses it from the grid)", count, 0, 100_000_000)
    checks.whole("seed", seed, 0, 2**63)
    options = SplatOptions(gaussians=count)
    scale, population, _ = first_cloud(runtime_of(device), scan, options, seed)
    rows = options.activation(scan.grid.scaled(1 / scale.length_mm)).apply(population.raw.astype(np.float64))
    return Gaussians.from_rows(rows).scaled(scale.length_mm, scale.density_per_mm)


def as_torch(operator: Operator) -> Callable[..., Any]:
    """Returns the operator as a function of tensors that PyTorch can differentiate: ``f(x)``, or ``f(x, frames=[3])``.

    x (domain_shape) may be on any device and of any floating type; the result (range_shape) is like it. The operator works
    in float32 on its own device. DLPack spares a copy of float32 tensors on the host. Linear operators can be
    differentiated any number of times, others once. ``backward`` does not project x again.

    Raises InputError if PyTorch is not installed, for anything but an operator or a tensor, and as the operator does."""
    torch: Any = checks.package("torch", "for as_torch", "torch")
    if not isinstance(operator, Operator):
        expected = "what ray_operator, splat_operator or voxel_operator gives"
        raise InputError("operator", type(operator).__name__, expected)

    def array(tensor: Any) -> np.ndarray:  # by DLPack, which does not depend on the versions of torch and numpy
        return np.from_dlpack(tensor.detach().to("cpu", torch.float32).contiguous())

    def tensor(values: np.ndarray, like: Any) -> Any:
        return torch.from_dlpack(values).to(like.device, like.dtype)

    class Linear(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Any, of: LinearOperator) -> Any:
            ctx.of = of
            return tensor(of(array(x)), x)

        @staticmethod
        def backward(ctx: Any, by_y: Any) -> tuple[Any, None]:
            return Linear.apply(by_y, ctx.of.T), None

    class Curved(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: Any, of: Operator) -> Any:
            y, ctx.back = of.vjp(array(x))
            return tensor(y, x)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, by_y: Any) -> tuple[Any, None]:
            return tensor(ctx.back(array(by_y)), by_y), None

    def function(x: Any, frames: Sequence[int] | None = None) -> Any:
        checks.kind("x", x, torch.Tensor, "a tensor", "of a cloud, torch.tensor(cloud.rows())")
        of = operator if frames is None else operator.frames(frames)
        return (Linear if isinstance(of, LinearOperator) else Curved).apply(x, of)

    return function


def _checked(scan: Scan, motion: str | Motion, *kinds: str) -> Motion:
    """Returns the motion model of a name, or the given model. Raises InputError if it suits none of the ``kinds`` of
    operator (RAYS, SPLATS, LINE_POSES), or does not fit the scan."""
    check_scan(scan)
    model = models.motion_of(motion)
    models.check_motion(model, models.motions_for(*kinds))
    models.check_own_motion(model, scan)
    return model


def _a_grid(grid: Grid) -> Grid:
    checks.kind("grid", grid, Grid, "a Grid")
    return grid


def _check_cutoff(cutoff_sigma: float) -> None:
    checks.within("cutoff_sigma (0 cuts nothing off)", cutoff_sigma, 0, 100)
