"""A volume on another grid."""

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid, triple

_ROUNDING = 1e-6  # of a voxel


def shared_slices(onto: Grid, grid: Grid) -> tuple[slice, slice, slice] | None:
    """The block (z, y, x) of the voxels of ``onto`` whose centres lie in the box of ``grid``; None where there is none."""
    block = []
    for centres_mm, (low_mm, high_mm), side_mm in zip(onto.axes_mm(), grid.box_mm, onto.voxel_size_mm, strict=True):
        rounding_mm = _ROUNDING * side_mm
        inside = np.flatnonzero((centres_mm >= low_mm - rounding_mm) & (centres_mm <= high_mm + rounding_mm))
        if not inside.size:
            return None
        block.append(slice(int(inside[0]), int(inside[-1]) + 1))
    return triple(block)


def resampled(volume: NDArray[np.floating], grid: Grid, onto: Grid) -> tuple[NDArray[np.float32], float]:
    """A volume (nz, ny, nx) at the voxel centres of another grid, trilinear, 0 outside of its box; and the share of
    them that lie in it. Between its outermost centres and its faces it is what it is at the centres."""
    step = np.divide(onto.voxel_size_mm, grid.voxel_size_mm)
    first = np.subtract(onto.first_centre_mm, grid.first_centre_mm) / grid.voxel_size_mm
    values = scipy.ndimage.affine_transform(
        volume.astype(np.float32, copy=False), step, first, output_shape=onto.shape, order=1, mode="nearest"
    )
    share = 1.0
    for axis, (at, ratio) in enumerate(zip(first, step, strict=True)):
        place = at + ratio * np.arange(onto.shape[axis])
        inside = (place >= -0.5) & (place <= grid.shape[axis] - 0.5)
        share *= float(inside.mean())
        values *= inside.reshape([-1 if a == axis else 1 for a in range(3)])
    return values, share
