"""Slots: buffers of the upright kernels (``upright.py``). A slot has the line integrals from one pose, for the lines that
the panel reads out or exposes while the pose holds.

A frame is a weighted average of slots, with a weight for each of its lines. If exposures follow each other without gaps,
neighbouring frames share poses. A shared pose is projected only once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.checks import few_sizes
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.layout import RayCells, matrix_table, ray_constants
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, pitch_of

_SLOT_INTS, _SHARE_INTS = 8, 4  # integers per slot (cl/common/ray_column.h) and per share (cl/rays_slots.cl)
_SAME_POSE = 10  # poses are the same if they agree to this many decimals, after division by the largest number in all poses


@dataclass(frozen=True, eq=False)
class UprightPoses:
    """The distinct poses of F frames on the device, and which pose each of the frames' E time cells has.

    pose_of (E,): the number of a cell's pose. first, stop (E,): a cell's lines [first, stop). frame_cells (F + 1,): frame f
    has the cells frame_cells[f] to frame_cells[f + 1] − 1."""

    cells: DeviceArray
    matrices: DeviceArray
    matrix_stride: int
    pose_of: np.ndarray
    first: np.ndarray
    stop: np.ndarray
    frame_cells: np.ndarray
    is_plain: bool  # whether every frame has one cell, with all lines and a weight of 1
    axis: str
    is_parallel: bool

    @classmethod
    def upload(cls, rt: Runtime, grid: Grid, tables: Sequence[TimeCells]) -> "UprightPoses":
        poses = np.concatenate([table.pose for table in tables])
        scale = np.abs(poses).max() or 1.0
        _, where, pose_of = np.unique(np.round(poses / scale, _SAME_POSE), axis=0, return_index=True, return_inverse=True)
        matrices, stride = matrix_table(poses[where], grid, tables[0].is_parallel)
        weights = np.concatenate([table.weights_of(c) for table in tables for c in range(table.count)])
        counts = [table.count for table in tables]
        first = np.concatenate([table.line_start for table in tables])
        stop = np.concatenate([table.line_stop for table in tables])
        whole = all(n == 1 for n in counts) and (stop - first == tables[0].lines).all()
        return cls(
            cells=rt.upload(ray_constants(poses[where], grid, tables[0].is_parallel)),
            matrices=rt.upload(matrices, np.float32), matrix_stride=stride, pose_of=pose_of.reshape(-1),
            first=first, stop=stop, frame_cells=np.concatenate([[0], np.cumsum(counts)]),
            is_plain=bool(whole and (weights == 1).all()), axis=tables[0].axis,
            is_parallel=tables[0].is_parallel,
        )

    def floats_per_frame(self, detector_shape: tuple[int, int], leans: bool) -> int:
        """Returns the most floats that the slots (buffers, one per pose) of a frame need: line integrals and, if columns
        lean, the rays' slopes along z."""
        rows, columns = detector_shape
        widest = int((self.stop - self.first).max())
        each = columns * pitch_of(widest) if self.axis == "rows" else widest * pitch_of(rows)
        return int(np.diff(self.frame_cells).max()) * each * (2 if leans else 1)

    def slots(
        self, rt: Runtime, frames: np.ndarray, detector_shape: tuple[int, int], leans: bool, most_floats: int
    ) -> "Slots":
        """Returns the slots (buffers, each for the line integrals of one pose) of the frames numbered ``frames`` (n,), in
        the order of first use. They take at most ``most_floats`` floats, which must be at least n · ``floats_per_frame``."""
        cells = np.concatenate([np.arange(self.frame_cells[f], self.frame_cells[f + 1]) for f in frames])
        of_frame = np.repeat(np.arange(len(frames)), np.diff(self.frame_cells)[frames])
        _, appears, slot = np.unique(self.pose_of[cells], return_index=True, return_inverse=True)
        order = np.argsort(appears)
        appears, slot = appears[order], np.argsort(order)[slot.reshape(-1)]
        table = self._table(cells, appears, slot, detector_shape)
        columns, rows = _largest(table)
        if (2 if leans else 1) * len(table) * columns * pitch_of(rows) > most_floats:
            # A slot for cells whose lines are far apart would also hold all lines between. So each cell gets its own slot.
            appears = slot = np.arange(len(cells))
            table = self._table(cells, appears, slot, detector_shape)
            columns, rows = _largest(table)
        by_slot = np.argsort(slot, kind="stable")
        return Slots(
            slots=rt.upload(table),
            frame_shares=rt.upload(np.concatenate([[0], np.cumsum(np.diff(self.frame_cells)[frames])]), np.int32),
            shares=rt.upload(self._shares(cells, slot), np.int32),
            slot_shares=rt.upload(np.searchsorted(slot[by_slot], np.arange(len(table) + 1)), np.int32),
            shares_by_slot=rt.upload(self._shares(cells[by_slot], of_frame[by_slot]), np.int32),
            count=len(table),
            frames=len(frames),
            columns=columns,
            rows=rows,
            is_plain=self.is_plain and len(table) == len(frames),
            leans=leans,
            is_parallel=self.is_parallel,
        )

    def _table(
        self, cells: np.ndarray, appears: np.ndarray, slot: np.ndarray, detector_shape: tuple[int, int]
    ) -> np.ndarray:
        """Returns the table (S, 8) int32 that describes S slots to kernels. appears (S,): the index in ``cells`` of the
        first cell of each slot. slot (E,): the slot of each cell."""
        first, stop = np.full(len(appears), 2**31 - 1), np.zeros(len(appears), np.int64)
        np.minimum.at(first, slot, self.first[cells])
        np.maximum.at(stop, slot, self.stop[cells])
        table = np.zeros((len(appears), _SLOT_INTS), np.int32)
        table[:, 0] = self.pose_of[cells][appears]
        table[:, 2], table[:, 4] = detector_shape[1], detector_shape[0]
        along = (3, 4) if self.axis == "rows" else (1, 2)
        table[:, along] = np.stack([first, stop], -1)
        return table

    def _shares(self, cells: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Returns the shares (E, 4). A share is a cell's part in a frame: number of its slot or frame (``of``), lines
        [first, stop), and where its weights begin in ``RayCells``."""
        begins = np.concatenate([[0], np.cumsum(self.stop - self.first)])
        return np.stack([of, self.first[cells], self.stop[cells], begins[cells]], -1)


def _largest(table: np.ndarray) -> tuple[int, int]:
    return int((table[:, 2] - table[:, 1]).max()), int((table[:, 4] - table[:, 3]).max())


@dataclass(frozen=True, eq=False)
class Slots:
    """The slots (buffers, one per pose) of some frames on the device, as the arrays that cl/rays_slots.cl describes.
    columns, rows: the size of every slot in pixels, that of the largest slot."""

    slots: DeviceArray
    frame_shares: DeviceArray
    shares: DeviceArray
    slot_shares: DeviceArray
    shares_by_slot: DeviceArray
    count: int
    frames: int
    columns: int
    rows: int
    is_plain: bool
    leans: bool
    is_parallel: bool

    @property
    def pitch(self) -> int:
        """The number of floats from one detector column of a slot to the next."""
        return pitch_of(self.rows)

    @property
    def floats(self) -> int:
        return self.count * self.columns * self.pitch

    @property
    def strides(self) -> np.ndarray:
        """The offset of the line integrals, and the strides to the next column, row and slot: (4,) in floats."""
        return np.array([GUARD, self.pitch, 1, self.columns * self.pitch], np.int64)

    @property
    def defines(self) -> dict[str, int]:
        return {"IMAGE_GUARD": GUARD, "RAY_LONG": 0, "LEAN": int(self.leans), "RAY_PARALLEL": int(self.is_parallel)}


def merge_slots(
    rt: Runtime, cells: RayCells, slots: Slots, integrals: DeviceArray,
    target: tuple[DeviceArray, np.ndarray], detector_shape: tuple[int, int], axis: str,
) -> None:
    """Averages slots, the line integrals of one pose each, to frames. target: the frames, their offset, and their strides to
    the next column, row and frame, in floats."""
    rows, columns = detector_shape
    rt.launch(
        rt.kernel("rays_slots", "merge_slots", **{**slots.defines, "LEAN": 0}),
        (columns, slots.frames), integrals, slots.columns, slots.pitch, slots.slots, slots.frame_shares,
        slots.shares, cells.weights, axis == "rows", columns, rows, target[1], target[0],
        group=few_sizes(columns, 8),
    )  # fmt: skip


def split_slots(
    rt: Runtime, cells: RayCells, poses: UprightPoses, slots: Slots, turned: DeviceArray,
    detector_shape: tuple[int, int], pitch_mm: np.ndarray | np.int32, start: int, values: DeviceArray,
) -> None:
    """Transpose of ``merge_slots``: writes weight × pixel to each slot, times the ray's length in mm from one plane of
    voxels to the next.

    turned: frames stored transposed, (F, columns, rows), from float ``start`` on. values: receives a float per pixel of each
    slot, then, if columns lean, the rays' slopes along z."""
    rows, columns = detector_shape
    rt.launch(
        rt.kernel("rays_slots", "split_slots", **slots.defines), (slots.columns, slots.count),
        turned, np.int64(start), pitch_of(rows), poses.cells, slots.slots, slots.slot_shares,
        slots.shares_by_slot, cells.weights, poses.axis == "rows", columns, pitch_mm, slots.columns,
        slots.pitch, np.int64(slots.floats), values, group=1,
    )  # fmt: skip
