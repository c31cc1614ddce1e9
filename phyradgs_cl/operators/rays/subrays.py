"""Sub-rays: where voxels are finer than pixels, a pixel is the mean over the rays of a block of a finer panel.

Rays have no width. Where they lie further apart than voxels, some voxels lie between them in every view, and no data reach
these. A = B A', with A' the projector of the finer panel, and B the mean over its blocks. Aᵀ = A'ᵀ Bᵀ, and Bᵀ gives every
ray of a block the same share."""

from collections.abc import Sequence

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.runtime import DeviceArray, Runtime

SINGLE = (1, 1)
_WIDEST = 1.25  # largest distance of neighbouring sub-rays in the grid's middle, in voxels
# Largest distance of neighbouring single rays, in voxels; beyond it pixels get sub-rays. A usual scanner with as many voxels
# as pixels has 1.43. The minimum-norm volume that fits rays on a line loses 4 % of its density at 1.5, 16 % at 1.9, and a
# half at 2, where rays may pass through every other voxel alone.
_FARTHEST = 1.45
# Largest distance of neighbouring single rays for a method that begins with a volume of the object's density, which it keeps
_FARTHEST_OF_DENSE = 2.0
_ROUNDING = 1e-3  # relative tolerance by which a distance may exceed its limit before a pixel gets another ray
_MOST = 8  # most sub-rays of a pixel along an axis, reached where single rays are 10 voxels apart


def subrays_of(grid: Grid, tables: Sequence[TimeCells], *, is_dense: bool = False) -> tuple[int, int]:
    """Returns how many rays (along v, along u) a pixel needs in the middle of the grid, by the median over frames. (1, 1)
    unless voxels would lie between rays; then so many that rays are at most ``_WIDEST`` voxels apart.

    is_dense: the method begins with a volume that has the object's density. Rays then need to touch every voxel only
    where the grid is nearest to the source. Further from the source they pass at other heights in other views, which fill
    the gaps."""
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
    """Returns the depth (F,) of the grid's middle from the source, over the panel's depth. With ``is_nearest`` the point
    is the nearest of the ellipsoid in the grid's box. The depth is 0 for a point behind the source."""
    normal = np.cross(pose[:, 6:9], pose[:, 9:12])
    to_panel = np.einsum("fi,fi->f", pose[:, 3:6] - pose[:, :3], normal)
    to_middle = np.einsum("fi,fi->f", np.array(grid.offset_mm[::-1]) - pose[:, :3], normal)
    reach = np.linalg.norm(normal * grid.size_mm[::-1], axis=1) / 2 if is_nearest else 0.0
    return np.asarray(np.maximum(to_middle / to_panel - reach / np.abs(to_panel), 0))


def means(fine: np.ndarray, subrays: tuple[int, int]) -> np.ndarray:
    """Returns B y, frames (F, rows, columns), for frames y (F, rows · along_v, columns · along_u) of the finer panel."""
    along_v, along_u = subrays
    return block_means(fine, (1, along_v, along_u))


def spread(frames: np.ndarray, subrays: tuple[int, int]) -> np.ndarray:
    """Returns Bᵀ y, frames (F, rows · along_v, columns · along_u) of the finer panel, for frames y (F, rows, columns)."""
    along_v, along_u = subrays
    shares = frames / np.float32(along_v * along_u)
    return np.asarray(shares.repeat(along_v, 1).repeat(along_u, 2))


def launch_means(
    rt: Runtime, fine: DeviceArray, strides: Sequence[int], subrays: tuple[int, int], frames: DeviceArray, part: slice
) -> None:
    """Writes B y of the padded frames ``fine`` to the frames ``part`` of the plain stack ``frames`` (F, rows, columns)."""
    _, rows, columns = frames.shape
    rt.launch(
        rt.kernel("subrays", "subray_means"), (columns, rows, part.stop - part.start), fine, np.array(strides, np.int64),
        np.array(subrays[::-1], np.int32), frames, np.int32(part.start), np.int32(rows), np.int32(columns),
        group=rt.group(on_cpu=min(columns, 8)),
    )  # fmt: skip


def launch_spread(
    rt: Runtime, frames: DeviceArray, part: slice, subrays: tuple[int, int], fine: DeviceArray, strides: Sequence[int]
) -> None:
    """Writes Bᵀ y of the frames ``part`` of a plain stack (F, rows, columns) to the padded frames ``fine``."""
    _, rows, columns = frames.shape
    rt.launch(
        rt.kernel("subrays", "spread_subrays"), (columns, rows, part.stop - part.start), frames, np.int32(part.start),
        np.int32(rows), np.int32(columns), fine, np.array(strides, np.int64), np.array(subrays[::-1], np.int32),
        group=rt.group(on_cpu=min(columns, 8)),
    )  # fmt: skip
