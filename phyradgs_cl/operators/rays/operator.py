"""The system matrix of a whole scan: all frames under one motion model, as one linear operator and its transpose."""

from collections.abc import Sequence
from copy import copy
from typing import Any
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.cell_layers import averaged, layered
from phyradgs_cl.operators.rays.launches import launch_adjoint, launch_forward
from phyradgs_cl.operators.rays.layout import RayCells, RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.upright import (
    launch_upright,
    launch_upright_adjoint,
    serve_one_line_each,
    upright_block,
    weigh_columns,
)
from phyradgs_cl.runtime import Array, DeviceArray, Runtime, SameArray, with_smaller_bricks


class LinearOperator(Interface):
    """What the iterative methods need to know of a scanner: A, Aᵀ, and A restricted to some frames."""

    @property
    def volume_shape(self) -> tuple[int, ...]: ...

    @property
    def frames_shape(self) -> tuple[int, int, int]: ...

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x: volume (nz, ny, nx) 1/mm to frames (F, rows, columns) float32."""
        ...

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Aᵀ y: frames (F, rows, columns) to a volume (nz, ny, nx) float32."""
        ...

    def subset(self, frames: Sequence[int]) -> "LinearOperator":
        """The rows of A that belong to these frames, in this order."""
        ...


class RayOperator:
    """Joseph's projector and its matched adjoint over the cells of many frames; a ``LinearOperator``.

    Results lie where the arguments do: NumPy's arrays give NumPy's, device arrays (plain, float32) device arrays, and of
    those nothing crosses the bus. ``out``: memory for the result, of the same kind; without it, it is new.
    detector_shape (rows, columns); ``tables`` has the time cells of each frame, all read out along one axis.
    Tables are uploaded once and shared with every subset, and so are the device's volume and frames: use an operator
    and its subsets one at a time, and operators that were given one ``memory``. Each call is one launch, or as few as
    memory allows: a volume that does not fit is taken brick by brick (docs/large.md).

    Joseph, IEEE Trans. Med. Imaging 1 (1982) 192. Raises InputError for tables that do not fit the detector.
    """

    def __init__(
        self,
        rt: Runtime,
        grid: Grid,
        detector_shape: tuple[int, int],
        tables: Sequence[TimeCells],
        *,
        memory: RayMemory | None = None,
    ) -> None:
        _check_tables(tables, detector_shape)
        self.rt, self.grid, self.detector_shape = rt, grid, detector_shape
        self.volume_shape = grid.shape
        self._readout = tables[0].readout
        layout = RayLayout.of_scan(grid, detector_shape, self._readout.axis)
        # a GPU's work-items are pixels, whose loads the general kernel has side by side
        self._upright = 0 if rt.pixel_items else upright_block(grid, tables, layout.width, rt.lanes)
        self.memory = memory or RayMemory(rt, layout, len(tables), upright=self._upright > 0)
        self._is_turned = self._upright > 0 and self.memory.is_upright and serve_one_line_each(tables)
        self._tables = list(tables)
        self._cells = RayCells.upload(rt, grid, self._tables)
        self._choose(np.arange(len(tables)))

    @property
    def tables(self) -> list[TimeCells]:
        """The cells of each frame."""
        return [self._tables[f] for f in self._chosen]

    def forward(self, volume: SameArray, out: SameArray | None = None) -> SameArray:
        """A x; volume (nz, ny, nx) 1/mm, result (F, rows, columns) float32."""
        return self.project(volume, "log", out)

    def intensity_gap(self, volume: SameArray, out: SameArray | None = None) -> SameArray:
        """A x − I(x) with I(x) = −ln Σ w exp(−p) over a line's cells, where A x is Σ w p; shapes as in ``forward``.

        Never negative but for rounding; computed from differences between cells, so that small gaps are right too. Added
        to what an intensity detector measured of about x, it is what a log detector would have measured.
        """
        return self.project(volume, "gap", out)

    def project(self, volume: SameArray, average: str, out: SameArray | None = None) -> SameArray:
        """Frames with a line's cells averaged by ``average``, one of rays.AVERAGES; shapes as in ``forward``."""
        _check_shape("volume", volume, self.volume_shape)
        result: SameArray = _room_for(self.rt, self.frames_shape, volume, out)
        with_smaller_bricks(
            "ray-driven projector", lambda share: self._project(volume, average, share, result)
        )
        return result

    def _project(self, volume: Array, average: str, share: float, result: Array) -> None:
        bricks = self.memory.plan(share)
        if average != "log" and len(bricks) > 1:
            self._project_layers(volume, average, result)
            return
        for part in self.memory.batches(len(self._chosen)):
            listed = self._listed(part)
            frames = self.memory.frames(listed.size)
            for k, brick in enumerate(bricks):
                if k + part.start == 0 or len(bricks) > 1:
                    layout, on_device = self.memory.write_volume(volume, brick)
                    columns = self._turned(layout, on_device, average)
                if columns is not None:
                    launch_upright(self.rt, layout, self._cells, listed, columns, frames, self._upright)
                    continue
                launch_forward(
                    self.rt, layout, self._cells, listed, on_device, frames, average=average, add=k > 0
                )
            self.memory.read_frames(frames, result, part, self._readout.axis)

    def _turned(self, layout: RayLayout, volume: DeviceArray, average: str) -> DeviceArray | None:
        """The volume for the kernel of upright rays; None where that does not apply."""
        return self.memory.turned(layout, volume) if self._upright and average == "log" else None

    def _project_layers(self, volume: Array, average: str, result: Array) -> None:
        """Averages that need a whole ray at a time, where no brick has one: every layer by itself, averaged on the host."""
        ones, weights = layered(self.tables)
        like = (self.rt, self.grid, self.detector_shape)
        on_host = self.rt.download(volume) if isinstance(volume, DeviceArray) else volume
        parts = [RayOperator(*like, tables, memory=self.memory).forward(on_host) for tables in ones]
        frames = averaged(parts, weights, average)
        if isinstance(result, DeviceArray):
            self.rt.write(result, frames)
        else:
            result[...] = frames

    def adjoint(self, frames: SameArray, out: SameArray | None = None) -> SameArray:
        """Aᵀ y; frames (F, rows, columns), result (nz, ny, nx) float32."""
        _check_shape("frames", frames, self.frames_shape)
        result: SameArray = _room_for(self.rt, self.volume_shape, frames, out)
        with_smaller_bricks(
            "ray-driven backprojector", lambda share: self._adjoint(frames, share, result)
        )
        return result

    def _adjoint(self, frames: Array, share: float, result: Array) -> None:
        bricks = self.memory.plan(share)
        parts = list(self.memory.batches(len(self._chosen)))
        for k, brick in enumerate(bricks):
            layout, on_device = self.memory.volume(brick)
            for part in parts:
                listed = self._listed(part)
                add = part.start > 0
                if self._is_turned:
                    if k == 0 or len(parts) > 1:
                        turned = self.memory.write_turned(frames, part, self._readout.axis)
                        weigh_columns(self.rt, layout, self._cells, listed, turned)
                    launch_upright_adjoint(self.rt, layout, self._cells, listed, turned, on_device, add=add)
                    continue
                if k == 0 or len(parts) > 1:
                    by_line = self.memory.write_frames(frames, part, self._readout.axis)
                launch_adjoint(self.rt, layout, self._cells, listed, by_line, on_device, add=add)
            self.memory.read_volume(layout, on_device, result)

    def subset(self, frames: Sequence[int]) -> "RayOperator":
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
        self._lists: dict[tuple[int, int], DeviceArray] = {}

    def _listed(self, part: slice) -> DeviceArray:
        """The indices of some of the chosen frames on the device."""
        key = part.start, part.stop
        if key not in self._lists:
            self._lists[key] = self.rt.upload(self._chosen[part], np.int32)
        return self._lists[key]


def _check_tables(tables: Sequence[TimeCells], detector_shape: tuple[int, int]) -> None:
    if not tables:
        raise InputError("tables", "no frames", "the time cells of at least one frame")
    axis = tables[0].axis
    lines, _ = tables[0].readout.shape(detector_shape)
    for frame, table in enumerate(tables):
        if (table.axis, table.lines) != (axis, lines):
            found = f"{table.lines} {table.axis} in frame {frame}"
            raise InputError("tables", found, f"{lines} {axis} in every frame")


def _check_shape(name: str, values: Array, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise InputError(name, f"shape {values.shape}", f"shape {shape}")
    if isinstance(values, DeviceArray) and values.dtype != np.float32:
        raise InputError(name, f"a device array of {values.dtype}", "float32")


def _room_for(rt: Runtime, shape: tuple[int, ...], like: Array, out: Array | None) -> Any:
    """Memory for a float32 result where ``like`` is: ``out``, or new."""
    if out is not None:
        _check_shape("out", out, shape)
        if isinstance(out, DeviceArray) != isinstance(like, DeviceArray):
            raise InputError("out", "an array elsewhere than the argument", "both on the device, or both NumPy's")
        return out
    return rt.empty(shape) if isinstance(like, DeviceArray) else np.empty(shape, np.float32)
