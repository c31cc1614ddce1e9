"""SART and OS-SART: the volume is corrected after every frame, or every few frames.

Andersen and Kak, Ultrasonic Imaging 6 (1984) 81; ordered subsets: Wang and Jiang, J. X-Ray Sci. Technol. 12 (2004) 169.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import State, state_arrays
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System, column_weights, row_weights

ORDERS = ("spread", "random", "ordered")
_WEIGHT_CACHE_BYTES = 1 << 29


@dataclass(frozen=True)
class SartOptions(IterativeOptions):
    """relaxation: λ, the share of each correction that is taken; relaxation_reduction: its factor per iteration.

    frames_per_subset: frames that are corrected for together, 1 for SART. order: of the frames in a pass: ``spread``
    (neighbours in time far apart in angle), ``random`` (from the seed), ``ordered`` (as recorded).
    transmission_weights: transmission-weighted (PWLS), W = t/(A 1) and V = 1/(Aᵀ t).
    noise_stop: the run ends when the residual falls to this many times the noise of the measurement, which is estimated
    from it (discrepancy principle, Morozov 1966); below it the noise is fitted. 0 runs all iterations.
    """

    relaxation: float = 1.0
    relaxation_reduction: float = 0.999
    frames_per_subset: int = 1
    order: str = "spread"
    transmission_weights: bool = False  # type: ignore[misc]
    noise_stop: float = 0.0  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.within("relaxation", self.relaxation, 1e-6, 2)
        checks.within("relaxation_reduction", self.relaxation_reduction, 1e-6, 1)
        checks.within("frames_per_subset", self.frames_per_subset, 1, 1_000_000)
        checks.one_of("order", self.order, ORDERS)


OS_SART = SartOptions(frames_per_subset=10)


def kept_columns(scan: Scan, options: SartOptions) -> int:
    """Column weights, a volume per subset, that are kept and not made anew."""
    subsets = -(-scan.frames // options.frames_per_subset)
    return min(subsets, _most_kept(scan.grid.shape))


def _most_kept(volume_shape: Sequence[int]) -> int:
    return max(_WEIGHT_CACHE_BYTES // (4 * math.prod(volume_shape)), 1)


def _method(name: str, default: SartOptions) -> Method:
    """The seed orders frames where ``order`` is random."""
    return voxel_method(
        name, default, lambda system, options, setting: Sart(system, options, setting.seed),
        volumes=lambda scan, options: 4 + kept_columns(scan, options), frames=2,
    )  # fmt: skip


METHOD, OS_METHOD = _method("sart", SartOptions()), _method("os-sart", OS_SART)


class Sart:
    """x ← x + λ V Aᵢᵀ W (pᵢ − Aᵢ x) over subsets i, W = 1/(Aᵢ 1), V = 1/(Aᵢᵀ 1); Jᵢᵀ and Iᵢ(x) in the intensity model.

    The residual that is reported is the pass's own: of every subset just before its correction.
    """

    def __init__(self, system: System, options: SartOptions, seed: int) -> None:
        self.system, self.options, self.seed = system, options, seed
        self.volume = system.space.full(system.volume_shape, 0.0)
        self.relaxation = options.relaxation
        self.finished: str | None = None
        self.iteration = 0
        order = spread_order(system.frames) if options.order == "spread" else list(range(system.frames))
        size = options.frames_per_subset
        groups = [order[i : i + size] for i in range(0, len(order), size)]
        self.subsets = [system.subset(group) for group in groups]
        self._row_weights = [row_weights(subset) for subset in self.subsets]
        kept = _most_kept(system.volume_shape)
        self._column_weights = [column_weights(subset) for subset in self.subsets[:kept]]

    def start_from(self, volume: Any) -> None:
        self.volume = volume

    def step(self) -> float:
        squares = self.system.space.sum_squares(self._corrections())
        self.relaxation *= self.options.relaxation_reduction
        self.iteration += 1
        return float(np.sqrt(squares))

    def _corrections(self) -> Iterator[Any]:
        """Corrects for all subsets; the residual of each just before its correction."""
        space, clip = self.system.space, self.options.nonnegative
        for index in self._pass():
            subset, columns = self.subsets[index], self._columns(index)
            residual = subset.residual(self.volume)
            yield residual
            update = subset.back(space.multiply(residual, self._row_weights[index]))
            self.volume = space.add_product(self.volume, columns, update, self.relaxation, nonnegative=clip)

    def _pass(self) -> list[int]:
        count = len(self.subsets)
        if self.options.order != "random":
            return list(range(count))
        return np.random.default_rng([self.seed, self.iteration]).permutation(count).tolist()

    def _columns(self, index: int) -> Any:
        """Column weights; those that the cache has no room for are made anew."""
        if index < len(self._column_weights):
            return self._column_weights[index]
        return column_weights(self.subsets[index])

    def state(self) -> dict[str, np.ndarray]:
        return {
            "volume": self.system.space.numpy(self.volume),
            "relaxation": np.array(self.relaxation),
            "pass": np.array(self.iteration),
        }

    def restore(self, state: State) -> None:
        volume, relaxation, iteration = state_arrays(state, ["volume", "relaxation", "pass"])
        self.volume = self.system.space.array(volume)
        self.relaxation, self.iteration = float(relaxation), int(iteration)


def spread_order(count: int) -> list[int]:
    """0 … count−1 in steps near the golden section of count, so that each is far from the few before it."""
    step = next(s for s in range(max(round(0.618 * count), 1), 2 * count + 1) if np.gcd(s, count) == 1)
    return [(i * step) % count for i in range(count)]
