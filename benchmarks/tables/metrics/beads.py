"""Beads of known place and size in a volume, on which the shape metrics are measured."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid

Array = NDArray[np.float64]

# Voxels up to this multiple of a bead's radius count: enough surroundings for the level outside.
REACH = 1.75
# A bead with a smaller radius is only a few voxels, whose shape is that of the voxels.
SMALLEST_RADIUS_VOXELS = 2.5


@dataclass(frozen=True)
class Bead:
    """A homogeneous bead at ``centre_mm`` (x, y, z) in homogeneous surroundings (out to ``REACH`` radii)."""

    centre_mm: tuple[float, float, float]
    radius_mm: float


def resolved(beads: Sequence[Bead], grid: Grid) -> list[Bead]:
    """Returns the beads that are large enough on ``grid`` to have a shape, and lie in it with their surroundings."""
    least_mm = SMALLEST_RADIUS_VOXELS * max(grid.voxel_size_mm)
    return [bead for bead in beads if bead.radius_mm >= least_mm and _is_inside(bead, grid)]


def surroundings(volume: NDArray[np.floating], grid: Grid, bead: Bead) -> tuple[Array, Array]:
    """Returns distances (n,) in mm from the bead's centre, and values (n,), of all voxels within ``REACH`` radii."""
    reach_mm = REACH * bead.radius_mm
    picks, offsets = [], []
    for axis_mm, centre_mm in zip(grid.axes_mm(), bead.centre_mm[::-1], strict=True):
        pick = np.flatnonzero(np.abs(axis_mm - centre_mm) <= reach_mm)
        picks.append(pick)
        offsets.append(axis_mm[pick] - centre_mm)
    z, y, x = np.meshgrid(*offsets, indexing="ij", sparse=True)
    distance = np.sqrt(x * x + y * y + z * z).ravel()
    values = volume[np.ix_(*picks)].astype(np.float64).ravel()
    near = distance <= reach_mm
    return distance[near], values[near]


def levels(distance_mm: Array, values: Array, radius_mm: float) -> tuple[float, float]:
    """Returns the values inside and outside, as medians away from the edge. NaN: there is no such voxel."""
    inside = values[distance_mm < 0.6 * radius_mm]
    outside = values[distance_mm > 1.4 * radius_mm]
    if inside.size == 0 or outside.size == 0:
        return np.nan, np.nan
    return float(np.median(inside)), float(np.median(outside))


def _is_inside(bead: Bead, grid: Grid) -> bool:
    reach_mm = REACH * bead.radius_mm
    sides = zip(grid.offset_mm, grid.size_mm, bead.centre_mm[::-1], strict=True)
    return all(abs(centre - offset) + reach_mm <= side / 2 for offset, side, centre in sides)
