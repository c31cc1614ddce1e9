"""Ordered subsets of a scan's frames: H. M. Hudson and R. S. Larkin, IEEE Trans. Med. Imaging 13 (1994) 601."""

from collections.abc import Iterator

import numpy as np

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.reconstructors.voxels.system import System

_GROWTH = 1.2  # steps of subsets diverge where a pass leaves more than this many times the least residual so far


def spread_order(count: int) -> list[int]:
    """Returns the numbers 0 … count − 1, each far from the few before it, in steps near the golden section of ``count``."""
    step = next(s for s in range(max(round(0.618 * count), 1), 2 * count + 1) if np.gcd(s, count) == 1)
    return [(i * step) % count for i in range(count)]


class OrderedSubsets:
    """A system divided into ``count`` subsets: every count-th frame each, in an order that spreads them over the turn."""

    def __init__(self, system: System, count: int) -> None:
        self.system, self.least_residual = system, float("inf")
        self.split(min(count, system.frames))

    def __iter__(self) -> Iterator[System]:
        return iter(self._systems)

    def __len__(self) -> int:
        return len(self._systems)

    def split(self, count: int) -> None:
        """Divides the frames into ``count`` subsets."""
        frames = self.system.frames
        self._systems = [self.system.subset(range(first, frames, count)) for first in spread_order(count)]

    def join_if_diverging(self, residual: float) -> bool:
        """Joins subsets two by two where the ``residual`` of a pass has grown so much that their steps diverge. Returns
        whether it did."""
        diverges = residual > _GROWTH * self.least_residual and len(self) > 1
        if diverges:
            self.split(ceil_div(len(self), 2))
        self.least_residual = residual if diverges else min(self.least_residual, residual)
        return diverges
