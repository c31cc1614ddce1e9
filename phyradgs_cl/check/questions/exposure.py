"""Is the exposure as long as it is said to be?"""

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import residual_ratio, t_statistic
from phyradgs_cl.check.variants import exposed
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import Runtime

_LARGEST_RATIO = 0.6  # squared residual of another exposure over that of the stated one: right scans leave 0.8 or more
_OK_RATIO = 1.05
_ERRORS = 4.0
EXPOSURE = "exposure"


def check_exposure(rt: Runtime, scan: Scan) -> Finding:
    """The stated exposure of a coarse ``scan`` against half of it and twice, by the squared residuals.

    Only detail as fine as the arc tells a steady blur from a blurred object. A sharper model fits a little better by itself,
    so half the exposure has to leave 40 % less; it is ``ok`` where both half and twice fit worse.
    """
    if not scan.is_fly:
        text = "a gantry that turns while it exposes would leave a blurred object, and fit as well"
        return Finding(EXPOSURE, CANNOT_TELL, 1.0, _LARGEST_RATIO, "share", text)
    if scan.shutter.pulse_s is not None:
        text = "the beam is pulsed: when lines see light is the pulse's to say"
        advice = "compare the pulse with the generator's log"
        return Finding(EXPOSURE, CANNOT_TELL, 1.0, _LARGEST_RATIO, "share", text, advice)
    stated, half = fitted(rt, scan), fitted(rt, exposed(scan, 0.5))
    ratio, errors = residual_ratio(stated, half), t_statistic(stated, half)
    text = f"exposed half as long, the squared residual is {ratio:.3g} times as large ({errors:+.1f} standard errors)"
    values = (ratio, _LARGEST_RATIO, "share", text)
    if ratio <= _LARGEST_RATIO and errors <= -_ERRORS:
        advice = f"correct the exposure time: {scan.shutter.exposure_s / 2:g} s explains the frames better"
        return Finding(EXPOSURE, SUSPICIOUS, *values, advice)
    if _fits_worse(stated, half) and _fits_worse(stated, _twice(rt, scan)):
        return Finding(EXPOSURE, OK, *values)
    return Finding(EXPOSURE, CANNOT_TELL, *values, "compare the exposure time with the scanner's log")


def _fits_worse(stated: np.ndarray, other: np.ndarray | None) -> bool:
    return other is not None and residual_ratio(stated, other) >= _OK_RATIO and t_statistic(stated, other) >= _ERRORS


def _twice(rt: Runtime, scan: Scan) -> np.ndarray | None:
    """Residuals (F,) of twice the exposure; None where the table of poses or angles ends before."""
    try:
        return fitted(rt, exposed(scan, 2.0))
    except InputError:
        return None
