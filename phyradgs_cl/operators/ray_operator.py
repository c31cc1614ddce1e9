"""The system matrix of a whole scan: all frames under one motion model, as one linear operator and its transpose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.layout import pad_rows, unpad_rows
from phyradgs_cl.operators.rays import RayCells, RayLayout, launch_adjoint, launch_forward
from phyradgs_cl.runtime import DeviceArray, Runtime


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
    """Joseph's projector and its matched adjoint over the cells of many frames; a ``LinearOperator``.

    detector_shape (rows, columns); ``tables`` has the time cells of each frame, all read out along one axis.
    Tables are uploaded once and shared with every subset, and so are the device's volume and frames: use an operator
    and its subsets one at a time. Each call is one launch, or as few as the device's largest allocation allows.

    Joseph, IEEE Trans. Med. Imaging 1 (1982) 192. Raises InputError for tables that do not fit the detector.
    """

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells]
    ) -> None:
        _check_tables(tables, detector_shape)
        self.rt, self.grid, self.detector_shape = rt, grid, detector_shape
        self.volume_shape = grid.shape
        self._axis = tables[0].axis
        layout = RayLayout.of(grid, detector_shape, self._axis)
        self._shared = _Shared(rt, layout, tables)
        self._choose(np.arange(len(tables)))

    @property
    def tables(self) -> list[TimeCells]:
        """The cells of each frame."""
        return [self._shared.tables[f] for f in self._chosen]

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x; volume (nz, ny, nx) 1/mm, result (F, rows, columns) float32."""
        return self._project(volume, "log")

    def intensity_gap(self, volume: np.ndarray) -> np.ndarray:
        """A x − I(x) with I(x) = −ln Σ w exp(−p) over a line's cells, where A x is Σ w p; shapes as in ``forward``.

        Never negative but for rounding; computed from differences between cells, so that small gaps are right too. Added
        to what an intensity detector measured of about x, it is what a log detector would have measured.
        """
        return self._project(volume, "gap")

    def _project(self, volume: np.ndarray, average: str) -> np.ndarray:
        _check_shape("volume", volume, self.volume_shape)
        shared = self._shared
        shared.write_volume(volume)
        result = np.empty(self.frames_shape, np.float32)
        for part, listed in self._batches:
            frames = shared.frames(listed.size)
            launch_forward(
                self.rt, shared.layout, shared.cells, listed, shared.volume, frames, average=average
            )
            by_line = unpad_rows(self.rt.download(frames), shared.layout.frames_shape(listed.size))
            result[part] = self._lines_first(by_line)
        return result

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Aᵀ y; frames (F, rows, columns), result (nz, ny, nx) float32."""
        _check_shape("frames", frames, self.frames_shape)
        shared = self._shared
        for part, listed in self._batches:
            on_device = shared.frames(listed.size)
            self.rt.write(on_device, pad_rows(self._lines_first(frames[part])))
            more = part.start > 0
            launch_adjoint(self.rt, shared.layout, shared.cells, listed, on_device, shared.volume, add=more)
        return shared.layout.unpad_volume(self.rt.download(shared.volume))

    def subset(self, frames: Sequence[int]) -> RayOperator:
        """The same operator on some of the frames, in this order; cheap, but worth keeping if it is used again."""
        chosen = self._chosen[np.asarray(frames, np.int64)]
        if chosen.size == 0:
            raise InputError("subset", "no frames", "at least one frame")
        part = copy(self)
        part._choose(chosen)
        return part

    def _choose(self, chosen: np.ndarray) -> None:
        self._chosen = chosen
        self.frames_shape = (len(chosen), *self.detector_shape)
        self._batches = list(self._shared.batches(chosen))

    def _lines_first(self, frames: np.ndarray) -> np.ndarray:
        """Frames (F, rows, columns) with the readout's lines as rows; its own inverse."""
        return frames if self._axis == "rows" else frames.transpose(0, 2, 1)


class _Shared:
    """What an operator and its subsets share: the cells of all frames, a padded volume and padded frames."""

    def __init__(self, rt: Runtime, layout: RayLayout, tables: Sequence[TimeCells]) -> None:
        self.rt, self.layout, self.tables = rt, layout, list(tables)
        self.cells = RayCells.upload(rt, layout.grid, self.tables)
        floats = rt.device.largest_allocation_bytes // 4
        fitting = (floats - layout.frames_floats(0)) // (layout.frames_floats(1) - layout.frames_floats(0))
        self._most = max(1, min(len(self.tables), fitting))

    @cached_property
    def volume(self) -> DeviceArray:
        return self.rt.zeros(self.layout.volume_floats)

    @cached_property
    def _padded(self) -> np.ndarray:
        """The volume's padded floats on the host, kept because fresh pages cost more than the copy."""
        return self.layout.pad_volume(np.zeros(self.layout.grid.shape, np.float32))

    @cached_property
    def _all_frames(self) -> DeviceArray:
        return self.rt.zeros(self.layout.frames_floats(self._most))

    def write_volume(self, volume: np.ndarray) -> None:
        self.layout.inside(self._padded)[...] = volume
        self.rt.write(self.volume, self._padded)

    def frames(self, count: int) -> DeviceArray:
        """Memory for ``count`` frames of one batch, whatever was in it."""
        whole = self._all_frames
        return DeviceArray(whole.buffer, (self.layout.frames_floats(count),), whole.dtype)

    def batches(self, chosen: np.ndarray) -> Iterator[tuple[slice, DeviceArray]]:
        """Runs of the chosen frames that fit into one allocation, with their uploaded indices."""
        for start in range(0, len(chosen), self._most):
            part = slice(start, min(start + self._most, len(chosen)))
            yield part, self.rt.upload(chosen[part], np.int32)


def _check_tables(tables: Sequence[TimeCells], detector_shape: tuple[int, int]) -> None:
    if not tables:
        raise InputError("tables", "no frames", "the time cells of at least one frame")
    axis = tables[0].axis
    lines = detector_shape[0] if axis == "rows" else detector_shape[1]
    for frame, table in enumerate(tables):
        if (table.axis, table.lines) != (axis, lines):
            found = f"{table.lines} {table.axis} in frame {frame}"
            raise InputError("tables", found, f"{lines} {axis} in every frame")


def _check_shape(name: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise InputError(name, f"shape {values.shape}", f"shape {shape}")
