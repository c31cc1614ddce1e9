"""How well the motion of an object is known: where its matter is, in mm from where it truly is."""

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid

_EDGE = 0.25  # of the steepest slope: voxels at which a displacement can be seen
_MOST_POINTS = 2000
Array = np.ndarray


def edge_points_mm(volume: Array, grid: Grid) -> Array:
    """Returns centres (n, 3), x y z, of voxels of a volume (nz, ny, nx) at which it changes steeply, at most 2,000."""
    axes = [axis for axis, count in enumerate(volume.shape) if count > 1]
    slopes = [np.gradient(volume, grid.voxel_size_mm[axis], axis=axis) for axis in axes]
    steepness = np.sqrt(np.sum(np.square(slopes), axis=0)) if axes else np.zeros(volume.shape)
    where = np.argwhere(steepness >= _EDGE * steepness.max())
    where = where[:: checks.ceil_div(len(where), _MOST_POINTS)]
    return np.stack([axis[i] for axis, i in zip(grid.axes_mm(), where.T, strict=True)][::-1], -1)


def displaced_mm(deformation: Deformation, points_mm: Array, times_s: Array) -> Array:
    """Returns how far the matter at points (n, 3) at the first of K times has gone at the others, (K − 1, n, 3) in mm.

    This does not depend on the state that the reference volume shows: two descriptions of one motion give the same."""
    weights = deformation.weights_at(times_s)
    reference_mm = points_mm + deformation.displacement_mm(points_mm, weights[0])
    return np.stack([reference_mm + deformation.inverse_mm(reference_mm, other) - points_mm for other in weights[1:]])


def motion_error_mm(estimate: Deformation, truth: Deformation, points_mm: Array, times_s: Array) -> tuple[float, float]:
    """Returns mean and 95th percentile of the distance, in mm, between where matter at ``points_mm`` at the first time is at
    the other times, by both. Raises InputError for less than two times."""
    if len(times_s) < 2:
        raise InputError("states", str(len(times_s)), "at least two, between which the object moves")
    error_mm = displaced_mm(estimate, points_mm, times_s) - displaced_mm(truth, points_mm, times_s)
    distance_mm = np.linalg.norm(error_mm, axis=-1)
    return float(distance_mm.mean()), float(np.percentile(distance_mm, 95))
