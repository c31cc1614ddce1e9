"""Voxel-driven backprojection with FDK's distance weight, from one pose per frame or one pose per line.

Where memory is short the volume is made brick by brick, and views go to the device in smaller parts; neither changes a bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.bricks import Brick, Shape, cut
from phyradgs_cl.operators.rays.layout import voxel_matrices
from phyradgs_cl.runtime import DeviceArray, Room, Runtime, with_smaller_bricks
from phyradgs_cl.runtime.layout import GUARD, padded_zeros, pitch_of, unpad_rows

_VIEWS_PER_LAUNCH = 64  # a work-item visits a few lines of every view: they should stay in a core's cache
_BYTES_A_LAUNCH = 1 << 28
_VIEWS_SHARE = 0.25  # of the room
_BLOCK_VOXELS = 128  # along z for a work-item of the upright kernel
_COLUMN_ROWS = 512  # detector rows that such a block may meet
_UPRIGHT = 1e-7  # of the depth: how far u or depth may move over the whole height
_Arguments = tuple[DeviceArray, DeviceArray, DeviceArray, np.int32, np.int32, np.int32, np.int32, np.int64]


def backproject(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid
) -> np.ndarray:
    """Σ_f weight_f / z² · frame_f(u, v) at every voxel centre, z the voxel's depth as a share of the ray.

    frames (F, rows, columns), bilinear and zero outside; pose (F, 12) mm; weight (F,). Returns (z, y, x) float32.
    """
    matrices = voxel_matrices(pose, grid)
    block = 0 if rt.pixel_items else _upright_block(matrices, grid)
    views = _Views(frames.transpose(0, 2, 1) if block else frames, matrices, weight)
    if block:
        return _in_bricks(rt, views, grid, block, lambda *where: _upright(rt, block, *where))
    return _in_bricks(rt, views, grid, 1, lambda *where: _general(rt, *where))


def backproject_lines(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid, axis: str = "rows"
) -> np.ndarray:
    """The same where every line of a frame has its own pose: pose (F, lines, 12) mm, lines along ``axis``.

    A voxel takes the line r whose pose projects it onto r, by linear interpolation between neighbouring lines, and
    counts with the rate at which it crosses lines: once for its angular step, and where the frames were filtered
    across lines (``axis`` columns) once more for the filter's scale (docs/mathematics.md).
    """
    readout = Readout(axis)
    frames, pose = readout.frames(frames), readout.poses(pose)
    matrices = voxel_matrices(pose.reshape(-1, 12), grid).reshape(len(frames), -1)
    across = np.int32(axis == "columns")
    views = _Views(frames, matrices, weight)
    return _in_bricks(rt, views, grid, 1, lambda *where: _lines(rt, across, *where))


@dataclass(frozen=True, eq=False)
class _Views:
    """Frames (F, lines, width), the matrices (F, …) and weights (F,) that go with them."""

    frames: np.ndarray
    matrices: np.ndarray
    weight: np.ndarray

    def bytes(self, count: int) -> int:
        """What so many of them take on the device."""
        _, rows, width = self.frames.shape
        return 4 * count * int(2 * GUARD + rows * pitch_of(width) + self.matrices.shape[1] + 1)

    def parts(self, room: Room) -> Iterator[slice]:
        """Views that go to the device in one piece."""
        most_bytes = min(_BYTES_A_LAUNCH, room.largest_bytes, int(_VIEWS_SHARE * room.free_bytes))
        count = max(1, min(_VIEWS_PER_LAUNCH, most_bytes // self.bytes(1)))
        for first in range(0, len(self.frames), count):
            yield slice(first, min(first + count, len(self.frames)))


_Launch = Callable[["_Arguments", Brick, DeviceArray], None]


def _in_bricks(rt: Runtime, views: _Views, grid: Grid, step: int, launch: _Launch) -> np.ndarray:
    """The volume (z, y, x), in bricks of a multiple of ``step`` voxels along z where it does not fit as a whole."""

    def attempt(share: float) -> np.ndarray:
        room = rt.room()
        parts = list(views.parts(room.scaled(share)))
        views_bytes = views.bytes(parts[0].stop)
        bricks = cut(grid.shape, (step, 1), lambda shape: (_volume_bytes(shape), views_bytes), room, share)
        volume = np.empty(grid.shape, np.float32)
        for brick in bricks:
            volume[brick.box] = _backprojected(rt, views, parts, brick, launch)
        return volume

    return with_smaller_bricks("FDK's backprojection", attempt)


def _backprojected(
    rt: Runtime, views: _Views, parts: list[slice], brick: Brick, launch: _Launch
) -> np.ndarray:
    nz, ny, nx = brick.shape
    volume = padded_zeros(rt, nz * ny, nx)
    for part in parts:
        images = _images(rt, views.frames[part], views.matrices[part], views.weight[part])
        launch(images, brick, volume)
        del images  # before the next part's
    return unpad_rows(rt.download(volume), brick.shape)


def _general(rt: Runtime, images: _Arguments, brick: Brick, volume: DeviceArray) -> None:
    nz, ny, nx = brick.shape
    kernel = rt.kernel("backproject", "backproject", IMAGE_GUARD=GUARD)
    rt.launch(kernel, (-(-nx // rt.lanes), ny, nz), *images, *_volume_shape(brick), volume, group=rt.group())


def _lines(rt: Runtime, across: np.int32, images: _Arguments, brick: Brick, volume: DeviceArray) -> None:
    nz, ny, nx = brick.shape
    kernel = rt.kernel("backproject", "backproject_lines", IMAGE_GUARD=GUARD)
    group = rt.group(on_cpu=16)
    rt.launch(kernel, (nx, ny, nz), *images, *_volume_shape(brick), across, volume, group=group)


def _upright(rt: Runtime, block: int, images: _Arguments, brick: Brick, volume: DeviceArray) -> None:
    """``images`` are transposed: the width that they tell is the number of rows."""
    nz, ny, nx = brick.shape
    defines = {"IMAGE_GUARD": GUARD, "BLOCK_VOXELS": _BLOCK_VOXELS, "COLUMN_ROWS": _COLUMN_ROWS}
    kernel = rt.kernel("backproject", "backproject_upright", **defines)
    image, table, weights, views, columns, rows, *rest = images
    data = (image, table, weights, views, rows, columns, *rest)
    rt.launch(kernel, (nx, ny, -(-nz // block)), *data, *_volume_shape(brick), np.int32(block), volume)


def _upright_block(matrices: np.ndarray, grid: Grid) -> int:
    """Voxels along z that a work-item of the upright kernel may take; 0 where it does not apply.

    It needs u and depth (rows 0 and 2 of a matrix) that do not change with z, and every voxel before the source.
    """
    nz, ny, nx = grid.shape
    corners = np.array([[x, y, 0, 1] for x in (0, nx - 1) for y in (0, ny - 1)])
    depth = matrices[:, 8:12] @ corners.T
    if depth.min() <= 0 or np.abs(matrices[:, [2, 10]]).max() * nz > _UPRIGHT * depth.min():
        return 0
    rows_per_voxel = (np.abs(matrices[:, 6:7]) / depth).max()
    if np.abs(matrices[:, 6]).min() == 0:
        return 0
    return int(min(_BLOCK_VOXELS, nz, (_COLUMN_ROWS - 4) // max(rows_per_voxel, 1e-3)))


def _images(rt: Runtime, frames: np.ndarray, matrices: np.ndarray, weight: np.ndarray) -> _Arguments:
    """The kernels' first arguments: padded images on the device, matrices, weights, and their sizes."""
    views, rows, width = frames.shape
    pitch = pitch_of(width)
    stacked = np.zeros((views, 2 * GUARD + rows * pitch), np.float32)
    body = stacked[:, GUARD : GUARD + rows * pitch].reshape(views, rows, pitch)
    body[:, :, :width] = frames
    sizes = (np.int32(views), np.int32(rows), np.int32(width), np.int32(pitch), np.int64(stacked.shape[1]))
    return (rt.upload(stacked), rt.upload(matrices, np.float32), rt.upload(weight, np.float32), *sizes)


def _volume_shape(brick: Brick) -> tuple[np.ndarray, np.ndarray, np.int32]:
    nz, ny, nx = brick.shape
    shape, origin = np.array([nx, ny, nz, 0], np.int32), np.array([*brick.start[::-1], 0], np.int32)
    return shape, origin, np.int32(pitch_of(nx))


def _volume_bytes(shape: Shape) -> int:
    nz, ny, nx = shape
    return 4 * (2 * GUARD + nz * ny * pitch_of(nx))
