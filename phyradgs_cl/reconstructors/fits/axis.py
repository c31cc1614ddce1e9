"""Where the axis of rotation is on the panel: the shift of the panel under which a coarse scan fits best."""

import math
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.variants import altered_trajectory, shifted
from phyradgs_cl.reconstructors.fits.residuals import fit_squares, vertex
from phyradgs_cl.runtime import Runtime

_ROUGH_SHIFTS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # coarse pixels
_ROUGH_ITERATIONS = 8
_STEP = 0.25  # coarse pixels
_MOST_STEPS = 8
ANYWHERE = (-math.inf, math.inf)


@dataclass(frozen=True, eq=False)
class AxisShift:
    """A shift of the panel along u in pixels of the recorded scan, its standard deviation (both NaN where no shift fits
    best), and the squared residuals (F,) of the nearest trial."""

    pixels: float
    deviation: float
    squares: np.ndarray

    @property
    def is_found(self) -> bool:
        return math.isfinite(self.pixels)


def rough_shift(rt: Runtime, scan: Scan, limits_px: tuple[float, float] = ANYWHERE) -> AxisShift:
    """Returns the best of five shifts within limits, one coarse pixel apart, after a few iterations; without a deviation."""
    block = columns_per_block(scan)
    shifts_px = [block * shift for shift in _ROUGH_SHIFTS if limits_px[0] <= block * shift <= limits_px[1]]
    trials = [fit_squares(rt, shifted(scan, shift_px), _ROUGH_ITERATIONS) for shift_px in shifts_px]
    best = int(np.argmin([squares.sum() for squares in trials]))
    return AxisShift(shifts_px[best], math.nan, trials[best])


def refined_shift(
    rt: Runtime, scan: Scan, rough: AxisShift, limits_px: tuple[float, float] = ANYWHERE
) -> AxisShift:
    """Returns the shift near ``rough`` with the least residual, from a parabola through three neighbouring shifts. Where it
    lies outside of the limits, that is ``rough``, fitted with all iterations and without a deviation."""
    block = columns_per_block(scan)
    centre = rough.pixels / block
    trials: dict[float, np.ndarray] = {}

    def squares_at(shift: float) -> np.ndarray:
        if shift not in trials:
            trials[shift] = fit_squares(rt, shifted(scan, block * shift))
        return trials[shift]

    for _ in range(_MOST_STEPS):
        neighbours = [centre - _STEP, centre, centre + _STEP]
        lowest = int(np.argmin([squares_at(shift).sum() for shift in neighbours]))
        if lowest == 1:
            break
        centre = neighbours[lowest]
    around = np.array([centre - _STEP, centre, centre + _STEP])
    best, deviation = vertex(around, np.stack([squares_at(shift) for shift in around]))
    if math.isfinite(best) and not limits_px[0] <= block * best <= limits_px[1]:
        return AxisShift(rough.pixels, math.nan, squares_at(rough.pixels / block))
    return AxisShift(block * best, block * deviation, squares_at(centre))


def axis_shift(rt: Runtime, scan: Scan) -> AxisShift:
    """Returns the panel's shift under which a coarse scan fits best, within a few coarse pixels of the stated one."""
    return refined_shift(rt, scan, rough_shift(rt, scan))


def with_best_shift(rt: Runtime, scan: Scan) -> Scan:
    """Returns the coarse scan shifted to the least residual of three shifts, one coarse pixel apart, after a few
    iterations."""
    block, start = columns_per_block(scan), altered_trajectory(scan).shift_px
    shifts = np.array([-1.0, 0.0, 1.0])
    trials = np.stack([fit_squares(rt, shifted(scan, start + block * shift), _ROUGH_ITERATIONS) for shift in shifts])
    best, _ = vertex(shifts, trials)
    return shifted(scan, start + block * float(np.clip(best, -2, 2))) if math.isfinite(best) else scan


def columns_per_block(scan: Scan) -> int:
    """Returns how many columns of the recorded scan form one of the coarse scan."""
    return altered_trajectory(scan).blocks[1]
