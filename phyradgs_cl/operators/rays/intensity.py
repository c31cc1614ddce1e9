"""The intensity model around one volume: I(x) = −ln Σ w exp(−A_k x), its derivative J and Jᵀ, exactly.

A line's cells are numbered, and A_k is the projector of everyone's k-th cell. Then J = Σ_k s_k A_k with the softmax weight
s_k = w_k exp(−p_k) / Σ_j w_j exp(−p_j) of every pixel, and Jᵀ y = Σ_k A_kᵀ (s_k y): launches of the linear projector, one
per cell of a line, that cost together what one launch over all cells does. Twin: ``intensity_frame`` in twins/rays.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.detector import intensity_average
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.cell_layers import layered
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.runtime import Runtime


class IntensityOperator:
    """I(x), and J and Jᵀ at the volume for which I was asked last (A and Aᵀ before that).

    Arguments as for ``RayOperator``. It holds frames (F, rows, columns) once for every cell of a line, which is what the
    softmax weights need.
    """

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells]
    ) -> None:
        ones, self._weights = layered(tables)
        self.volume_shape = grid.shape
        self.frames_shape = (len(tables), *detector_shape)
        self._operators: list[RayOperator] = []
        for part in ones:  # one memory for all: they are used in turns
            memory = self._operators[0].memory if self._operators else None
            self._operators.append(RayOperator(rt, grid, detector_shape, part, memory=memory))
        self._shares = self._weights

    def expected(self, volume: np.ndarray) -> np.ndarray:
        """I(x) (F, rows, columns) float32 of a volume (nz, ny, nx) 1/mm, at which J stands from now on."""
        p = [operator.forward(volume) for operator in self._operators]
        frames, shares = intensity_average(p, self._weights)
        self._shares = [share.astype(np.float32) for share in shares]
        return frames.astype(np.float32)

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """J d: a change of the volume (nz, ny, nx) to that of the frames (F, rows, columns) float32."""
        pairs = zip(self._shares, self._operators, strict=True)
        total: np.ndarray = np.sum([share * operator.forward(volume) for share, operator in pairs], axis=0)
        return total

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Jᵀ y: frames (F, rows, columns) to a volume (nz, ny, nx) float32."""
        pairs = zip(self._shares, self._operators, strict=True)
        total: np.ndarray = np.sum([operator.adjoint(share * frames) for share, operator in pairs], axis=0)
        return total

    def subset(self, frames: Sequence[int]) -> IntensityOperator:
        """The same for some of the frames, in this order, with a volume of its own for J."""
        chosen = list(frames)
        part = copy(self)
        part.frames_shape = (len(chosen), *self.frames_shape[1:])
        part._operators = [operator.subset(chosen) for operator in self._operators]
        part._weights = [weight[chosen] for weight in self._weights]
        part._shares = part._weights
        return part
