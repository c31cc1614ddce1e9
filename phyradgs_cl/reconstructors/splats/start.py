"""Where a splatting run starts: its internal units, and the first cloud."""

import logging

import numpy as np

from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.optim import Population, prune
from phyradgs_cl.reconstructors.splats.frames import Scale
from phyradgs_cl.reconstructors.splats.initial_cloud import initial_cloud
from phyradgs_cl.reconstructors.splats.options import SplatOptions

log = logging.getLogger(__name__)
_REFERENCE_PERCENTILE = 99.9


def internal_scale(fdk: np.ndarray, grid: Grid) -> Scale:
    """Half the longest side, and a high percentile of a first volume (1 where that is not positive)."""
    reference = float(np.percentile(fdk, _REFERENCE_PERCENTILE))
    if not np.isfinite(reference):
        raise NumericalError("projections", "values that overflow in FDK", "line integrals of order 1")
    return Scale(grid.half_longest_mm, reference if reference > 0 else 1.0 / grid.half_longest_mm)


def first_population(
    volume: np.ndarray, grid: Grid, options: SplatOptions, rng: np.random.Generator
) -> Population:
    """The raw parameters of the initial cloud, drawn from an FDK volume in internal units."""
    activation = options.activation(grid)
    asked = options.gaussians_for(grid)
    cloud = initial_cloud(
        volume,
        grid,
        asked,
        threshold=options.initial_threshold,
        density_share=options.initial_density,
        scale_bounds=(activation.scale_min, activation.scale_max),
        scale_factor=options.initial_scale,
        rng=rng,
    )
    if options.asks_for_gaussians and cloud.count < asked:
        log.warning(
            "%d Gaussians asked for, %d voxels of the first volume attenuate enough: starting with %d",
            asked,
            cloud.count,
            cloud.count,
        )
    raw = activation.invert(cloud.rows())
    return prune(Population(raw, np.zeros((2, *raw.shape))), activation, options.control, box_of(grid))


def box_of(grid: Grid) -> np.ndarray:
    """Lowest and highest corner (2, 3) of a grid, x y z."""
    half = np.array(grid.size_mm[::-1]) / 2
    centre = np.array(grid.offset_mm[::-1])
    return np.stack([centre - half, centre + half])
