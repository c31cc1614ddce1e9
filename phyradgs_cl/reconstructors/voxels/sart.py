"""SIRT, SART and OS-SART: the volume is corrected after all frames, after every frame, or after every few.

SIRT: Gilbert, J. Theor. Biol. 36 (1972) 105. SART: Andersen and Kak, Ultrasonic Imaging 6 (1984) 81. OS-SART: Wang and
Jiang, J. X-Ray Sci. Technol. 12 (2004) 169."""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.voxels.run import Algorithm, IterativeOptions, MethodRun, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System, column_weights, row_weights, spread_order

_WEIGHT_CACHE_BYTES = 1 << 29  # most bytes of column weights in memory; those of further subsets are computed in every pass


@dataclass(frozen=True)
class SartOptions(IterativeOptions):
    """Options of SART. relaxation: λ, the factor on each correction. relaxation_reduction: the factor on λ after each
    iteration.

    frames_per_subset: number of frames, far apart in time, per correction; 1 for SART. noise_stop: the run ends when the
    residual falls to this many times the estimated noise of the measurement (discrepancy principle, Morozov 1966); further
    iterations would fit the noise. 0 runs all iterations."""

    relaxation: float = checks.ranged(1.0, 1e-6, 2)
    relaxation_reduction: float = checks.ranged(0.999, 1e-6, 1)
    frames_per_subset: int = checks.ranged(1, 1, 1_000_000)
    noise_stop: float = checks.ranged(0.0, 0, 1e6)  # type: ignore[misc]


OS_SART = SartOptions(frames_per_subset=10)


@dataclass(frozen=True)
class SirtOptions(IterativeOptions):
    """Options of SIRT. relaxation: λ, the factor on each correction, up to 2."""

    frames_per_subset: ClassVar[int] = sys.maxsize  # all
    relaxation_reduction: ClassVar[float] = 1.0

    iterations: int = 100
    relaxation: float = checks.ranged(1.0, 1e-6, 2)


class Sart(Algorithm):
    """SART, x ← x + λ V Aᵢᵀ W (pᵢ − Aᵢ x) over subsets i of the frames, with the rays' W = 1/(Aᵢ 1) and the voxels' V =
    1/(Aᵢᵀ 1). With one subset of all frames this is SIRT, whose residual, weighted by √W, never grows in the log model.

    The intensity model replaces Aᵢ x by the expected Iᵢ(x), and Aᵢᵀ by Jᵢᵀ, with the derivative Jᵢ of Iᵢ. An iteration's
    residual combines those of all subsets, each before its correction."""

    NUMBERS = ("relaxation",)

    def __init__(self, system: System, options: SartOptions | SirtOptions) -> None:
        super().__init__(system)
        self.options, self.relaxation = options, options.relaxation
        order, size = spread_order(system.frames), options.frames_per_subset
        starts = range(0, len(order), size) if size < len(order) else ()
        self.subsets = [system.subset(order[i : i + size]) for i in starts] or [system]
        self._row_weights = [row_weights(subset) for subset in self.subsets]
        cached = self.subsets[: _cached_columns(system.volume_shape, len(self.subsets))]
        self._column_weights = [column_weights(subset) for subset in cached]

    def step(self) -> float:
        squares = self.system.space.sum_squares(self._corrections())
        self.relaxation *= self.options.relaxation_reduction
        return float(np.sqrt(squares))

    def restore(self, state: State) -> None:
        super().restore({"relaxation": np.array(self.relaxation), **state})  # earlier versions' states of SIRT lack it

    def _corrections(self) -> Iterator[Any]:
        """Corrects the volume with each subset in turn. Yields the subset's residual just before its correction."""
        space, clip = self.system.space, self.options.nonnegative
        for index, subset in enumerate(self.subsets):
            columns = self._columns(index)
            residual = subset.residual(self.volume)
            yield residual
            update = subset.back(space.multiply(residual, self._row_weights[index]))
            self.volume = space.add_product(self.volume, columns, update, self.relaxation, nonnegative=clip)

    def _columns(self, index: int) -> Any:
        """Returns a subset's column weights 1/(Aᵢᵀ 1), (nz, ny, nx); computes them again if they are not in the cache."""
        is_cached = index < len(self._column_weights)
        return self._column_weights[index] if is_cached else column_weights(self.subsets[index])


def _cached_columns(volume_shape: tuple[int, ...], subsets: int) -> int:
    """Returns how many of ``subsets`` subsets keep their column weights in memory, an array as large as a volume each."""
    return min(subsets, max(_WEIGHT_CACHE_BYTES // (4 * math.prod(volume_shape)), 1))


def held_volumes(scan: Scan, options: SartOptions) -> int:
    """Returns how many volumes a run holds in memory at one time, with the column weights that ``Sart`` keeps there."""
    return 4 + _cached_columns(scan.grid.shape, checks.ceil_div(scan.frames, options.frames_per_subset))


def _sart(system: System, options: "SartOptions | SirtOptions", run: MethodRun) -> Sart:
    return Sart(system, options)


METHOD = voxel_method("sart", SartOptions(), _sart, volumes=held_volumes, frames=2)
OS_METHOD = voxel_method("os-sart", OS_SART, _sart, volumes=held_volumes, frames=2)
SIRT_METHOD = voxel_method("sirt", SirtOptions(), _sart, volumes=4, frames=1)
