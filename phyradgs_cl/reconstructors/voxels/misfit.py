"""What no volume of the grid explains of the frames: noise, and what voxels miss at edges; the weight of a prior follows it.

Its two constants are fitted (docs/results/settings.md).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.detector import noise_behind
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Space

_EDGES, _SAMPLING = 0.55, 0.2  # of what voxels miss, and an exponent


@dataclass(frozen=True)
class Misfit:
    """What no volume of the grid explains in a pixel: noise, dimensionless, and ``edges_mm`` times the density there is, for
    what voxels miss at edges, which views do not average."""

    noise: float
    edges_mm: float = 0.0

    def rms(self, density_per_mm: float) -> float:
        """Of both, dimensionless."""
        return math.hypot(self.noise, self.edges_mm * density_per_mm)


def misfit_of(scan: Scan, motion: Motion) -> Misfit:
    """Of a scan on its grid. With n the views per voxel along the volume's side, or per pixel on the axis where those are
    larger: edges grow with √n, as they are missed in every view alike, and both with a small power of n. A blur averages
    what it goes over."""
    pixel_mm = min(scan.geometry.pixel_size_mm) / scan.geometry.magnification
    voxel_mm = max(pixel_mm, *scan.grid.voxel_size_mm[1:])
    views = scan.frames * voxel_mm / max(scan.grid.size_mm[1:])
    noise = noise_behind(np.asarray(scan.projections, np.float32), scan.valid)
    edges_mm = _EDGES * voxel_mm * math.sqrt(views / (1 + _blur_mm(scan, motion) / voxel_mm))
    return Misfit(views**_SAMPLING * noise, views**_SAMPLING * edges_mm)


def _blur_mm(scan: Scan, motion: Motion) -> float:
    """How far a line's exposure smears what lies half-way between the volume's middle and its side."""
    cells = motion.cells(scan, scan.frames // 2).still()
    first, stop = cells.line_cells()[cells.lines // 2]
    sources_mm = cells.pose[first:stop, :3] - scan.grid.offset_mm[::-1]
    turn_rad = np.linalg.norm(np.ptp(sources_mm, axis=0)) / np.linalg.norm(sources_mm[0])
    return float(turn_rad * max(scan.grid.size_mm[1:]) / 4)


def density(space: Space[Any], volume: Any) -> float:
    """Of what a volume consists of, in 1/mm: Σ x³ / Σ x²."""
    squares = space.inner(volume, volume)
    return max(space.inner(space.multiply(volume, volume), volume) / squares, 0.0) if squares > 0 else 0.0


def gain(system: System) -> float:
    """The deviation of Aᵀε in mm in the middle half of the volume, ε one draw of white noise of deviation 1."""
    drawn = np.random.default_rng(0).standard_normal(system.measured.shape, np.float32)
    back = system.adjoint(system.masked(system.weighed(system.space.array(drawn))))
    middle = tuple(slice(n // 4, n - n // 4) for n in system.volume_shape)
    return float(system.space.numpy(back)[middle].std(dtype=np.float64))
