"""Is the exposure stated far too long?"""

from __future__ import annotations

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, SUSPICIOUS, Finding
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import gain, standing
from phyradgs_cl.check.variants import exposed
from phyradgs_cl.runtime import Runtime

_LARGEST_GAIN = 0.75  # squared residual of half the exposure over that of the stated one
_ERRORS = 3.0
_QUESTION = "exposure"


def check_exposure(rt: Runtime, scan: Scan) -> Finding:
    """The stated exposure of a coarse ``scan`` against half of it, by the squared residuals.

    A sharper model always fits a little better after a few iterations: half of a true exposure leaves 80 to 100 % of its
    squared residual. A quarter less says that the exposure is stated too long; anything else says nothing, because a
    wrong exposure of a small arc stays within the same range. So the answer is never ``ok``: ``timing`` bounds it.
    """
    if scan.shutter.pulse_s is not None:
        text = "the beam is pulsed: when lines see light is the pulse's to say"
        advice = "compare the pulse with the generator's log"
        return Finding(_QUESTION, CANNOT_TELL, 1.0, _LARGEST_GAIN, "share", text, advice)
    stated, half = fitted(rt, scan), fitted(rt, exposed(scan, 0.5))
    ratio, errors = gain(stated, half), standing(stated, half)
    text = f"exposed half as long, the squared residual is {ratio:.3g} times as large ({errors:+.1f} standard errors)"
    values = (ratio, _LARGEST_GAIN, "share", text)
    if ratio <= _LARGEST_GAIN and errors <= -_ERRORS:
        advice = f"correct the exposure time: {scan.shutter.exposure_s / 2:g} s explains the frames better"
        return Finding(_QUESTION, SUSPICIOUS, *values, advice)
    return Finding(_QUESTION, CANNOT_TELL, *values, "compare the exposure time with the scanner's log")
