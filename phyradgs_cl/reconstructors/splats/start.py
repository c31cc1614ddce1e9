"""The start of a splatting run: its internal units, and its first Gaussians, drawn from a volume such as FDK's."""

import logging

import numpy as np
import scipy

from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.optim import Population, prune
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.step import Scale

log = logging.getLogger(__name__)
_REFERENCE_PERCENTILE = 99.9  # percentile of the first volume that is the unit of density; the maximum is often noise


def internal_scale(fdk: np.ndarray, grid: Grid) -> Scale:
    """Returns the internal units: half the grid's longest side in mm, and the 99.9th percentile of an FDK volume (nz, ny,
    nx) in 1/mm; if that is not above 0, 1/(half the longest side). Raises NumericalError if it is not finite."""
    reference = float(np.percentile(fdk, _REFERENCE_PERCENTILE))
    if not np.isfinite(reference):
        raise NumericalError("projections", "values that overflow in FDK", "line integrals of order 1")
    return Scale(grid.half_longest_mm, reference if reference > 0 else 1.0 / grid.half_longest_mm)


def first_population(
    volume: np.ndarray, grid: Grid, options: SplatOptions, rng: np.random.Generator
) -> Population:
    """Returns the raw parameters of the first Gaussians, drawn from a volume (nz, ny, nx) and pruned; in internal units."""
    activation = options.activation(grid)
    requested = options.gaussians_for(grid)
    cloud = initial_cloud(
        volume, grid, requested, threshold=options.initial_threshold, density_share=options.initial_density,
        scale_bounds=(activation.scale_min, activation.scale_max), scale_factor=options.initial_scale,
        rng=rng,
    )
    if options.asks_for_gaussians and cloud.count < requested:
        log.warning(
            "%d Gaussians asked for, %d voxels of the first volume attenuate enough: starting with %d",
            requested, cloud.count, cloud.count,
        )  # fmt: skip
    raw = activation.invert(cloud.rows())
    return prune(Population(raw, np.zeros((2, *raw.shape))), activation, options.control, grid.box_mm[::-1].T)


def initial_cloud(
    volume: np.ndarray, grid: Grid, count: int, *, threshold: float, density_share: float,
    scale_bounds: tuple[float, float], scale_factor: float, rng: np.random.Generator,
) -> Gaussians:
    """Draws up to ``count`` isotropic Gaussians at different voxels above ``threshold``, all in internal units.

    volume (nz, ny, nx). A Gaussian's density is ``density_share`` × its voxel's value. Its scale is ``scale_factor`` × the
    RMS distance to its three nearest neighbours, within ``scale_bounds``. If no voxel is above ``threshold``, returns one
    Gaussian of density ``density_share`` × ``threshold`` in the middle, so that there is something to optimise."""
    candidates = np.flatnonzero(volume.ravel() > threshold)
    if candidates.size == 0:
        log.warning(
            "no voxel of the first volume is above initial_threshold %g (the largest is %.3g): starting with one "
            "Gaussian in the middle", threshold, volume.max(),
        )  # fmt: skip
        candidates = np.array([np.ravel_multi_index([n // 2 for n in grid.shape], grid.shape)])
    voxels = np.sort(rng.choice(candidates, size=min(count, candidates.size), replace=False))
    z, y, x = np.unravel_index(voxels, grid.shape)
    axis_z, axis_y, axis_x = grid.axes_mm()
    mean = np.stack([axis_x[x], axis_y[y], axis_z[z]], -1)
    spacing = neighbour_distance(mean, max(grid.voxel_size_mm)) * scale_factor
    scale = np.repeat(np.clip(spacing, *scale_bounds)[:, None], 3, axis=1)
    density = np.maximum(volume.ravel()[voxels], threshold) * density_share
    return Gaussians(mean, scale, np.tile([1.0, 0.0, 0.0, 0.0], (len(mean), 1)), density.astype(np.float64))


def neighbour_distance(points: np.ndarray, fallback: float) -> np.ndarray:
    """Returns the RMS distance (G,) from each point (G, 3) to its three nearest neighbours; ``fallback`` for one point."""
    neighbours = min(4, len(points))
    if neighbours < 2:
        return np.full(len(points), fallback)
    distance, _ = scipy.spatial.cKDTree(points).query(points, k=neighbours)
    return np.sqrt((distance[:, 1:] ** 2).mean(axis=1))
