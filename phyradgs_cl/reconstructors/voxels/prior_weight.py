"""The weight of a prior, relative to the error of the data term's gradient.

A pixel of a frame differs from that of the best volume by its noise and by the discretisation error of voxels at edges. Both
reach the gradient through Aᵀ. The constants are fitted (docs/results/settings.md)."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.detector.noise_level import noise_behind
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Space

_SPREAD = 2.83  # an exposure's length in standard deviations of its five times, which reach from its start to its end
_EDGES = 0.09  # of a voxel's side: the error of a ray's length at edges
_LEAST = 1e-4  # of the largest value of Aᵀp: the weight of frames without noise


@dataclass(frozen=True)
class FrameError:
    """The error of a pixel that no volume on the grid explains.

    noise: its noise, dimensionless. edges_mm: the discretisation error at edges, over the density there in 1/mm."""

    noise: float
    edges_mm: float = 0.0


def frame_error(scan: Scan, motion: Motion) -> FrameError:
    """Estimates the error of a scan's pixels on its grid. A motion blur averages the error at edges."""
    voxel_mm = max(scan.grid.voxel_size_mm[1:])
    edges_mm = _EDGES * voxel_mm / math.sqrt(1 + _blur_mm(scan, motion) / voxel_mm)
    return FrameError(noise_behind(np.asarray(scan.projections, np.float32), scan.valid), edges_mm)


def _blur_mm(scan: Scan, motion: Motion) -> float:
    """Length of a line's motion blur half-way between the volume's centre and its side."""
    cells = motion.cells(scan, scan.frames // 2).still()
    line = cells.lines // 2
    serving = [c for c, lines in enumerate(cells.ranges) if lines.start <= line < lines.stop]
    weights = np.array([cells.weights_of(c)[line - cells.line_start[c]] for c in serving])
    sources_mm = cells.pose[serving, :3]  # a direction of length 1 in a parallel beam
    if not scan.is_parallel:
        sources_mm = sources_mm - scan.grid.offset_mm[::-1]
    apart_mm = sources_mm - weights @ sources_mm / weights.sum()
    turn_rad = _SPREAD * np.sqrt(weights @ (apart_mm**2).sum(1) / weights.sum()) / np.linalg.norm(sources_mm[0])
    return float(turn_rad * max(scan.grid.size_mm[1:]) / 4)


def adjoint_response(system: System) -> tuple[float, float]:
    """Returns the response of Aᵀ in the middle half of a volume, in mm: the standard deviation for independent unit noise
    per ray, and the mean for a unit error common to all rays."""
    noise = np.random.default_rng(0).standard_normal(system.measured.shape, np.float32)
    by_noise = system.adjoint(system.masked(system.apply_weights(system.space.array(noise))))
    by_ones = system.column_sums()
    middle = tuple(slice(n // 4, n - n // 4) for n in system.volume_shape)
    in_noise, in_ones = (system.space.numpy(volume)[middle] for volume in (by_noise, by_ones))
    return float(in_noise.std(dtype=np.float64)), float(in_ones.mean(dtype=np.float64))


class PriorWeight:
    """``strength`` times the error of the gradient Aᵀ(p − A x). It follows the density of the volume x."""

    def __init__(self, system: System, error: FrameError, strength: float) -> None:
        self.space, self.error, self.strength = system.space, error, strength
        gradient = system.adjoint(system.apply_weights(system.measured))
        self.least = _LEAST * system.space.largest(gradient, absolute=True)
        self.noise_mm, self.common_mm = adjoint_response(system)

    def at(self, volume: Any) -> float:
        """Returns the weight at a volume, in the unit of the gradient."""
        by_noise = self.error.noise * self.noise_mm
        by_edges = self.error.edges_mm * _density(self.space, volume) * self.common_mm
        return max(self.strength * math.hypot(by_noise, by_edges), self.least)

    def noise_share(self, weight: float) -> float:
        """Returns the share of noise in a weight: edges make up most of it where views are many, or photons."""
        by_noise = self.strength * self.error.noise * self.noise_mm
        return min(by_noise / weight, 1.0) if weight > 0 else 1.0  # empty frames have no weight


def _density(space: Space[Any], volume: Any) -> float:
    """Mean of a volume's values weighted by their squares, in 1/mm: Σ x³ / Σ x², which air does not change."""
    squares = space.inner(volume, volume)
    return max(space.inner(space.multiply(volume, volume), volume) / squares, 0.0) if squares > 0 else 0.0
