"""FISTA with a prior, over subsets of the frames: min ½‖p − A x‖² + R(x), x ≥ 0, in some ten passes a grid.

The volume that is asked for is a mean over each of its voxels, which large voxels cannot follow an edge with. So the last
passes are on a grid of smaller ones, where there is room for it, and the result is mostly of their means.

Accelerated proximal gradients (Beck and Teboulle, SIAM J. Imaging Sci. 2 (2009) 183) whose gradients are those of ordered
subsets, times their number (Kim, Ramani and Fessler, IEEE Trans. Med. Imaging 34 (2015) 167), with restart of the momentum.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.volume import MOST_VOXELS
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    option_facts,
    state_arrays,
)
from phyradgs_cl.reconstructors.voxels.misfit import Misfit, Reach, density, misfit_of
from phyradgs_cl.reconstructors.voxels.priors import PRIORS, Denoiser, Prior, prior_of, volumes_of
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, run_iterations
from phyradgs_cl.reconstructors.voxels.sart import spread_order
from phyradgs_cl.reconstructors.voxels.stages import Stage, run_stages
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

_GROWTH = 1.2  # of the residual over the least so far: subsets that pull apart so much are too small
_FEWEST = 1e-4  # of the largest value of Aᵀp: the weight where frames have no noise
_VOLUMES, _FRAMES = 16, 3  # held at one time, with the prior `dct`
_FINE_PASSES, _FINE_SHARE = 3 / 7, np.float32(2 / 3)  # of passes and result: the smaller voxels' (docs/results/settings.md)
_MOST_PARTED = 90**3  # voxels of a grid that smaller ones are worth their time for: of 64³ they are, of 128³ not


@dataclass(frozen=True)
class FistaOptions(IterativeOptions):
    """prior: one of ``PRIORS``, or a function of one's own or its ``package.module:function``: (volume (nz, ny, nx) in 1/mm,
    noise in 1/mm) to a volume; piccs takes the volume that the run starts from as its prior image, and prior_share of the
    total variation from the difference to it. prior_weight: strength, relative to what reaches a voxel of the frames' noise
    and of what voxels so large miss at edges.

    subvoxels: parts of a voxel's side in the last 3 of 7 passes; 0: 2 up to 90³ voxels where there is room, else 1.
    subsets: of the frames, each with a step of its own; those whose steps pull apart are joined two by two.
    tv_iterations: dual iterations per proximal map of TV. transmission_weights: as of ``fista-tv``.
    """

    FUNCTIONS: ClassVar[tuple[str, ...]] = ("prior",)
    """Options that may be a function."""

    motion: Motion = PerRow()
    iterations: int = 35
    prior: str | Denoiser = "dct"
    prior_weight: float = 0.42
    subvoxels: int = 0
    prior_share: float = 0.5
    subsets: int = 5
    tv_iterations: int = 5
    transmission_weights: bool = False  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (callable(self.prior) or ":" in self.prior):
            checks.one_of("prior", self.prior, (*PRIORS, "package.module:function"))
        checks.within("subvoxels", self.subvoxels, 0, 8)
        checks.within("prior_weight", self.prior_weight, 0, 1e6)
        checks.within("prior_share", self.prior_share, 0, 1)
        if self.prior != "piccs" and self.prior_share != FistaOptions.prior_share:
            found = f"{self.prior_share:g} with the prior {self.prior}"
            raise InputError("prior_share", found, "the prior piccs", "set prior=piccs, or leave prior_share out")
        checks.within("subsets", self.subsets, 1, 1_000_000)
        checks.within("tv_iterations", self.tv_iterations, 1, 10_000)


def fista(
    scan: Scan,
    options: FistaOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
    initial: np.ndarray | None = None,
) -> Reconstruction:
    """The regularised volume of a scan in 1/mm. ``seed`` is accepted for the common signature; nothing is drawn."""
    stages = fista_stages(scan, options, rt, initial)
    result = run_stages(stages, scan.grid, report, resume, initial)
    result.facts["options"] = option_facts(options)
    return result


METHOD = Method(fista, {"default": FistaOptions()}, is_shared=True, takes_initial=True)


def fista_stages(
    scan: Scan, options: FistaOptions, rt: Runtime, image: np.ndarray | None = None
) -> list[Stage]:
    """All passes on the scan's own grid, or the first of them and the rest on one of smaller voxels; ``image``: of piccs."""
    is_small = math.prod(scan.grid.shape) <= _MOST_PARTED
    parts = options.subvoxels or (2 if is_small and _has_room(scan.grid, 2, options.prior, rt) else 1)
    first = options.iterations - (int(_FINE_PASSES * options.iterations) if parts > 1 else 0)

    def voxels(before: np.ndarray | None, report: ProgressReport, resume: State | None) -> Reconstruction:
        return _run(scan, replace(options, iterations=first), rt, report, resume, before, image)

    def parted(before: np.ndarray | None, report: ProgressReport, resume: State | None) -> Reconstruction:
        assert before is not None
        grid = finer(scan.grid, parts)
        small = replace(options, iterations=options.iterations - first)
        fine = replace(scan, grid=grid, reference=None)
        return _run(fine, small, rt, report, resume, repeated(before, parts), repeated(image, parts))

    if parts == 1:
        return [Stage("voxels", first, voxels)]

    def mixed(volume: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        assert before is not None
        mean: np.ndarray = before + _FINE_SHARE * (block_means(volume, parts) - before)
        return mean

    rest = Stage("subvoxels", options.iterations - first, parted, mixed)
    return [Stage("voxels", first, voxels), rest]


def finer(grid: Grid, parts: int) -> Grid:
    """The same box with ``parts`` voxels for one along each axis."""
    z, y, x = grid.shape
    dz, dy, dx = grid.voxel_size_mm
    return replace(grid, shape=(parts * z, parts * y, parts * x), voxel_size_mm=(dz / parts, dy / parts, dx / parts))


def repeated(volume: np.ndarray | None, parts: int) -> np.ndarray | None:
    """The same volume in ``parts`` voxels for one along each axis."""
    return None if volume is None else volume.repeat(parts, 0).repeat(parts, 1).repeat(parts, 2)


def block_means(volume: np.ndarray, parts: int) -> np.ndarray:
    """Means of a volume (parts nz, parts ny, parts nx) over blocks, (nz, ny, nx) float32."""
    nz, ny, nx = (count // parts for count in volume.shape)
    blocks = volume.reshape(nz, parts, ny, parts, nx, parts)
    means: np.ndarray = blocks.mean((1, 3, 5), dtype=np.float64).astype(np.float32)
    return means


def _has_room(grid: Grid, parts: int, prior: str | Denoiser, rt: Runtime) -> bool:
    """Whether every rank's device holds the method's volumes with voxels so much smaller."""
    voxels = math.prod(grid.shape) * parts**3
    sizes_bytes = *[4 * voxels] * (_VOLUMES + 2), 4 * voxels * volumes_of(prior)
    holds = voxels <= MOST_VOXELS and rt.room().holds(*sizes_bytes)
    return not rt.ranks.any(not holds)


def _run(
    scan: Scan,
    options: FistaOptions,
    rt: Runtime,
    report: ProgressReport,
    resume: State | None,
    initial: np.ndarray | None,
    image: np.ndarray | None,
) -> Reconstruction:
    """All passes on the scan's grid."""
    def make(system: System) -> "Fista":
        prior = prior_of(
            options.prior, rt, scan.grid, options.tv_iterations, options.iterations, image, options.prior_share
        )
        return Fista(system, options, prior, misfit_of(scan, options.motion))

    sizes = {"volumes": _VOLUMES + volumes_of(options.prior), "frames": _FRAMES}
    return run_iterations("fista", make, scan, options, rt, report, resume, initial, **sizes)


class Fista:
    """The residual that is reported is the pass's own: of every subset just before its step.

    The weight of the prior is ``prior_weight`` times what the misfit makes of the gradient, back through Aᵀ, which averages
    noise along a blur. It follows the volume's density from pass to pass.
    """

    def __init__(self, system: System, options: FistaOptions, prior: Prior, misfit: Misfit) -> None:
        self.system, self.options, self.prior, self.misfit = system, options, prior, misfit
        space = system.space
        self.volume = space.full(system.volume_shape, 0.0)
        self.previous = self.volume
        self.momentum, self.least = 1.0, float("inf")
        self.finished: str | None = None
        # AᵀA has no negative entry: its largest row sum bounds its norm
        self.curvature = space.largest(system.adjoint(system.apply_weights(system.row_sums()))) or 1.0
        self._smallest = _FEWEST * space.largest(system.adjoint(system.apply_weights(system.measured)), absolute=True)
        self._reach = Reach.of(system)
        self.subsets = self._subsets(min(options.subsets, system.frames))

    @property
    def weight(self) -> float:
        """The prior's, in the unit of the gradient."""
        gradient_mm = self._reach.gradient_mm(self.misfit, density(self.system.space, self.volume))
        return max(self.options.prior_weight * gradient_mm, self._smallest)

    def _subsets(self, count: int) -> list[System]:
        return [self.system.subset(range(first, self.system.frames, count)) for first in spread_order(count)]

    def start_from(self, volume: Any) -> None:
        self.volume = self.previous = volume

    def step(self) -> float:
        weight = self.weight
        squares = self.system.space.sum_squares(self._step_of(subset, weight) for subset in self.subsets)
        residual = squares**0.5
        pull_apart = residual > _GROWTH * self.least and len(self.subsets) > 1
        if pull_apart:
            self.subsets = self._subsets(-(-len(self.subsets) // 2))
            self.momentum, self.previous = 1.0, self.volume
        self.least = residual if pull_apart else min(self.least, residual)
        self.prior.end_pass(self.system.space, self.volume)
        return residual

    def _step_of(self, subset: System, weight: float) -> Any:
        """The residual of the subset's frames just before its step."""
        space = self.system.space
        following = float((1 + np.sqrt(1 + 4 * self.momentum**2)) / 2)
        beta = (self.momentum - 1) / following
        point = space.extrapolate(self.volume, self.previous, beta)
        residual = subset.residual(point)
        gradient = subset.back(subset.apply_weights(residual))
        moved = space.add(point, gradient, len(self.subsets) / self.curvature)
        volume = self.prior(space, moved, weight / self.curvature, nonnegative=self.options.nonnegative)
        uphill = space.turn(point, volume, self.volume) > 0
        self.previous, self.volume = self.volume, volume
        self.momentum = 1.0 if uphill else following
        return residual

    def state(self) -> dict[str, np.ndarray]:
        numpy = self.system.space.numpy
        return {
            "volume": numpy(self.volume),
            "previous": numpy(self.previous),
            "progress": np.array([self.momentum, self.least, len(self.subsets)]),
            **self.prior.state(),
        }

    def restore(self, state: State) -> None:
        volume, previous, progress = state_arrays(state, ["volume", "previous", "progress"])
        self.volume, self.previous = map(self.system.space.array, (volume, previous))
        self.momentum, self.least = float(progress[0]), float(progress[1])
        self.subsets = self._subsets(int(progress[2]))
        self.prior.restore(state)
