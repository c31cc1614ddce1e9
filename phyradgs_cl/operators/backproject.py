"""Voxel-driven backprojection with FDK's distance weight, from one pose a frame or one pose a line."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from phyradgs_cl.acquisition.geometry import transpose_pose
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.layout import GUARD, padded_zeros, pitch_of, unpad_rows
from phyradgs_cl.operators.rays import voxel_matrices
from phyradgs_cl.runtime import DeviceArray, Runtime

_VIEWS_A_LAUNCH = 64  # a work-item visits a few lines of every view: they should stay in a core's cache
_BYTES_A_LAUNCH = 1 << 28
_BLOCK_VOXELS = 128  # along z for a work-item of the upright kernel
_COLUMN_ROWS = 512  # detector rows that such a block may meet
_UPRIGHT = 1e-7  # of the depth: how far u or depth may move over the whole height


def backproject(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid
) -> np.ndarray:
    """Σ_f weight_f / z² · frame_f(u, v) at every voxel centre, z the voxel's depth as a share of the ray.

    frames (F, rows, columns), bilinear and zero outside; pose (F, 12) mm; weight (F,). Returns (z, y, x) float32.
    """
    matrices = voxel_matrices(pose, grid)
    block = 0 if rt.pixel_items else _upright_block(matrices, grid)
    if block:
        return _upright(rt, frames, matrices, weight, grid, block)
    nz, ny, nx = grid.shape
    kernel = rt.kernel("backproject", "backproject", IMAGE_GUARD=GUARD)
    volume = padded_zeros(rt, nz * ny, nx)
    for part in _launches(frames):
        data = _images(rt, frames[part], matrices[part], weight[part])
        items = (-(-nx // rt.lanes), ny, nz)
        rt.launch(kernel, items, *data, *_volume_shape(grid), volume, group=rt.group())
    return unpad_rows(rt.download(volume), grid.shape)


def backproject_lines(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid, axis: str = "rows"
) -> np.ndarray:
    """The same where every line of a frame has its own pose: pose (F, lines, 12) mm, lines along ``axis``.

    A voxel takes the line r whose pose projects it onto r, by linear interpolation between neighbouring lines, and
    counts with the rate at which it crosses lines: once for its angular step, and where the frames were filtered
    across lines (``axis`` columns) once more for the filter's scale (docs/mathematics.md).
    """
    if axis == "columns":
        frames, pose = frames.transpose(0, 2, 1), transpose_pose(pose)
    nz, ny, nx = grid.shape
    matrices = voxel_matrices(pose.reshape(-1, 12), grid).reshape(len(frames), -1)
    kernel = rt.kernel("backproject", "backproject_lines", IMAGE_GUARD=GUARD)
    volume = padded_zeros(rt, nz * ny, nx)
    across = np.int32(axis == "columns")
    for part in _launches(frames):
        data = _images(rt, frames[part], matrices[part], weight[part])
        rt.launch(
            kernel, (nx, ny, nz), *data, *_volume_shape(grid), across, volume, group=rt.group(on_cpu=16)
        )
    return unpad_rows(rt.download(volume), grid.shape)


def _upright(
    rt: Runtime, frames: np.ndarray, matrices: np.ndarray, weight: np.ndarray, grid: Grid, block: int
) -> np.ndarray:
    nz, ny, nx = grid.shape
    defines = {"IMAGE_GUARD": GUARD, "BLOCK_VOXELS": _BLOCK_VOXELS, "COLUMN_ROWS": _COLUMN_ROWS}
    kernel = rt.kernel("backproject", "backproject_upright", **defines)
    volume = padded_zeros(rt, nz * ny, nx)
    for part in _launches(frames):
        image, table, weights, views, columns, rows, *rest = _images(
            rt, frames[part].transpose(0, 2, 1), matrices[part], weight[part]
        )
        data = (
            image,
            table,
            weights,
            views,
            rows,
            columns,
            *rest,
        )  # the transposed image's width is the rows
        rt.launch(kernel, (nx, ny, -(-nz // block)), *data, *_volume_shape(grid), np.int32(block), volume)
    return unpad_rows(rt.download(volume), grid.shape)


def _upright_block(matrices: np.ndarray, grid: Grid) -> int:
    """Voxels along z that a work-item of the upright kernel may take; 0 where it does not apply.

    It needs u and depth (rows 0 and 2 of a matrix) that do not change with z, and every voxel before the source.
    """
    nz, ny, nx = grid.shape
    corners = np.array([[x, y, 0, 1] for x in (0, nx - 1) for y in (0, ny - 1)])
    depth = matrices[:, 8:12] @ corners.T
    if depth.min() <= 0 or np.abs(matrices[:, [2, 10]]).max() * nz > _UPRIGHT * depth.min():
        return 0
    rows_a_voxel = (np.abs(matrices[:, 6:7]) / depth).max()
    if np.abs(matrices[:, 6]).min() == 0:
        return 0
    return int(min(_BLOCK_VOXELS, nz, (_COLUMN_ROWS - 4) // max(rows_a_voxel, 1e-3)))


def _launches(frames: np.ndarray) -> Iterator[slice]:
    """Parts of the views (F, rows, columns) that go to the device in one piece."""
    image_bytes = 4 * frames.shape[1] * (frames.shape[2] + 2 * GUARD)
    count = max(1, min(_VIEWS_A_LAUNCH, _BYTES_A_LAUNCH // image_bytes))
    for first in range(0, len(frames), count):
        yield slice(first, first + count)


def _images(
    rt: Runtime, frames: np.ndarray, matrices: np.ndarray, weight: np.ndarray
) -> tuple[DeviceArray, DeviceArray, DeviceArray, np.int32, np.int32, np.int32, np.int32, np.int64]:
    """The kernels' first arguments: padded images on the device, matrices, weights, and their sizes."""
    views, rows, width = frames.shape
    pitch = pitch_of(width)
    stacked = np.zeros((views, 2 * GUARD + rows * pitch), np.float32)
    body = stacked[:, GUARD : GUARD + rows * pitch].reshape(views, rows, pitch)
    body[:, :, :width] = frames
    sizes = (np.int32(views), np.int32(rows), np.int32(width), np.int32(pitch), np.int64(stacked.shape[1]))
    return (rt.upload(stacked), rt.upload(matrices, np.float32), rt.upload(weight, np.float32), *sizes)


def _volume_shape(grid: Grid) -> tuple[np.ndarray, np.int32]:
    nz, ny, nx = grid.shape
    return np.array([nx, ny, nz, 0], np.int32), np.int32(pitch_of(nx))
