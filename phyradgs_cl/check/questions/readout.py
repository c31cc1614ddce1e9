"""Are lines read in the order, along the axis and in the time that the file says?"""

import math
from contextlib import suppress

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, MIRROR_U, MIRROR_V, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import residual_ratio, t_statistic
from phyradgs_cl.check.variants import at_rest, read, reversed_readout
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import Runtime

_ERRORS = 4.0
_LEAST_RATIO = 1.04  # of the other order, which leaves a model as free as it was
_CLEAR_RATIO = 1.5  # of another axis or time
_REST_RATIO = 2.0  # of a gantry at rest: a model that does not blur fits better by itself, the more so the fewer the views
_AS_GOOD = 1.15
_SHARE = 0.86  # of the time between frames: a readout to try where none is stated
_OTHER_WAY, _AT_REST = "the other way", "all at once, the gantry at rest"
_NEEDED = {_OTHER_WAY: _LEAST_RATIO, _AT_REST: _REST_RATIO}
READOUT = "sign of readout"


def check_readout(rt: Runtime, scan: Scan) -> Finding:
    """A moderately coarse fly-scan with lines read as stated, and otherwise. The wrong order of rows only twists the object,
    which the cone gives away; that of columns bends it. Residuals have to differ by four standard errors and a share."""
    stated = fitted(rt, scan)
    others: dict[str, np.ndarray] = {}
    for name, variant in _others(scan).items():
        with suppress(InputError):  # a table of poses or angles that ends before the last line would
            others[name] = fitted(rt, variant)
    if not others:
        text = "the tables of poses or angles end with the stated times: no other readout can be tried"
        return Finding(READOUT, CANNOT_TELL, 0.0, -_ERRORS, "standard errors", text)
    needed = {name: _NEEDED.get(name, _CLEAR_RATIO) for name in others}
    name = min(others, key=lambda name: float(others[name].sum()) * needed[name])
    best, least = others[name], needed[name]
    ratio, errors = residual_ratio(stated, best), t_statistic(stated, best)
    text = f"read {name}, the squared residual is {ratio:.4g} times as large ({errors:+.1f} standard errors)"
    if errors <= -_ERRORS and ratio <= 1 / least:
        alike = [n for n, squares in others.items() if squares.sum() <= _AS_GOOD * best.sum() and n != name]
        text += f"; nearly as well: {', '.join(alike)}" * bool(alike)
        return Finding(READOUT, SUSPICIOUS, errors, -_ERRORS, "standard errors", text, _advice(scan, name))
    if _OTHER_WAY in others:
        other = others[_OTHER_WAY]
        errors, ratio = t_statistic(stated, other), residual_ratio(stated, other)
        text = f"read the other way, the squared residual is {ratio:.4g} times as large ({errors:+.1f} standard errors)"
        if errors >= _ERRORS and ratio >= _LEAST_RATIO:
            return Finding(READOUT, OK, errors, -_ERRORS, "standard errors", text)
    advice = "ask which line the panel reads first: in a narrow cone the wrong order only twists the object"
    return Finding(READOUT, CANNOT_TELL, errors, -_ERRORS, "standard errors", text, advice)


def _others(scan: Scan) -> dict[str, Scan]:
    """What else the readout may be, by name."""
    shutter = scan.shutter
    other_axis = "columns" if shutter.axis == "rows" else "rows"
    if shutter.readout_s == 0:
        readout_s = _SHARE * float(np.diff(scan.frame_start_s).min(initial=math.inf))
        ways = [(axis, direction) for axis in ("rows", "columns") for direction in (1, -1)]
        return {f"by {a}, index {'0' if d > 0 else 'last'} first": read(scan, a, d, readout_s) for a, d in ways}
    return {
        _OTHER_WAY: reversed_readout(scan),
        "all at once": read(scan, shutter.axis, 1, 0.0),
        _AT_REST: at_rest(scan),
        f"by {other_axis}, index 0 first": read(scan, other_axis, 1, shutter.readout_s),
        f"by {other_axis}, index last first": read(scan, other_axis, -1, shutter.readout_s),
    }


def _advice(scan: Scan, name: str) -> str:
    if name == _OTHER_WAY:
        mirror, switch = ("v", MIRROR_V) if scan.shutter.axis == "rows" else ("u", MIRROR_U)
        other = f"set readout_direction to {-scan.shutter.direction}, or import with --readout-direction"
        return f"{other}; frames mirrored in {mirror} look the same: then import with the other {switch}"
    if name == _AT_REST:
        return "did the gantry stop for every view? Then import without a frame time (stop-and-shoot)"
    return "check the readout's axis, direction and time: the frames fit better otherwise"
