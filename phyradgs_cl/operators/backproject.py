"""Voxel-driven backprojection with FDK's distance weight, with one pose per frame or one pose per line.

If memory is short, the volume is computed part by part and fewer views are uploaded at a time. The bits stay the same."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.bricks import Brick, Shape, cut
from phyradgs_cl.operators.rays.layout import voxel_matrices
from phyradgs_cl.runtime import Array, DeviceArray, Room, Runtime, SameArray, attempts
from phyradgs_cl.runtime.layout import GUARD, Strides, move, padded_zeros, pitch_of, unpad_rows

_VIEWS_PER_LAUNCH = 64  # most views in a launch, so that the few lines of each that a work-item reads stay in the cache
_BYTES_A_LAUNCH = 1 << 28  # most bytes of frames that are uploaded together
_VIEWS_SHARE = 0.25  # fraction of the free device memory for uploaded frames; the volume needs the rest
# Most voxels along z that a work-item sums in the kernels for upright columns of voxels (see ``_UPRIGHT``).
_BLOCK_VOXELS = 128
_COLUMN_ROWS = 512  # in the upright kernels, a work-item's voxels project to at most this many detector rows
# A column of voxels along z is upright if u·depth and depth change along it by at most this fraction of the least depth.
_UPRIGHT = 1e-7
# Largest lean of the image of a column of voxels, in detector columns per row. Beyond it the general kernel is faster.
_MOST_LEAN = 0.25
LINE_SAMPLES = 4  # (time of a voxel with one pose per line) / (its time with one pose per view)
_WIDEST = 16  # number of voxels along z in the widest vector, which may reach beyond the volume
Arguments = tuple[DeviceArray, DeviceArray, DeviceArray, np.int32, np.int32, np.int32, np.int32, np.int64]


def backproject(
    rt: Runtime, frames: SameArray, pose: np.ndarray, weight: np.ndarray, grid: Grid, *, is_parallel: bool = False,
    power: int = 2, is_even: bool = False,
) -> SameArray:
    """Returns Σ_f weight_f / z^power · frame_f(u, v) at every voxel centre. z = (voxel's depth)/(detector's depth), 1 in a
    parallel beam.

    frames (F, rows, columns) are interpolated bilinearly, and 0 outside; pose (F, 12) mm; weight (F,). power: 2 for FDK's
    distance weight, or 1. is_even: all pixels are 1, but 0 in the first and last row; kernels for upright columns of voxels
    then read no frames. The volume (nz, ny, nx) float32 is on the device if ``frames`` are, else on the host. Raises
    OutOfMemoryError if not even the smallest part of the volume fits."""
    matrices = voxel_matrices(pose, grid, is_parallel)
    block, leans = (0, False) if rt.pixel_items else _upright_block(matrices, grid)
    views = Views(frames, bool(block), matrices, weight)
    if block:
        name = "backproject_leaning" if leans else "backproject_upright"
        volume = in_bricks(rt, views, grid, block, lambda *where: _upright(rt, name, power, block, is_even, *where))
    else:
        volume = in_bricks(rt, views, grid, 1, lambda *where: _general(rt, power, *where))
    return cast(SameArray, volume)


def backproject_lines(
    rt: Runtime, frames: SameArray, pose: np.ndarray, weight: np.ndarray, grid: Grid, axis: str = "rows", *,
    is_parallel: bool = False, power: int = 2,
) -> SameArray:
    """Backprojects frames (F, rows, columns) in which every line along ``axis`` has its own pose: pose (F, lines, 12) mm.

    A voxel reads the line onto which that line's pose projects it, interpolated between neighbouring lines. The value is
    divided by the rate at which the readout crosses the voxel's image, because this rate changes the angular step. If a ramp
    filter ran across lines (``axis`` columns), it is divided once more, because the filter's scale changes too. See
    docs/mathematics.md. power: as in ``backproject``; 1 means frames that were not filtered."""
    pose = Readout(axis).poses(pose)
    matrices = voxel_matrices(pose.reshape(-1, 12), grid, is_parallel).reshape(len(pose), -1)
    views = Views(frames, axis == "columns", matrices, weight)
    return cast(SameArray, in_bricks(rt, views, grid, 1, lambda *where: _lines(rt, power, axis == "columns", *where)))


@dataclass(frozen=True, eq=False)
class Views:
    """The views to backproject: frames (F, rows, columns) and FDK's weight (F,), or (F, 2) in a ``MovingBackprojector``.

    is_turned: kernels get the frames transposed. matrices (F, 12 · poses): the ``voxel_matrices`` of each frame's poses."""

    frames: Array
    is_turned: bool
    matrices: np.ndarray
    weight: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of a frame in the kernels: (columns, rows) if it is transposed, else (rows, columns)."""
        _, rows, columns = self.frames.shape
        return (columns, rows) if self.is_turned else (rows, columns)

    def bytes(self, count: int) -> int:
        """Returns how many bytes ``count`` views take on the device."""
        rows, width = self.shape
        return 4 * count * int(2 * GUARD + rows * pitch_of(width) + self.matrices.shape[1] + 1)

    def padded(self, rt: Runtime, part: slice) -> DeviceArray:
        """Copies the n frames ``part`` to the device, padded and transposed if ``is_turned``. Returns (n, floats)."""
        count, (rows, width) = part.stop - part.start, self.shape
        pitch = pitch_of(width)
        each = 2 * GUARD + rows * pitch
        if isinstance(self.frames, DeviceArray):
            stacked = rt.zeros((count, each))
            source = self.frames, Strides.plain(self.frames.shape, (part.start, 0, 0))
            shape = count, *self.frames.shape[1:]
            move(rt, source, (stacked, Strides(GUARD, each, pitch)), shape, turned=self.is_turned)
            return stacked
        frames = self.frames[part]
        on_host = np.zeros((count, each), np.float32)
        body = on_host[:, GUARD : GUARD + rows * pitch].reshape(count, rows, pitch)
        body[:, :, :width] = frames.swapaxes(1, 2) if self.is_turned else frames
        return rt.upload(on_host)

    def parts(self, room: Room) -> Iterator[slice]:
        """Yields slices of the views, each of as many as fit into the memory of one launch."""
        most_bytes = min(_BYTES_A_LAUNCH, room.largest_bytes, int(_VIEWS_SHARE * room.free_bytes))
        count = max(1, min(_VIEWS_PER_LAUNCH, most_bytes // self.bytes(1)))
        for first in range(0, len(self.matrices), count):
            yield slice(first, min(first + count, len(self.matrices)))


_Launch = Callable[[Arguments, Brick, DeviceArray], None]


def in_bricks(rt: Runtime, views: Views, grid: Grid, step: int, launch: _Launch) -> Array:
    """Returns the views' volume (nz, ny, nx). ``launch`` adds some views to a brick, a part of the volume. The volume is one
    brick if it fits; else the sides along z of all bricks but the last are multiples of ``step``. Raises OutOfMemoryError
    if no brick fits."""
    is_resident = isinstance(views.frames, DeviceArray)
    volume: Array = rt.empty(grid.shape) if is_resident else np.empty(grid.shape, np.float32)

    def fill(share: float) -> None:
        room = rt.room()
        parts = list(views.parts(room.scaled(share)))
        views_bytes = views.bytes(parts[0].stop)
        bricks = cut(grid.shape, (step, 1), lambda shape: (_volume_bytes(shape), views_bytes), room, share)
        for brick in bricks:
            nz, ny, nx = brick.shape
            padded = padded_zeros(rt, nz * ny, nx)
            for part in parts:
                images = _images(rt, views, part)
                launch(images, brick, padded)
                del images  # frees the views' memory before the next are uploaded
            if isinstance(volume, DeviceArray):
                move(rt, (padded, _strides(brick)), (volume, Strides.plain(grid.shape, brick.start)), brick.shape)
            else:
                volume[brick.box] = unpad_rows(rt.download(padded), brick.shape)

    for attempt in attempts("FDK's backprojection"):
        with attempt as share:
            fill(share)
    return volume


def _general(rt: Runtime, power: int, images: Arguments, brick: Brick, volume: DeviceArray) -> None:
    nz, ny, nx = brick.shape
    kernel = rt.kernel("backproject", "backproject", **_defines(power))
    rt.launch(kernel, (ceil_div(nx, rt.lanes), ny, nz), *images, *volume_shape(brick), volume, group=rt.group(),
              samples=nx * ny * nz * int(images[3]))  # fmt: skip


def _lines(rt: Runtime, power: int, is_turned: bool, images: Arguments, brick: Brick, volume: DeviceArray) -> None:
    """Launches the kernel for frames with a pose per line. A work-item computes neighbouring voxels along z if lines are
    detector columns (``is_turned``), else along x. images: the arguments for the frames; power: of the distance weight."""
    nz, ny, nx = brick.shape
    along_z = {"ALONG_Z": 1} if is_turned and rt.lanes > 1 else {}
    kernel = rt.kernel("backproject", "backproject_lines", **_defines(power), **along_z)
    items = (nx, ny, ceil_div(nz, rt.lanes)) if along_z else (ceil_div(nx, rt.lanes), ny, nz)
    across = np.int32(is_turned and power == 2)
    rt.launch(kernel, items, *images, *volume_shape(brick), across, volume, group=rt.group(on_cpu=4 if along_z else 1),
              samples=LINE_SAMPLES * nx * ny * nz * int(images[3]))  # fmt: skip


def _upright(
    rt: Runtime, name: str, power: int, block: int, is_even: bool, images: Arguments, brick: Brick, volume: DeviceArray
) -> None:
    """Launches kernel ``name``, for upright columns of voxels. ``images`` holds transposed frames, so their width is the
    number of detector rows. is_even: as in ``backproject``."""
    nz, ny, nx = brick.shape
    sizes = {"BLOCK_VOXELS": _BLOCK_VOXELS, "COLUMN_ROWS": _COLUMN_ROWS} | ({"EVEN_ROWS": 1} if is_even else {})
    kernel = rt.kernel("backproject", name, **_defines(power), **sizes)
    image, table, weights, views, columns, rows, *rest = images
    data = (image, table, weights, views, rows, columns, *rest)
    rt.launch(kernel, (nx, ny, ceil_div(nz, block)), *data, *volume_shape(brick), block, volume)


def _defines(power: int) -> dict[str, int]:
    """Returns the kernels' macros for the exponent ``power`` of the distance weight; FDK's 2 is the kernels' default."""
    return {"IMAGE_GUARD": GUARD} if power == 2 else {"IMAGE_GUARD": GUARD, "DISTANCE_POWER": power}


def _upright_block(matrices: np.ndarray, grid: Grid) -> tuple[int, bool]:
    """Returns how many voxels along z a work-item of the upright kernels computes, or 0 if the general kernel is needed; and
    whether columns of voxels lean: whether u or depth (rows 0 and 2 of a matrix) change along them.

    The general kernel is needed if columns lean too much, if v does not change along z, or if a voxel is not in front of the
    source. Voxels past the volume's end that a work-item's last vector reads count too."""
    nz, ny, nx = grid.shape
    corners = np.array([[x, y, z, 1] for x in (0, nx - 1) for y in (0, ny - 1) for z in (0, nz - 1 + _WIDEST)])
    depth = matrices[:, 8:12] @ corners.T
    if depth.min() <= 0:
        return 0, False
    leans = bool(np.abs(matrices[:, [2, 10]]).max() * nz > _UPRIGHT * depth.min())
    at = np.einsum("fij,kj->fki", matrices.reshape(-1, 3, 4), corners)
    u, v = at[..., 0] / depth, at[..., 1] / depth
    if leans and (np.abs(np.diff(u)[:, ::2]) > _MOST_LEAN * np.abs(np.diff(v)[:, ::2])).any():
        return 0, False
    rows_per_voxel = (np.abs(matrices[:, 6:7]) / depth).max()
    if np.abs(matrices[:, 6]).min() == 0:
        return 0, False
    return int(min(_BLOCK_VOXELS, nz, (_COLUMN_ROWS - 4) // max(rows_per_voxel, 1e-3))), leans


def _images(rt: Runtime, views: Views, part: slice) -> Arguments:
    """Uploads the views ``part``. Returns the kernels' first arguments: frames, matrices, weights and their sizes."""
    images, (rows, width) = views.padded(rt, part), views.shape
    count, each = images.shape
    sizes = (np.int32(count), np.int32(rows), np.int32(width), np.int32(pitch_of(width)), np.int64(each))
    tables = (rt.upload(table[part], np.float32) for table in (views.matrices, views.weight))
    return (images, *tables, *sizes)


def volume_shape(brick: Brick) -> tuple[np.ndarray, np.ndarray, np.int32]:
    nz, ny, nx = brick.shape
    shape, origin = np.array([nx, ny, nz, 0], np.int32), np.array([*brick.start[::-1], 0], np.int32)
    return shape, origin, np.int32(pitch_of(nx))


def _strides(brick: Brick) -> Strides:
    _, ny, nx = brick.shape
    return Strides(GUARD, ny * pitch_of(nx), pitch_of(nx))


def _volume_bytes(shape: Shape) -> int:
    nz, ny, nx = shape
    return 4 * (2 * GUARD + nz * ny * pitch_of(nx))
