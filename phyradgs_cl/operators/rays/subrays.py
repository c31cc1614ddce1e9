"""Sub-rays: several rays per pixel where voxels are finer than pixels. A pixel is the mean of its rays.

Rays have no width. If they are further apart than voxels, some voxels lie between the rays of every view, and no data reach
them. The projector is A = B A', with the projector A' of a panel with finer pixels, and B the mean over blocks of these.
Aᵀ = A'ᵀ Bᵀ, where Bᵀ gives every ray of a block an equal part of the pixel."""

from collections.abc import Sequence

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.checks import few_sizes
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.runtime import DeviceArray, Runtime

SINGLE = (1, 1)
_WIDEST = 1.25  # largest distance between neighbouring sub-rays in the grid's middle, in voxels
_FARTHEST = 1.45
"""Largest distance between rays in the grid's middle, in voxels, for one ray per pixel. A common scanner with as many voxels
as pixels has 1.43. The volume of least norm that fits the rays loses 4 % of its density at a distance of 1.5, 16 % at 1.9,
and half at 2, where rays may miss voxels."""
# Largest distance between rays, in voxels, if a method begins with the object's density: voxels without a ray keep it.
_FARTHEST_OF_DENSE = 2.0
_ROUNDING = 1e-3  # a distance between rays may exceed its limit by this fraction, so that rounding does not add rays
_MOST = 8  # most sub-rays of a pixel along an axis: enough where single rays are 10 voxels apart


def subrays_of(grid: Grid, tables: Sequence[TimeCells], *, is_dense: bool = False) -> tuple[int, int]:
    """Returns how many rays (along v, along u) a pixel needs. Along an axis it is 1 unless voxels would lie between rays;
    then so many, up to 8, that rays in the grid's middle are at most ``_WIDEST`` voxels apart, in the median over frames.

    is_dense: the method begins with a volume of the object's density. Then rays must meet every voxel only where the grid
    is nearest to the source. Further away they pass at other heights in other views, which fills the gaps."""
    pose = np.stack([table.pose[0] for table in tables])
    steps = pose[:, 6:].reshape(-1, 2, 3)[:, ::-1] / grid.voxel_size_mm[::-1]
    spacing = np.linalg.norm(steps, axis=-1)
    if not tables[0].is_parallel:
        spacing *= _depth(grid, pose, is_nearest=is_dense)[:, None]
    middle, farthest = np.median(spacing, axis=0), _FARTHEST_OF_DENSE if is_dense else _FARTHEST
    needed = np.where(middle > farthest * (1 + _ROUNDING), np.ceil(middle / _WIDEST - _ROUNDING), 1)
    along_v, along_u = np.clip(needed, 1, _MOST).astype(int).tolist()
    return along_v, along_u


def _depth(grid: Grid, pose: np.ndarray, *, is_nearest: bool) -> np.ndarray:
    """Returns the depth (F,) of the grid's middle from the source, as a fraction of the panel's depth; 0 behind the source.

    is_nearest: takes the nearest point of the largest ellipsoid in the grid's box, in place of the middle."""
    normal = np.cross(pose[:, 6:9], pose[:, 9:12])
    to_panel = np.einsum("fi,fi->f", pose[:, 3:6] - pose[:, :3], normal)
    to_middle = np.einsum("fi,fi->f", np.array(grid.offset_mm[::-1]) - pose[:, :3], normal)
    reach = np.linalg.norm(normal * grid.size_mm[::-1], axis=1) / 2 if is_nearest else 0.0
    return np.asarray(np.maximum(to_middle / to_panel - reach / np.abs(to_panel), 0))


def means(fine: np.ndarray, subrays: tuple[int, int]) -> np.ndarray:
    """Returns frames (F, rows, columns) whose pixels are the means of their sub-rays: B y, for frames y (F, rows · along_v,
    columns · along_u) of the finer panel."""
    along_v, along_u = subrays
    return block_means(fine, (1, along_v, along_u))


def spread(frames: np.ndarray, subrays: tuple[int, int]) -> np.ndarray:
    """Returns the transpose of ``means``, Bᵀ y, which gives every sub-ray an equal part of its pixel: frames (F, rows ·
    along_v, columns · along_u) of the finer panel, for frames y (F, rows, columns)."""
    along_v, along_u = subrays
    shares = frames / np.float32(along_v * along_u)
    return np.asarray(shares.repeat(along_v, 1).repeat(along_u, 2))


def launch_means(
    rt: Runtime, fine: DeviceArray, strides: Sequence[int], subrays: tuple[int, int], frames: DeviceArray, part: slice
) -> None:
    """Writes the means over sub-rays, B y, to the frames ``part`` of ``frames`` (F, rows, columns). fine: padded frames y.
    strides: their ``RayLayout.pixel_strides``."""
    _, rows, columns = frames.shape
    rt.launch(
        rt.kernel("subrays", "subray_means"), (columns, rows, part.stop - part.start), fine, np.array(strides, np.int64),
        np.array(subrays[::-1], np.int32), frames, np.int32(part.start), np.int32(rows), np.int32(columns),
        group=rt.group(on_cpu=few_sizes(columns, 8)),
    )  # fmt: skip


def launch_spread(
    rt: Runtime, frames: DeviceArray, part: slice, subrays: tuple[int, int], fine: DeviceArray, strides: Sequence[int]
) -> None:
    """Writes each sub-ray's part of its pixel, Bᵀ y, to the padded frames ``fine``. y: the frames ``part`` of ``frames`` (F,
    rows, columns). strides: the ``RayLayout.pixel_strides`` of ``fine``."""
    _, rows, columns = frames.shape
    rt.launch(
        rt.kernel("subrays", "spread_subrays"), (columns, rows, part.stop - part.start), frames, np.int32(part.start),
        np.int32(rows), np.int32(columns), fine, np.array(strides, np.int64), np.array(subrays[::-1], np.int32),
        group=rt.group(on_cpu=few_sizes(columns, 8)),
    )  # fmt: skip
