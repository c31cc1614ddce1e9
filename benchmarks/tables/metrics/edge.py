"""Edge sharpness: the distance over which a bead's edge rises from 10 % to 90 %.

A bead blurred by an isotropic Gaussian has a radial profile in closed form. So σ, radius and the two levels follow from a
fit to all voxels around the bead. The fit resolves less than a voxel, is insensitive to noise, and is right for small beads
too, whose profile has no plateau. A straight edge blurred by σ rises from 10 % to 90 % within 2.563 σ. Voxels that average
over their own width d add d²/12 to σ²: a perfect volume has a rise of about 0.74 voxel."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid
from tables.metrics.beads import Array, Bead, levels, resolved, surroundings

RISE_PER_SIGMA = 2.5631031310892007  # from the 10th to the 90th percentile of a normal distribution


@dataclass(frozen=True)
class Edge:
    """The edge of one bead: its 10–90 % rise and radius in mm."""

    rise_mm: float
    radius_mm: float


def edge_sharpness(volume: NDArray[np.floating], grid: Grid, beads: Sequence[Bead]) -> dict[str, float]:
    """Returns edge_rise_mm, the mean 10–90 % rise over the beads that the grid resolves, and edge_balls, their number.

    volume: (z, y, x) on ``grid``. beads: known centres and radii. The rise is NaN where no bead could be measured."""
    rises = [bead_edge(volume, grid, bead).rise_mm for bead in resolved(beads, grid)]
    known = [rise for rise in rises if np.isfinite(rise)]
    return {"edge_rise_mm": float(np.mean(known)) if known else np.nan, "edge_balls": float(len(known))}


def bead_edge(volume: NDArray[np.floating], grid: Grid, bead: Bead) -> Edge:
    """Returns the edge of one bead. It is NaN where nothing brighter or darker than its surroundings is found."""
    distance, values = surroundings(volume, grid, bead)
    inside, outside = levels(distance, values, bead.radius_mm)
    if not (np.isfinite(inside) and np.isfinite(outside)) or inside == outside:
        return Edge(np.nan, np.nan)
    contrast, voxel_mm = inside - outside, min(grid.voxel_size_mm)

    def residual(p: Array) -> Array:
        radius, sigma, share, base = p * (bead.radius_mm, bead.radius_mm, 1.0, 1.0)
        return base + share * blurred_ball(distance, radius, sigma) - (values - outside) / contrast

    start = (1.0, min(0.5 * voxel_mm / bead.radius_mm, 0.9), 1.0, 0.0)
    bounds = ((0.5, 0.02 * voxel_mm / bead.radius_mm, -5.0, -5.0), (1.5, 1.0, 5.0, 5.0))
    radius, sigma, share, _ = scipy.optimize.least_squares(residual, start, bounds=bounds).x
    if share <= 0:
        return Edge(np.nan, np.nan)
    return Edge(RISE_PER_SIGMA * sigma * bead.radius_mm, radius * bead.radius_mm)


def blurred_ball(distance_mm: Array, radius_mm: float, sigma_mm: float) -> Array:
    """Returns a unit ball convolved with a normalised 3D Gaussian, at distances (n,) from its centre."""
    r = np.maximum(distance_mm, 1e-4 * radius_mm)  # takes the limit at 0, without its 0/0
    to_edge, from_edge = (radius_mm - r) / sigma_mm, (radius_mm + r) / sigma_mm
    within = 0.5 * (scipy.special.erf(from_edge / np.sqrt(2)) + scipy.special.erf(to_edge / np.sqrt(2)))
    shells = np.exp(-0.5 * to_edge**2) - np.exp(-0.5 * from_edge**2)
    return within - sigma_mm / (r * np.sqrt(2 * np.pi)) * shells
