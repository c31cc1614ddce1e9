"""Roundness: how circular the sections of beads are, which pictures of a sphere phantom show to the eye.

The contour at half level is followed ray by ray in the central axial, coronal and sagittal section of every bead. As in
metrology, radii are taken about the centre of the least-squares circle. A bead that is round but displaced then counts as
round; the displacement is reported beside it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid
from tables.metrics.beads import REACH, Array, Bead, levels, resolved, surroundings

RAYS = 72
_STEPS_PER_VOXEL = 8
_LEAST_SHARE = 0.75  # fraction of the rays that must meet the contour; otherwise the section has none
# (first, second) axis of each section in (x, y, z).
SECTIONS = {"axial": (0, 1), "coronal": (0, 2), "sagittal": (1, 2)}


@dataclass(frozen=True)
class Section:
    """The contour of one section: (r_max − r_min)/r_mean, RMS deviation/r_mean, mean radius and shift in mm."""

    span: float
    rms: float
    radius_mm: float
    shift_mm: float


def roundness(volume: NDArray[np.floating], grid: Grid, beads: Sequence[Bead]) -> dict[str, float]:
    """Returns means over all sections of the beads that the grid resolves. 0 is round.

    roundness is (r_max − r_min)/r_mean; roundness_rms is RMS deviation/r_mean; centre_shift_mm is the distance of the
    contour's centre from the true one; round_sections is the number of sections found. They are NaN where there are none.
    volume: (z, y, x) on ``grid``."""
    found = [
        section for bead in resolved(beads, grid) for section in bead_sections(volume, grid, bead).values()
    ]
    known = np.array([(s.span, s.rms, s.shift_mm) for s in found if np.isfinite(s.span)])
    span, rms, shift_mm = known.mean(axis=0) if len(known) else (np.nan,) * 3
    return {
        "roundness": float(span),
        "roundness_rms": float(rms),
        "centre_shift_mm": float(shift_mm),
        "round_sections": float(len(known)),
    }


def bead_sections(volume: NDArray[np.floating], grid: Grid, bead: Bead) -> dict[str, Section]:
    """Returns the three central sections of one bead by name. NaN: less than three quarters of a contour exist."""
    inside, outside = levels(*surroundings(volume, grid, bead), bead.radius_mm)
    return {
        name: _section(half_level_radii(volume, grid, bead, axes, (inside, outside)))
        for name, axes in SECTIONS.items()
    }


def half_level_radii(
    volume: NDArray[np.floating],
    grid: Grid,
    bead: Bead,
    axes: tuple[int, int],
    inside_outside: tuple[float, float],
) -> Array:
    """Returns distances (RAYS,) in mm from the bead's centre to the half level, in the plane of two axes of (x, y, z).

    Noise may make several crossings; the one nearest to the true radius counts. A ray without a crossing has NaN."""
    inside, outside = inside_outside
    if not (np.isfinite(inside) and np.isfinite(outside)) or inside == outside:
        return np.full(RAYS, np.nan)
    step_mm = min(grid.voxel_size_mm) / _STEPS_PER_VOXEL
    r_mm = np.arange(0.0, REACH * bead.radius_mm, step_mm)
    share = (_along_rays(volume, grid, bead, axes, r_mm) - outside) / (inside - outside) - 0.5
    before, after = share[:, :-1], share[:, 1:]
    crosses = (before > 0) & (after <= 0)
    where = r_mm[:-1] + step_mm * np.where(crosses, before / np.where(crosses, before - after, 1.0), 0.0)
    miss = np.where(crosses, np.abs(where - bead.radius_mm), np.inf)
    best = miss.argmin(axis=1)
    rows = np.arange(RAYS)
    return np.where(np.isfinite(miss[rows, best]), where[rows, best], np.nan)


def _along_rays(
    volume: NDArray[np.floating], grid: Grid, bead: Bead, axes: tuple[int, int], r_mm: Array
) -> Array:
    """Returns values (RAYS, len(r_mm)) from the centre outwards, interpolated by cubic splines."""
    angle = 2 * np.pi * np.arange(RAYS) / RAYS
    points = np.broadcast_to(
        np.asarray(bead.centre_mm, np.float64)[:, None, None], (3, RAYS, r_mm.size)
    ).copy()
    points[axes[0]] += np.cos(angle)[:, None] * r_mm
    points[axes[1]] += np.sin(angle)[:, None] * r_mm
    first, pitch = np.array(grid.first_centre_mm), np.array(grid.voxel_size_mm)
    index = (points[::-1] - first[:, None, None]) / pitch[:, None, None]
    # A box around the bead is enough: otherwise every bead would need spline coefficients of the whole volume.
    low = [max(0, int(i.min()) - 8) for i in index]
    high = [min(n, int(i.max()) + 9) for i, n in zip(index, grid.shape, strict=True)]
    box = volume[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].astype(np.float64)
    return scipy.ndimage.map_coordinates(box, index - np.array(low)[:, None, None], order=3, mode="nearest")


def _section(radii_mm: Array) -> Section:
    known = np.isfinite(radii_mm)
    if known.mean() < _LEAST_SHARE:
        return Section(np.nan, np.nan, np.nan, np.nan)
    angle = 2 * np.pi * np.arange(RAYS)[known] / RAYS
    x, y = radii_mm[known] * np.cos(angle), radii_mm[known] * np.sin(angle)
    # The circle through the points follows by linear least squares: x² + y² = 2ax + 2by + c.
    a, b, _ = np.linalg.lstsq(np.stack([2 * x, 2 * y, np.ones_like(x)], -1), x * x + y * y, rcond=None)[0]
    r = np.hypot(x - a, y - b)
    mean = float(r.mean())
    return Section(float((r.max() - r.min()) / mean), float(r.std() / mean), mean, float(np.hypot(a, b)))
