"""The system matrix of a whole scan: all frames under one motion model, as one linear operator and its transpose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.layout import padded_zeros, unpad_rows
from phyradgs_cl.operators.rays import RayProjector
from phyradgs_cl.runtime import Runtime


class LinearOperator(Interface):
    """What the iterative methods need to know of a scanner: A, Aᵀ, and A restricted to some frames."""

    volume_shape: tuple[int, int, int]
    frames_shape: tuple[int, int, int]

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x: volume (nz, ny, nx) 1/mm to frames (F, rows, columns) float32."""
        ...

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Aᵀ y: frames (F, rows, columns) to a volume (nz, ny, nx) float32."""
        ...

    def subset(self, frames: Sequence[int]) -> LinearOperator:
        """The rows of A that belong to these frames, in this order."""
        ...


class RayOperator:
    """Joseph's projector and its matched adjoint over the cells of many frames; a ``LinearOperator``."""

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells]
    ) -> None:
        self.rt, self.grid, self.detector_shape, self.tables = rt, grid, detector_shape, list(tables)
        self.volume_shape = grid.shape
        self.frames_shape = (len(self.tables), *detector_shape)
        self._projector = RayProjector(rt, grid, detector_shape, self.tables[0].axis)

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x; volume (nz, ny, nx) 1/mm, result (F, rows, columns) float32."""
        on_device = self._projector.upload_volume(volume)
        return np.stack([self._projector.forward(on_device, table) for table in self.tables])

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Aᵀ y; frames (F, rows, columns), result (nz, ny, nx) float32."""
        nz, ny, nx = self.grid.shape
        volume = padded_zeros(self.rt, nz * ny, nx)
        for frame, table in zip(frames, self.tables, strict=True):
            self._projector.adjoint(frame, table, volume, add=True)
        return unpad_rows(self.rt.download(volume), self.grid.shape)

    def subset(self, frames: Sequence[int]) -> RayOperator:
        """The same operator on some of the frames."""
        return RayOperator(self.rt, self.grid, self.detector_shape, [self.tables[f] for f in frames])
