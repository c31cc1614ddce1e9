"""Is the line that is said to be read first the first?"""

from __future__ import annotations

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.residual import FINE_ITERATIONS, fitted
from phyradgs_cl.check.statistics import gain, standing
from phyradgs_cl.check.variants import reversed_readout
from phyradgs_cl.runtime import Runtime

_ERRORS = 2.5
_LEAST_GAIN = 1.005
_QUESTION = "sign of readout"


def check_readout(rt: Runtime, scan: Scan) -> Finding:
    """Reconstructions of a moderately coarse ``scan`` with lines read in the stated order and in the other.

    The wrong order twists the object about the axis, which only the cone gives away: the residuals differ by a percent
    or so, and their differences, frame by frame, have to stand 2.5 standard errors from 0.
    """
    stated = fitted(rt, scan, FINE_ITERATIONS)
    other = fitted(rt, reversed_readout(scan), FINE_ITERATIONS)
    errors, ratio = standing(stated, other), gain(stated, other)
    text = f"read the other way, the squared residual is {ratio:.4g} times as large ({errors:+.1f} standard errors)"
    values = (errors, -_ERRORS, "standard errors", text)
    if errors >= _ERRORS and ratio >= _LEAST_GAIN:
        return Finding(_QUESTION, OK, *values)
    if errors <= -_ERRORS and ratio <= 1 / _LEAST_GAIN:
        advice = f"set readout_direction to {-scan.shutter.direction}, or import with --readout-direction"
        return Finding(_QUESTION, SUSPICIOUS, *values, advice)
    advice = "ask which line the panel reads first: in a narrow cone the wrong order only twists the object"
    return Finding(_QUESTION, CANNOT_TELL, *values, advice)
