"""FISTA with a prior, over subsets of the frames: min ½‖p − A x‖² + R(x), x ≥ 0, in some ten passes.

Accelerated proximal gradients (Beck and Teboulle, SIAM J. Imaging Sci. 2 (2009) 183) whose gradients are those of ordered
subsets, times their number (Kim, Ramani and Fessler, IEEE Trans. Med. Imaging 34 (2015) 167), with restart of the momentum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import noise_level
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    state_arrays,
)
from phyradgs_cl.reconstructors.voxels.priors import PRIORS, Prior, prior_of
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, run_iterations
from phyradgs_cl.reconstructors.voxels.sart import spread_order
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

_GROWTH = 1.2  # of the residual over the least so far: subsets that pull apart so much are too small
_FEWEST = 1e-4  # of the largest value of Aᵀp: the weight where frames have no noise


@dataclass(frozen=True)
class FistaOptions(IterativeOptions):
    """prior: one of ``PRIORS``; piccs takes the volume that the run starts from as its prior image, and prior_share of the
    total variation from the difference to it. prior_weight: strength, relative to the frames' noise as it reaches a voxel.

    frames_per_subset: 0 takes all frames at once. Subsets whose steps pull apart are joined two by two. tv_iterations: dual
    iterations per proximal map of TV. transmission_weights: as of ``fista-tv``.
    """

    iterations: int = 30
    prior: str = "dct"
    prior_weight: float = 0.45
    prior_share: float = 0.5
    frames_per_subset: int = 5
    tv_iterations: int = 5
    transmission_weights: bool = False  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.one_of("prior", self.prior, PRIORS)
        checks.within("prior_weight", self.prior_weight, 0, 1e6)
        checks.within("prior_share", self.prior_share, 0, 1)
        checks.within("frames_per_subset", self.frames_per_subset, 0, 1_000_000)
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
    valid = None if scan.pixel_mask is None else np.broadcast_to(scan.pixel_mask == 0, scan.projections.shape)
    noise = noise_level(np.asarray(scan.projections, np.float32), valid)

    def make(system: System) -> Fista:
        prior = prior_of(options.prior, rt, scan.grid, options.tv_iterations, initial, options.prior_share)
        return Fista(system, options, prior, noise, min(scan.grid.voxel_size_mm))

    return run_iterations("fista", make, scan, options, rt, report, resume, initial, volumes=16, frames=3)


METHOD = Method(fista, {"default": FistaOptions()}, is_shared=True, takes_initial=True)


class Fista:
    """The residual that is reported is the pass's own: of every subset just before its step.

    The weight of the prior is ``prior_weight`` · σ √(h max Aᵀ1): the noise σ of a pixel, back in a voxel of side h as the
    gradient has it, times 1/mm.
    """

    def __init__(
        self, system: System, options: FistaOptions, prior: Prior, noise: float, voxel_mm: float
    ) -> None:
        self.system, self.options, self.prior = system, options, prior
        space = system.space
        self.volume = space.full(system.volume_shape, 0.0)
        self.previous = self.volume
        self.momentum, self.least = 1.0, float("inf")
        self.finished: str | None = None
        columns = space.largest(system.column_sums())
        # AᵀA has no negative entry: its largest row sum bounds its norm
        self.curvature = space.largest(system.adjoint(system.weighed(system.row_sums()))) or 1.0
        largest = space.largest(system.adjoint(system.weighed(system.measured)), absolute=True)
        self.weight = options.prior_weight * max(noise * (voxel_mm * columns) ** 0.5, _FEWEST * largest)
        size = options.frames_per_subset or system.frames
        self.subsets = self._subsets(max(1, round(system.frames / size)))

    def _subsets(self, count: int) -> list[System]:
        return [self.system.subset(range(first, self.system.frames, count)) for first in spread_order(count)]

    def start_from(self, volume: Any) -> None:
        self.volume = self.previous = volume

    def step(self) -> float:
        squares = sum(self._step_of(subset) ** 2 for subset in self.subsets)
        residual = float(np.sqrt(squares))
        pull_apart = residual > _GROWTH * self.least and len(self.subsets) > 1
        if pull_apart:
            self.subsets = self._subsets(-(-len(self.subsets) // 2))
            self.momentum, self.previous = 1.0, self.volume
        self.least = residual if pull_apart else min(self.least, residual)
        return residual

    def _step_of(self, subset: System) -> float:
        system, space = self.system, self.system.space
        following = float((1 + np.sqrt(1 + 4 * self.momentum**2)) / 2)
        beta = (self.momentum - 1) / following
        point = space.add(self.volume, system.less(self.volume, self.previous), beta)
        residual = subset.residual(point)
        gradient = subset.back(subset.weighed(residual))
        moved = space.add(point, gradient, len(self.subsets) / self.curvature)
        volume = self.prior(space, moved, self.weight / self.curvature, nonnegative=self.options.nonnegative)
        uphill = space.inner(system.less(point, volume), system.less(volume, self.volume)) > 0
        self.previous, self.volume = self.volume, volume
        self.momentum = 1.0 if uphill else following
        return space.norm(residual)

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
