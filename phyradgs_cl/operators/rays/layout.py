"""Layout of volumes, frames and time cells (poses with lines) in device memory for the ray-driven projector
(cl/common/ray.h).

A detector that averages intensities needs separate line integrals for each time cell of a line. ``layered`` divides the
cells into layers, in which every line has at most one cell."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.bricks import Brick, whole
from phyradgs_cl.operators.splats.layout import projection_matrices
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, pitch_of

_RAY_CELL_FLOATS = 16  # number of floats of a time cell in ``ray_constants``
BORDER = 1  # width in voxels of the zeros around a volume in y and z, so that samples at its faces need no test
_UPRIGHT = 1e-6  # a column of pixels counts as upright if it leans by at most this many voxels over all lines
_WIDEST = 16  # number of elements in the widest SIMD vector: tables are padded by as many, since vectors read past the end


@dataclass(frozen=True)
class RayLayout:
    """Layout of volumes (nz, ny, nx) and of stacks of frames with ``lines`` × ``width`` pixels in device memory.

    brick: the part of the grid that the volume holds. The volume has a border of zeros, so that the frames of all bricks
    add up to the frames of the grid. subrays: the rays of a pixel along (v, u); ``lines`` and ``width`` count rays. axis:
    whether lines are "rows" or "columns" of the detector. is_across: lines are rows although the panel is read column by
    column."""

    grid: Grid
    lines: int
    width: int
    brick: Brick
    subrays: tuple[int, int] = (1, 1)
    axis: str = "rows"
    is_across: bool = False

    @classmethod
    def of_scan(
        cls, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], axis: str, subrays: tuple[int, int] = (1, 1)
    ) -> "RayLayout":
        """Returns the layout of the complete grid. Frames are stored line by line, as the panel is read along ``axis``.

        detector_shape: (rows, columns). A CPU's vectors run along a line. On a panel with fewer rows than a vector has
        lanes, vectors along columns would be partly empty. So its lines are rows, even if it is read column by column."""
        (rows, columns), (along_v, along_u) = detector_shape, subrays
        shape = rows * along_v, columns * along_u
        is_across = axis == "columns" and not rt.pixel_items and shape[0] < rt.lanes
        own = "rows" if is_across else axis
        return cls(grid, *Readout(own).shape(shape), whole(grid.shape), subrays, own, is_across)

    def of(self, brick: Brick) -> "RayLayout":
        """Returns the memory layout for the same frames and another part (brick) of the grid."""
        return replace(self, brick=brick)

    @property
    def volume_floats(self) -> int:
        nz, ny, nx = self.brick.shape
        return 2 * GUARD + (nz + 2 * BORDER) * (ny + 2 * BORDER) * pitch_of(nx)

    def frames_floats(self, count: int) -> int:
        return 2 * GUARD + count * self.lines * pitch_of(self.width)

    @property
    def turned(self) -> "RayLayout":
        """The layout for frames stored transposed, (F, width, lines)."""
        return replace(self, lines=self.width, width=self.lines)

    def frames_shape(self, count: int) -> tuple[int, int, int]:
        return count, self.lines, self.width

    @property
    def volume_strides(self) -> Strides:
        """The strides in floats of the padded volume. They start at its first voxel inside the border."""
        _, ny, nx = self.brick.shape
        row, slice_ = pitch_of(nx), pitch_of(nx) * (ny + 2 * BORDER)
        return Strides(GUARD + BORDER * (slice_ + row), slice_, row)

    @property
    def frames_strides(self) -> Strides:
        """The strides in floats of a stack of padded frames (F, lines, width), from frame to frame and from line to line."""
        row = pitch_of(self.width)
        return Strides(GUARD, self.lines * row, row)

    def pixel_strides(self, axis: str, *, turned: bool = False) -> tuple[int, int, int, int]:
        """Returns the offset of padded frames, and the strides to the next detector column, row and frame, in floats.

        axis: the axis along which the panel is read. turned: the frames are stored transposed, (F, width, lines)."""
        strides = self.turned.frames_strides if turned else self.frames_strides
        steps = (1, strides.row) if (axis == "rows") != turned else (strides.row, 1)
        return (strides.start, *steps, strides.slice)

    def column_floats(self, axis: str) -> int:
        """Returns the number of floats of a padded frame that is stored by columns. axis: as for ``pixel_strides``."""
        return (self.turned if axis == "rows" else self).frames_strides.slice

    def inside(self, flat: np.ndarray) -> np.ndarray:
        """Returns a view (nz, ny, nx) of a padded volume, without the padding."""
        nz, ny, nx = self.brick.shape
        padded = flat[GUARD:-GUARD].reshape(nz + 2 * BORDER, ny + 2 * BORDER, pitch_of(nx))
        return padded[BORDER:-BORDER, BORDER:-BORDER, :nx]

    def constants(self) -> tuple[np.ndarray | np.int32, ...]:
        """Returns arguments of kernels: the brick's shape (x, y, z), first voxel, pitch of rows in floats and voxel size in
        mm; a frame's lines, width and pitch of lines."""
        nz, ny, nx = self.brick.shape
        dz, dy, dx = self.grid.voxel_size_mm
        return (
            np.array([nx, ny, nz, 0], np.int32),
            np.array([*self.brick.start[::-1], 0], np.int32),
            np.int32(pitch_of(nx)),
            np.array([dx, dy, dz, 0], np.float32),
            np.int32(self.lines),
            np.int32(self.width),
            np.int32(pitch_of(self.width)),
        )


@dataclass(frozen=True, eq=False)
class RayCells:
    """The time cells (poses with their lines) of many frames on the device, in the arrays that cl/rays.cl describes."""

    cells: DeviceArray
    cell_lines: DeviceArray
    line_cells: DeviceArray
    matrices: DeviceArray
    matrix_stride: int
    frame_cells: DeviceArray
    weights: DeviceArray
    weight_at: DeviceArray
    is_parallel: bool
    is_across: bool
    upright: int  # whether pixels lie in columns along z: 0, 1 or 2, as ``_upright`` returns
    most_per_line: int  # largest number of cells that serve the same line of a frame

    @classmethod
    def upload(
        cls, rt: Runtime, grid: Grid, tables: Sequence[TimeCells], rows_across: int | None = None
    ) -> "RayCells":
        """Uploads the tables of all frames. rows_across: the panel's rows if ``RayLayout.is_across``, else None."""
        starts = np.concatenate([[0], np.cumsum([table.count for table in tables])])
        pose = np.concatenate([table.readout.poses(table.pose) for table in tables])
        weights = [table.weights_of(cell) for table in tables for cell in range(table.count)]
        ranges = [np.stack([table.line_start, table.line_stop], -1) for table in tables]
        served = [table.line_cells() + start for table, start in zip(tables, starts[:-1], strict=True)]
        if rows_across is not None:
            pose = np.concatenate([table.pose for table in tables])
            # A SIMD vector may begin at any column and reach beyond a cell's columns. There the cell's weight must be 0.
            weights = [np.pad(weight, _WIDEST) for weight in weights]
            served = [np.tile(ends, (rows_across, 1)) for ends in zip(starts[:-1], starts[1:], strict=True)]
        weight_at = np.concatenate([[0], np.cumsum([len(weight) for weight in weights])])
        matrices, stride = matrix_table(pose, grid, tables[0].is_parallel)
        constants = ray_constants(pose, grid, tables[0].is_parallel)
        cell_lines = np.zeros((stride, 2), np.int32)
        cell_lines[: starts[-1]] = np.concatenate(ranges)
        return cls(
            cells=rt.upload(constants),
            cell_lines=rt.upload(cell_lines),
            line_cells=rt.upload(np.stack(served), np.int32),
            matrices=rt.upload(matrices, np.float32),
            matrix_stride=stride,
            frame_cells=rt.upload(starts, np.int32),
            weights=rt.upload(np.concatenate(weights), np.float32),
            weight_at=rt.upload(weight_at + (_WIDEST if rows_across is not None else 0), np.int32),
            is_parallel=tables[0].is_parallel,
            is_across=rows_across is not None,
            upright=_upright(constants, max(int(table.line_stop.max(initial=0)) for table in tables)),
            most_per_line=max(1, *(int(np.ptp(ends, axis=1).max()) for ends in served)),
        )


def _upright(constants: np.ndarray, lines: int) -> int:
    """Returns whether pixels lie in columns along z in all poses, given as ``ray_constants``: 1 if lines are rows, 2 if they
    are columns, 0 if columns lean. Rounding may move pixels by ``_UPRIGHT`` voxels within ``lines`` lines."""
    eu, ev = np.abs(constants[:, 6:9]) * lines, np.abs(constants[:, 9:12]) * lines
    for kind, along, across in (1, ev, eu), (2, eu, ev):
        if max(along[:, :2].max(), across[:, 2].max()) <= _UPRIGHT and along[:, 2].min() > 0:
            return kind
    return 0


def matrix_table(pose: np.ndarray, grid: Grid, is_parallel: bool = False) -> tuple[np.ndarray, int]:
    """Returns ``voxel_matrices`` of poses (C, 12), transposed to (12, stride), and the stride. The stride is larger than C,
    because vectors read beyond the last pose."""
    stride = len(pose) + _WIDEST
    matrices = np.zeros((12, stride))
    matrices[:, : len(pose)] = voxel_matrices(pose, grid, is_parallel).T
    return matrices, stride


def ray_constants(pose: np.ndarray, grid: Grid, is_parallel: bool = False) -> np.ndarray:
    """Returns poses (C, 12) in units of voxels, as the table (C, 16) float32 that cl/common/ray.h describes."""
    if is_parallel:
        return _parallel_constants(pose, grid)
    first = np.array(grid.first_centre_mm[::-1])
    pitch = np.array(grid.voxel_size_mm[::-1])
    constants = np.zeros((len(pose), _RAY_CELL_FLOATS))
    constants[:, 0:3] = (pose[:, 0:3] - first) / pitch
    constants[:, 3:6] = (pose[:, 3:6] - pose[:, 0:3]) / pitch
    constants[:, 6:9] = pose[:, 6:9] / pitch
    constants[:, 9:12] = pose[:, 9:12] / pitch
    return constants.astype(np.float32)


def _parallel_constants(pose: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns ``ray_constants`` for parallel beams: the direction divided by its largest component (of the main axis), and
    where rays meet the first plane of voxels along that axis."""
    first = np.array(grid.first_centre_mm[::-1])
    pitch = np.array(grid.voxel_size_mm[::-1])
    direction, panel = pose[:, 0:3] / pitch, pose[:, 3:].reshape(-1, 3, 3) / pitch
    panel[:, 0] -= first / pitch
    size = np.abs(direction)
    # The kernels take the first of components that are equal in float32. At 135°, for example, two differ in float64 only.
    main = np.argmax((size / size.max(axis=1, keepdims=True)).astype(np.float32), axis=1)
    cell = np.arange(len(pose))
    direction /= direction[cell, main][:, None]
    panel -= panel[cell, :, main][:, :, None] * direction[:, None]
    panel[cell, 0, main] = 1
    constants = np.zeros((len(pose), _RAY_CELL_FLOATS))
    constants[:, :12] = np.concatenate([direction, panel.reshape(-1, 9)], 1)
    return constants.astype(np.float32)


def voxel_matrices(pose: np.ndarray, grid: Grid, is_parallel: bool = False) -> np.ndarray:
    """Returns matrices (C, 3 · 4) that map voxel indices (x, y, z) to (u·depth, v·depth, depth) on the detector, where the
    depth is 1 in a parallel beam."""
    matrix = projection_matrices(pose, is_parallel).reshape(-1, 3, 4)
    first = np.array(grid.first_centre_mm[::-1])
    pitch = np.array(grid.voxel_size_mm[::-1])
    shift = np.einsum("cij,j->ci", matrix[:, :, :3], first) + matrix[:, :, 3]
    return np.concatenate([matrix[:, :, :3] * pitch, shift[:, :, None]], -1).reshape(-1, 12)


def layers(table: TimeCells) -> list[TimeCells]:
    """Divides the time cells of a frame into tables in which every line has at most one cell. Keeps their order."""
    numbers = table.layer_numbers
    return [some_cells(table, np.flatnonzero(numbers == k)) for k in range(int(numbers.max()) + 1)]


def layered(tables: Sequence[TimeCells]) -> tuple[list[list[TimeCells]], list[np.ndarray]]:
    """Divides the time cells of F frames into layers, in which a line has at most one cell. Returns the tables of each layer
    with weights of 1, and the weights.

    The weights of a layer are float32, (F, lines, 1) or (F, 1, lines) by the axis of readout, and 0 for lines without a cell
    in it."""
    split = [layers(table) for table in tables]
    ones, weights = [], []
    for k in range(max(len(parts) for parts in split)):
        parts = [p[k] if k < len(p) else _empty(p[0]) for p in split]
        weight = np.stack([part.line_weights() for part in parts]).astype(np.float32)
        weights.append(tables[0].readout.spread(weight))
        ones.append([replace(part, weight=np.ones(part.count), line_share=None) for part in parts])
    return ones, weights


def some_cells(table: TimeCells, cells: Sequence[int] | np.ndarray) -> TimeCells:
    """Returns a table of only the time cells numbered ``cells``. All must be still: one pose each."""
    names = ["pose", "time_s", "line_start", "line_stop", "weight"]
    names += [] if table.line_share is None else ["line_share"]
    return replace(table, **{name: getattr(table, name)[cells] for name in names})


def _empty(table: TimeCells) -> TimeCells:
    """Returns a table with one cell, taken from ``table``, that serves no line. It stands for a frame without cells in a
    layer, because a table must not be empty."""
    one = some_cells(table, [0])
    return replace(one, line_stop=one.line_start.copy(), weight=np.zeros(1))
