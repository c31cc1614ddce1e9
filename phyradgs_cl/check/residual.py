"""How well a coarse reconstruction explains the frames."""

from __future__ import annotations

import math

import numpy as np

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.check.timing import exposure_arc_rad
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

QUICK_ITERATIONS, FINE_ITERATIONS = 12, 20
_MOST_SAMPLES = 12


def system_of(rt: Runtime, scan: Scan) -> System:
    """The scan's equations, every line at its own times: a time for each voxel that its edge moves in an exposure."""
    voxels = exposure_arc_rad(scan) * max(scan.grid.shape[1:]) / 2
    samples = int(np.clip(math.ceil(voxels), 1, _MOST_SAMPLES))
    return System.of_scan(rt, scan, PerRow(sub_intervals=samples))


def fitted(rt: Runtime, scan: Scan, iterations: int = QUICK_ITERATIONS) -> np.ndarray:
    """Mean squared residual (F,) of each frame after ``iterations`` of CGLS on all of them, dimensionless."""
    return _per_frame(_solved(system_of(rt, scan), iterations).residual)


def _solved(system: System, iterations: int) -> Cgls:
    method = Cgls(system)
    for _ in range(iterations):
        if method.finished:
            break
        method.step()
    return method


def _per_frame(residual: np.ndarray) -> np.ndarray:
    return np.square(residual, dtype=np.float64).mean((1, 2))
