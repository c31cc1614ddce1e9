"""Volumes of a deforming object at any state, on the host."""

from collections.abc import Sequence

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.deformation import Deformation
from phyradgs_cl.fields.volume import Grid, triple

_SLAB_VOXELS = 1 << 21  # displaced at a time: their coordinates take six times the memory of the volume


def deformed(volume: np.ndarray, grid: Grid, deformation: Deformation, weights: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns the object (nz, ny, nx) float32 in 1/mm at one state's weights (R,), as ``deformation.weights_at`` gives them.

    It is v(y + w(y)) at every voxel centre y, trilinear between the voxels of the reference ``volume`` (nz, ny, nx) in 1/mm
    on ``grid``, 0 outside of it. A state at rest is the volume itself. Raises InputError for shapes that do not fit."""
    if not isinstance(deformation, Deformation):
        raise InputError("deformation", checks.short_repr(deformation), "a Deformation")
    checks.shape("volume", checks.real_array("volume", volume), grid.shape)
    reference, shares = np.asarray(volume, np.float32), checks.numbers("weights", weights, (deformation.rank,))
    if not np.any(deformation.reach_mm * np.abs(shares)):
        return reference
    nz, ny, nx = grid.shape
    result = np.empty(grid.shape, np.float32)
    voxel_mm = np.array(grid.voxel_size_mm, np.float32)
    index = [np.arange(n, dtype=np.float32) for n in (ny, nx)]
    slices = max(1, _SLAB_VOXELS // (ny * nx))
    for first in range(0, nz, slices):
        count = min(slices, nz - first)
        shift = deformation.on_grid_mm(grid.part(triple((first, 0, 0)), triple((count, ny, nx))), shares)
        z = np.arange(first, first + count, dtype=np.float32)[:, None, None] + shift[..., 2] / voxel_mm[0]
        y = index[0][:, None] + shift[..., 1] / voxel_mm[1]
        x = index[1] + shift[..., 0] / voxel_mm[2]
        scipy.ndimage.map_coordinates(
            reference, (z, y, x), output=result[first : first + count], order=1, mode="grid-constant", prefilter=False
        )
    return result
