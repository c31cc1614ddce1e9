"""Where is the axis of rotation on the panel?"""

import math
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import vertex
from phyradgs_cl.check.variants import Path, shifted
from phyradgs_cl.runtime import Runtime

_SEARCH = (-2.0, -1.0, 0.0, 1.0, 2.0)  # coarse pixels
_SEARCH_ITERATIONS = 8
_STEP = 0.25  # coarse pixels
_MOST_STEPS = 8
_TOLERATED = 0.2  # coarse pixels
_LEAST_TOLERATED = 0.5  # pixels
_DEVIATIONS = 4.0
CENTRE = "centre of rotation"


@dataclass(frozen=True, eq=False)
class Offset:
    """A shift of the panel in pixels of the scan, its standard deviation, and the residuals (F,) of the nearest trial."""

    pixels: float
    spread: float
    residuals: np.ndarray


def rough_offset(rt: Runtime, scan: Scan) -> Offset:
    """The best of five shifts of the panel along u, a coarse pixel apart, after a few iterations; no deviation (NaN)."""
    block = block_of(scan)
    trials = [fitted(rt, shifted(scan, block * s), _SEARCH_ITERATIONS) for s in _SEARCH]
    best = int(np.argmin([t.sum() for t in trials]))
    return Offset(block * _SEARCH[best], float("nan"), trials[best])


def best_offset(rt: Runtime, scan: Scan, rough: Offset) -> Offset:
    """The shift near ``rough`` that explains a coarse ``scan`` best, by a parabola through three neighbouring shifts."""
    block = block_of(scan)
    centre = rough.pixels / block
    known: dict[float, np.ndarray] = {}

    def at(shift: float) -> np.ndarray:
        if shift not in known:
            known[shift] = fitted(rt, shifted(scan, block * shift))
        return known[shift]

    for _ in range(_MOST_STEPS):
        trials = [centre - _STEP, centre, centre + _STEP]
        lowest = int(np.argmin([at(s).sum() for s in trials]))
        if lowest == 1:
            break
        centre = trials[lowest]
    around = np.array([centre - _STEP, centre, centre + _STEP])
    found, spread = vertex(around, np.stack([at(s) for s in around]))
    return Offset(block * found, block * spread, at(centre))


def block_of(scan: Scan) -> int:
    """How many columns make one of the coarse ``scan``."""
    return scan.trajectory.blocks[1] if isinstance(scan.trajectory, Path) else 1


def check_offset(offset: Offset, block: int, pitch_mm: float) -> Finding:
    """The shift against half a pixel, a fifth of a coarse pixel of ``block``, and four standard deviations."""
    threshold = max(_LEAST_TOLERATED, _TOLERATED * block, _DEVIATIONS * offset.spread)
    if not (math.isfinite(offset.pixels) and math.isfinite(offset.spread)):
        return Finding(CENTRE, CANNOT_TELL, 0.0, _LEAST_TOLERATED, "pixels", "no shift fits best")
    shift_mm = offset.pixels * pitch_mm
    text = f"the panel is {offset.pixels:+.2f} ± {offset.spread:.2f} pixels ({shift_mm:+.4g} mm) from where it is said to be"
    value = (offset.pixels, threshold, "pixels", text)
    if abs(offset.pixels) <= threshold:
        verdict = OK if threshold <= block else CANNOT_TELL
        return Finding(CENTRE, verdict, *value, uncertainty=offset.spread)
    advice = (
        f"add {shift_mm:.4g} mm to detector_offset along u: --fix-offset writes a copy of the scan; "
        "'phyradgs calibrate' looks for roll and tilt as well"
    )
    return Finding(CENTRE, SUSPICIOUS, *value, advice, offset.spread)
