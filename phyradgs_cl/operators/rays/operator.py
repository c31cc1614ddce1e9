"""The system matrix A of a scan, from a volume to the line integrals of all frames, and its exact transpose.

Each frame has a table of time cells: poses, the detector lines that each pose serves, and weights. A pixel is the weighted
average of the line integrals from the poses that serve its line. Frames are projected in batches. A volume that does not fit
on the device is projected in parts, called bricks (``RayMemory``).

Two sets of kernels compute the same samples. The general kernels follow each ray (``general.py``). They serve GPUs, and CPUs
where ``upright_of`` refuses the scan. Otherwise, CPUs use the upright kernels, for detector columns nearly along z: they
project each pose once, into its own buffer ("slot"), and average slots to frames (``upright.py``, ``slots.py``)."""

from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, Protocol

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.general import launch_adjoint, launch_forward
from phyradgs_cl.operators.rays.layout import RayCells, RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.slots import Slots, UprightPoses, merge_slots, split_slots
from phyradgs_cl.operators.rays.subrays import SINGLE
from phyradgs_cl.operators.rays.upright import launch_upright, launch_upright_adjoint, upright_of
from phyradgs_cl.runtime import Array, DeviceArray, Runtime, SameArray, attempts
from phyradgs_cl.runtime.layout import Strides


class LinearOperator(Protocol):
    """The interface that iterative methods need: A, Aᵀ, and A for some of the frames. ``out``: receives the result."""

    @property
    def volume_shape(self) -> tuple[int, ...]: ...

    @property
    def frames_shape(self) -> tuple[int, int, int]: ...

    def forward(self, volume: Any, out: Any = None) -> Any:
        """Projects a volume x (nz, ny, nx) in 1/mm: returns A x, frames (F, rows, columns) float32."""

    def adjoint(self, frames: Any, out: Any = None) -> Any:
        """Backprojects frames y (F, rows, columns): returns Aᵀ y, a volume (nz, ny, nx) float32."""

    def subset(self, frames: Sequence[int]) -> "LinearOperator":
        """Returns the operator to the frames with the numbers ``frames``, in that order."""


class RayOperator:
    """Projects volumes to frames with Joseph's method, and backprojects with its exact transpose: a ``LinearOperator``.

    NumPy arrays give NumPy arrays; device arrays (not padded, float32) give device arrays. ``out``, of the same kind,
    receives the result. detector_shape: (rows, columns). tables: the time cells of each frame, all read along one axis.
    memory: buffers to share with other operators. Operators that share them, and subsets of an operator, must be used one at
    a time. fewest_lines: the upright kernels are used if a pose serves at least this many lines on average (``upright_of``).
    ``FEWEST_LINES`` is fastest for panels with few lines, and changes results by rounding. subrays: the numbers of rays of a
    pixel along (v, u), see ``subrays_of``. A given ``memory`` determines them instead.

    Joseph, IEEE Trans. Med. Imaging 1 (1982) 192. Raises InputError for tables that do not fit the detector."""

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells], *,
        memory: RayMemory | None = None, fewest_lines: int | None = None, subrays: tuple[int, int] = SINGLE,
    ) -> None:  # fmt: skip
        _check_tables(tables, detector_shape)
        subrays = subrays if memory is None else memory.layout.subrays
        self.rt, self.grid, self.detector_shape = rt, grid, detector_shape
        self.volume_shape = grid.shape
        rays_shape = detector_shape[0] * subrays[0], detector_shape[1] * subrays[1]
        layout = memory.layout if memory else RayLayout.of_scan(rt, grid, detector_shape, tables[0].axis, subrays)
        self._axis = layout.axis
        self._tables = list(tables)
        if subrays != SINGLE:
            tables = [table.finer(*subrays) for table in tables]
        # The upright kernels are for CPUs. GPUs are fast with the general one: neighbouring pixels read neighbouring memory.
        may_use_slots = not rt.pixel_items and (memory is None or memory.slot_floats > 0)
        self._upright = upright_of(grid, tables, rays_shape, rt.lanes, fewest_lines) if may_use_slots else None
        self._poses: UprightPoses | None = None
        self.slot_floats = 0
        if self._upright is not None:
            self._poses = UprightPoses.upload(rt, grid, tables)
            self.slot_floats = self._poses.floats_per_frame(rays_shape, self._upright.leans)
        self.memory = memory or RayMemory(rt, layout, len(tables), self.slot_floats)
        if self.slot_floats > self.memory.slot_floats:  # the given memory has no room for slots
            self._upright = None
        self._rays_shape = rays_shape
        self._cells = RayCells.upload(rt, grid, tables, rays_shape[0] if layout.is_across else None)
        self._choose(np.arange(len(tables)))

    @property
    def tables(self) -> list[TimeCells]:
        """The time cells of each frame of this operator."""
        return [self._tables[f] for f in self._chosen]

    def forward(self, volume: SameArray, out: SameArray | None = None) -> SameArray:
        """Projects a volume x (nz, ny, nx) in 1/mm to frames A x, (F, rows, columns) float32."""
        _check_shape("volume", volume, self.volume_shape)
        result: SameArray = _room_for(self.rt, self.frames_shape, volume, out)
        for attempt in attempts("ray-driven projector"):
            with attempt as share:
                self._forward(volume, share, result)
        return result

    def _forward(self, volume: Array, share: float, result: Array) -> None:
        bricks = self.memory.plan(share)
        columns = self.memory.turned(volume) if self._is_upright and self.memory.has_columns else None
        for part in self.memory.batches(len(self._chosen)):
            frames = self.memory.frames(part.stop - part.start)
            if columns is not None:
                self._forward_upright(columns, part, frames)
                self.memory.read_frames(frames, result, part, self._axis)
                continue
            listed = self._listed(part)
            for k, brick in enumerate(bricks):
                if k + part.start == 0 or len(bricks) > 1:
                    layout, on_device = self.memory.write_volume(volume, brick)
                launch_forward(self.rt, layout, self._cells, listed, on_device, frames, add=k > 0)
            self.memory.read_frames(frames, result, part, self._axis)

    @property
    def _is_upright(self) -> bool:
        return self._upright is not None and self.memory.slot_frames > 0

    def _forward_upright(self, columns: DeviceArray, part: slice, frames: DeviceArray) -> None:
        """Projects a volume transposed to ``columns`` (y, x, z) to the frames ``part``, whose rows are padded."""
        assert self._upright is not None and self._poses is not None
        layout = self.memory.layout
        start, *steps = layout.pixel_strides(self._axis)
        for first, slots in self._slots_of(part):
            target = frames, np.array([start + first * steps[-1], *steps], np.int64)
            if slots.is_plain:
                launch_upright(self.rt, layout, self._upright, self._poses, slots, columns, target)
                continue
            there = self.memory.slots()
            launch_upright(self.rt, layout, self._upright, self._poses, slots, columns, (there, slots.strides))
            merge_slots(self.rt, self._cells, slots, there, target, self._rays_shape, self._axis)

    def _slots_of(self, part: slice) -> Iterator[tuple[int, Slots]]:
        """Divides the frames ``part`` into groups whose ``Slots``, one buffer per pose, fit into memory. Yields the number
        of each group's first frame within ``part``, and its ``Slots``."""
        assert self._upright is not None and self._poses is not None
        for first in range(part.start, part.stop, self.memory.slot_frames):
            key = first, min(first + self.memory.slot_frames, part.stop)
            if key not in self._slots:
                chosen = self._chosen[slice(*key)]
                most_floats = self.memory.slot_frames * self.memory.slot_floats
                like = self._rays_shape, self._upright.leans, most_floats
                self._slots[key] = self._poses.slots(self.rt, chosen, *like)
            yield first - part.start, self._slots[key]

    def adjoint(self, frames: SameArray, out: SameArray | None = None) -> SameArray:
        """Backprojects frames y (F, rows, columns) to a volume Aᵀ y, (nz, ny, nx) float32."""
        _check_shape("frames", frames, self.frames_shape)
        result: SameArray = _room_for(self.rt, self.volume_shape, frames, out)
        for attempt in attempts("ray-driven backprojector"):
            with attempt as share:
                self._adjoint(frames, share, result)
        return result

    def _adjoint(self, frames: Array, share: float, result: Array) -> None:
        bricks = self.memory.plan(share)
        parts = list(self.memory.batches(len(self._chosen)))
        for k, brick in enumerate(bricks):
            layout, on_device = self.memory.volume(brick)
            target = on_device, layout.volume_strides
            if self._is_upright and isinstance(result, DeviceArray):
                target = result, Strides.plain(result.shape, brick.start)
            for part in parts:
                add, axis = part.start > 0, self._axis
                if k == 0 or len(parts) > 1:
                    turns = self._is_upright and axis == "rows"
                    there = self.memory.write_frames(frames, part, axis, turned=turns)
                if self._is_upright:
                    self._adjoint_upright(layout, part, there, target, add)
                    continue
                launch_adjoint(self.rt, layout, self._cells, self._listed(part), there, on_device, add=add)
            if target[0] is on_device:
                self.memory.read_volume(layout, on_device, result)

    def _adjoint_upright(
        self, layout: RayLayout, part: slice, frames: DeviceArray, target: tuple[DeviceArray, Strides], add: bool
    ) -> None:
        """Backprojects the frames ``part``, stored column by column, to ``target``, a volume with its strides. add: adds to
        the volume, else overwrites it."""
        assert self._upright is not None and self._poses is not None
        there, pitch_mm = self.memory.slots(), layout.constants()[3]
        each = layout.column_floats(self._axis)
        for first, slots in self._slots_of(part):
            like = self._rays_shape, pitch_mm, first * each
            split_slots(self.rt, self._cells, self._poses, slots, frames, *like, there)
            launch_upright_adjoint(
                self.rt, layout, self._upright, self._poses, slots, there, target, add=add or first > 0
            )

    def subset(self, frames: Sequence[int]) -> "RayOperator":
        """Returns the operator to the frames with the numbers ``frames``, in that order. Keep it for further use, because
        its tables take time to upload. Raises InputError for no frames."""
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
        self._slots: dict[tuple[int, int], Slots] = {}

    def _listed(self, part: slice) -> DeviceArray:
        """Uploads, once, the numbers that this operator's frames ``part`` have in the whole scan, and returns them."""
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
    """Returns ``out`` if given, else a new float32 array: on the device if ``like`` is there, else on the host."""
    if out is not None:
        _check_shape("out", out, shape)
        if isinstance(out, DeviceArray) != isinstance(like, DeviceArray):
            raise InputError("out", "an array of the other kind", "a device array for a device array, NumPy for NumPy")
        return out
    return rt.empty(shape) if isinstance(like, DeviceArray) else np.empty(shape, np.float32)
