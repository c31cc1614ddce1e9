"""What no volume of the grid explains of the frames: noise, and what voxels miss at edges; the weight of a prior follows it.

Its constant is fitted (docs/results/settings.md).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.detector import noise_behind
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Space

_SPREAD = 2.83  # standard deviations of an exposure's times that count as its length: from the first of five to the last
_EDGES = 0.09  # voxels' sides by which a ray is wrong at edges


@dataclass(frozen=True)
class Misfit:
    """What no volume of the grid explains in a pixel: noise, dimensionless, and ``edges_mm`` times the density there is, for
    what voxels miss at edges."""

    noise: float
    edges_mm: float = 0.0


def misfit_of(scan: Scan, motion: Motion) -> Misfit:
    """Of a scan on its grid. A blur averages what it goes over."""
    voxel_mm = max(scan.grid.voxel_size_mm[1:])
    edges_mm = _EDGES * voxel_mm / math.sqrt(1 + _blur_mm(scan, motion) / voxel_mm)
    return Misfit(noise_behind(np.asarray(scan.projections, np.float32), scan.valid), edges_mm)


def _blur_mm(scan: Scan, motion: Motion) -> float:
    """How far a line's exposure smears what lies half-way between the volume's middle and its side."""
    cells = motion.cells(scan, scan.frames // 2).still()
    line = cells.lines // 2
    serving = [c for c, lines in enumerate(cells.ranges) if lines.start <= line < lines.stop]
    weights = np.array([cells.weights_of(c)[line - cells.line_start[c]] for c in serving])
    sources_mm = cells.pose[serving, :3] - scan.grid.offset_mm[::-1]
    apart_mm = sources_mm - weights @ sources_mm / weights.sum()
    turn_rad = _SPREAD * np.sqrt(weights @ (apart_mm**2).sum(1) / weights.sum()) / np.linalg.norm(sources_mm[0])
    return float(turn_rad * max(scan.grid.size_mm[1:]) / 4)


def density(space: Space[Any], volume: Any) -> float:
    """Of what a volume consists of, in 1/mm: Σ x³ / Σ x²."""
    squares = space.inner(volume, volume)
    return max(space.inner(space.multiply(volume, volume), volume) / squares, 0.0) if squares > 0 else 0.0


@dataclass(frozen=True)
class Reach:
    """What comes back through Aᵀ, in mm, in the middle half of a volume: the deviation of white noise of deviation 1, whose
    rays do not know of each other, and the mean of 1, as of rays that are all wrong alike."""

    noise_mm: float
    alike_mm: float

    @classmethod
    def of(cls, system: System) -> "Reach":
        drawn = np.random.default_rng(0).standard_normal(system.measured.shape, np.float32)
        backs = system.adjoint(system.masked(system.apply_weights(system.space.array(drawn)))), system.column_sums()
        middle = tuple(slice(n // 4, n - n // 4) for n in system.volume_shape)
        noise, ones = (system.space.numpy(back)[middle] for back in backs)
        return cls(float(noise.std(dtype=np.float64)), float(ones.mean(dtype=np.float64)))

    def gradient_mm(self, misfit: Misfit, density_per_mm: float) -> float:
        """What the misfit makes of the gradient."""
        return math.hypot(misfit.noise * self.noise_mm, misfit.edges_mm * density_per_mm * self.alike_mm)
