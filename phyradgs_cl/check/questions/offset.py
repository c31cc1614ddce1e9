"""Where is the axis of rotation on the panel?"""

import math
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.hypotheses import FACTORS, stated_redundancy
from phyradgs_cl.check.questions.angles import is_full_turn
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import vertex
from phyradgs_cl.check.variants import Path, path_of, shifted
from phyradgs_cl.runtime import Runtime

_SEARCH = (-2.0, -1.0, 0.0, 1.0, 2.0)  # coarse pixels
_SEARCH_ITERATIONS = 8
_STEP = 0.25  # coarse pixels
_MOST_STEPS = 8
_TOLERATED = 0.2  # coarse pixels
_LEAST_TOLERATED = 0.5  # pixels
_DEVIATIONS = 4.0
_COARSE, _COARSE_SHORT = 0.003, 0.04  # coarse pixels: errors of volumes' scans, of full turns and of half ones
_LEAST_TWICE = 0.1  # of the panel: a displaced panel that sees the axis at its edge
CENTRE = "centre of rotation"
OTHER_CAUSE = "pixels, if pixel sizes are right"  # unit: sizes are as likely wrong


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


def with_coarseness(offset: Offset, block: int, scan: Scan) -> Offset:
    """The offset with what coarse pixels of ``block`` add to its deviation, which draws of frames do not show. It is far
    more where ``scan`` measures few rays twice: a shift that leaves fewer of them then fits better by itself."""
    twice = min(2 * stated_redundancy(scan), 1.0)
    share = _COARSE if is_full_turn(scan) and twice == 1 else _COARSE_SHORT / max(twice, _LEAST_TWICE)
    return replace(offset, spread=math.hypot(offset.spread, block * share))


def block_of(scan: Scan) -> int:
    """How many columns make one of the coarse ``scan``."""
    return scan.trajectory.blocks[1] if isinstance(scan.trajectory, Path) else 1


def check_offset(offset: Offset, block: int, pitch_mm: float, stated_px: float) -> Finding:
    """The shift against half a pixel, a fifth of a coarse pixel of ``block``, and four standard deviations. A stated offset
    that is wrong by a unit's factor may be right in mm, with pixel sizes that are wrong by it."""
    threshold = max(_LEAST_TOLERATED, _TOLERATED * block, _DEVIATIONS * offset.spread)
    if not (math.isfinite(offset.pixels) and math.isfinite(offset.spread)):
        return Finding(CENTRE, CANNOT_TELL, 0.0, _LEAST_TOLERATED, "pixels", "no shift fits best")
    shift_mm = offset.pixels * pitch_mm
    text = f"the panel is {offset.pixels:+.2f} ± {offset.spread:.2f} pixels ({shift_mm:+.4g} mm) from where it is said to be"
    if abs(offset.pixels) <= threshold:
        verdict = OK if threshold <= block else CANNOT_TELL
        return Finding(CENTRE, verdict, offset.pixels, threshold, "pixels", text, uncertainty=offset.spread)
    near = [f for f in FACTORS if abs(stated_px + offset.pixels - stated_px / f) <= threshold < abs(stated_px / f)]
    if near:
        text += f": {1 / near[0]:g} times the stated offset, as if pixel sizes were {near[0]:g} times as large"
        advice = "compare detector_offset and pixel sizes, and their units, with the scanner's log: frames do not tell which"
        return Finding(CENTRE, SUSPICIOUS, offset.pixels, threshold, OTHER_CAUSE, text, advice, offset.spread)
    if abs(2 * stated_px + offset.pixels) <= threshold:
        text += "; frames mirrored in u and turned the other way would look the same"
    advice = (
        f"add {shift_mm:.4g} mm to detector_offset along u: --fix-offset writes a copy of the scan; "
        "'phyradgs calibrate' looks for roll and tilt as well"
    )
    return Finding(CENTRE, SUSPICIOUS, offset.pixels, threshold, "pixels", text, advice, offset.spread)


def free_offset(rt: Runtime, scan: Scan) -> Scan:
    """The coarse ``scan`` with its panel where few iterations leave least, of three shifts a coarse pixel apart."""
    block, start = block_of(scan), path_of(scan).shift_px
    at = np.array([-1.0, 0.0, 1.0])
    trials = np.stack([fitted(rt, shifted(scan, start + block * s), _SEARCH_ITERATIONS) for s in at])
    best, _ = vertex(at, trials)
    return shifted(scan, start + block * float(np.clip(best, -2, 2))) if math.isfinite(best) else scan
