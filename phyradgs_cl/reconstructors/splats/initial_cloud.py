"""The first cloud of Gaussians, drawn from an FDK volume."""

import logging

import numpy as np
import scipy

from phyradgs_cl.fields import Gaussians, Grid

log = logging.getLogger(__name__)


def initial_cloud(
    volume: np.ndarray,
    grid: Grid,
    count: int,
    *,
    threshold: float,
    density_share: float,
    scale_bounds: tuple[float, float],
    scale_factor: float,
    rng: np.random.Generator,
) -> Gaussians:
    """Up to ``count`` isotropic Gaussians at voxels above ``threshold``, drawn without replacement.

    volume (nz, ny, nx) and everything else in internal units. Density is ``density_share`` of the voxel's value;
    the scale is ``scale_factor`` × the RMS distance to the three nearest others. An empty volume still gives
    one faint Gaussian in the middle, so that there is something to optimise.
    """
    candidates = np.flatnonzero(volume.ravel() > threshold)
    if candidates.size == 0:
        log.warning(
            "no voxel of the first volume is above initial_threshold %g (the largest is %.3g): starting with one "
            "Gaussian in the middle",
            threshold,
            volume.max(),
        )
        candidates = np.array([np.ravel_multi_index([n // 2 for n in grid.shape], grid.shape)])
    chosen = np.sort(rng.choice(candidates, size=min(count, candidates.size), replace=False))
    z, y, x = np.unravel_index(chosen, grid.shape)
    axis_z, axis_y, axis_x = grid.axes_mm()
    mean = np.stack([axis_x[x], axis_y[y], axis_z[z]], -1)
    spacing = _neighbour_distance(mean, max(grid.voxel_size_mm)) * scale_factor
    scale = np.repeat(np.clip(spacing, *scale_bounds)[:, None], 3, axis=1)
    density = np.maximum(volume.ravel()[chosen], threshold) * density_share
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (len(mean), 1))
    return Gaussians(mean, scale, quaternion, density.astype(np.float64))


def _neighbour_distance(points: np.ndarray, fallback: float) -> np.ndarray:
    """RMS distance (G,) from each point to its three nearest others."""
    neighbours = min(4, len(points))
    if neighbours < 2:
        return np.full(len(points), fallback)
    distance, _ = scipy.spatial.cKDTree(points).query(points, k=neighbours)
    return np.sqrt((distance[:, 1:] ** 2).mean(axis=1))
