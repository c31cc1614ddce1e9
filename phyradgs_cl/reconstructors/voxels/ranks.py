"""The frames of a scan's operator shared out over ranks: each projects its own; frames are gathered, volumes summed.

Volumes and frames are whole on every rank, so that the methods around an operator need not know of the others: they do the
same everywhere. Sums of volumes do not depend on their order, but on how many frames per rank adds up by itself.
"""

from collections.abc import Sequence
from typing import Protocol as Interface
from typing import TypeVar

import numpy as np

from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.operator import LinearOperator
from phyradgs_cl.parallel import Communicator, exact_sum, span

S = TypeVar("S", bound="SharedOperator")


class SharedOperator:
    """A ``LinearOperator`` of which every rank does its run of the frames; ``whole`` knows all of them."""

    def __init__(self, ranks: Communicator, whole: LinearOperator) -> None:
        self.ranks, self.whole = ranks, whole
        self.volume_shape, self.frames_shape = whole.volume_shape, whole.frames_shape
        run = span(self.frames_shape[0], ranks.size, ranks.rank)
        self._own = slice(run.start, run.stop)
        self._part = whole.subset(list(run)) if len(run) else None

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x: volume (nz, ny, nx) 1/mm to frames (F, rows, columns) float32."""
        return self._gathered(None if self._part is None else self._part.forward(volume))

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Aᵀ y: frames (F, rows, columns) to a volume (nz, ny, nx) float32."""
        shape = (self.volume_shape[0], self.volume_shape[1] * self.volume_shape[2])
        parts = [] if self._part is None else [self._part.adjoint(frames[self._own]).reshape(shape)]
        return exact_sum(self.ranks, parts, shape, self.ranks.size).reshape(self.volume_shape)

    def subset(self: S, frames: Sequence[int]) -> S:
        """The same of some of the frames, in this order, shared out anew."""
        return type(self)(self.ranks, self.whole.subset(frames))

    def _gathered(self, part: np.ndarray | None) -> np.ndarray:
        none = np.zeros((0, *self.frames_shape[1:]), np.float32)
        return self.ranks.allgather(none if part is None else part)


class Intensity(Interface):
    """What the iterative methods need to know of a detector that adds photons: I, and its derivative J."""

    def expected(self, volume: np.ndarray) -> np.ndarray:
        """I(x) (F, rows, columns) float32 of a volume (nz, ny, nx) 1/mm, at which J stands from now on."""
        ...

    def forward(self, volume: np.ndarray) -> np.ndarray: ...

    def adjoint(self, frames: np.ndarray) -> np.ndarray: ...

    def subset(self, frames: Sequence[int]) -> "Intensity": ...


class SharedIntensity(SharedOperator):
    """The same of an ``IntensityOperator``."""

    whole: IntensityOperator
    _part: IntensityOperator | None

    def expected(self, volume: np.ndarray) -> np.ndarray:
        """I(x) (F, rows, columns) float32 of a volume (nz, ny, nx) 1/mm, at which J stands from now on."""
        return self._gathered(None if self._part is None else self._part.expected(volume))
