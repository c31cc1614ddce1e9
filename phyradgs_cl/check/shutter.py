"""Checks that lines are read in the stated order, axis and time, and that the exposure is as long as stated."""

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.variants import reversed_readout
from phyradgs_cl.check.finding import CANNOT_TELL, MIRROR_U, MIRROR_V, OK, SUSPICIOUS, Finding
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.fits.residuals import fit_squares, residual_ratio, t_statistic
from phyradgs_cl.runtime import Runtime

READOUT, EXPOSURE = "sign of readout", "exposure"
_ERRORS = 4.0  # squared residuals of two hypotheses must differ by this many standard errors
# Least (squared residual of the wrong readout order) / (that of the right order). It may be near 1, because both orders have
# equally many unknowns.
_ORDER_RATIO = 1.04
_OTHER_RATIO = 1.5  # least (squared residual as stated) / (that of another readout axis or time) to call the other right
# Least (squared residual as stated) / (that of a gantry at rest) to call rest right: models without blur always fit better.
_REST_RATIO = 2.0
_AS_GOOD = 1.15  # other readouts are named too if (their squared residual) / (that of the best readout) is at most this
_READOUT_SHARE = 0.86  # if the stated readout is 0 s, this fraction of the shortest time between frames is tried
_OTHER_WAY, _AT_REST = "the other way", "all at once, the gantry at rest"
_NEEDED_RATIO = {_OTHER_WAY: _ORDER_RATIO, _AT_REST: _REST_RATIO}
# An exposure is suspicious if half of it leaves at most this fraction of the squared residual: correct scans have ≥ 0.8.
_HALF_RATIO = 0.6
_WORSE_RATIO = 1.05  # another exposure fits worse if (its squared residual) / (the stated exposure's) is at least this


def check_readout(rt: Runtime, scan: Scan) -> Finding:
    """Fits a coarse fly-scan with its lines read as stated, and with other orders, axes and times of the readout.

    To decide, squared residuals must differ by four standard errors and by a factor of 1.04 to 2. A wrong order of rows only
    twists the object about the axis, which shows in a cone beam alone. A wrong order of columns bends the object."""
    stated = fit_squares(rt, scan)
    others: dict[str, np.ndarray] = {}
    for name, variant in _other_readouts(scan).items():
        with suppress(InputError):  # a table of poses or angles may end before the last line is read
            others[name] = fit_squares(rt, variant)
    if not others:
        text = "the tables of poses or angles end with the stated times: no other readout can be tried"
        return Finding(READOUT, CANNOT_TELL, 0.0, -_ERRORS, "standard errors", text)
    needed = {name: _NEEDED_RATIO.get(name, _OTHER_RATIO) for name in others}
    best = min(others, key=lambda name: float(others[name].sum()) * needed[name])
    text, errors, ratio = _compared(f"read {best}", stated, others[best])
    if errors <= -_ERRORS and ratio <= 1 / needed[best]:
        as_good = [n for n in others if n != best and others[n].sum() <= _AS_GOOD * others[best].sum()]
        if as_good:
            text += f"; nearly as well: {', '.join(as_good)}"
        return Finding(READOUT, SUSPICIOUS, errors, -_ERRORS, "standard errors", text, _readout_advice(scan, best))
    if _OTHER_WAY in others:
        text, errors, ratio = _compared(f"read {_OTHER_WAY}", stated, others[_OTHER_WAY])
        if errors >= _ERRORS and ratio >= _ORDER_RATIO:
            return Finding(READOUT, OK, errors, -_ERRORS, "standard errors", text)
    beam = "a parallel beam" if scan.is_parallel else "a narrow cone"
    advice = f"ask which line the panel reads first: in {beam} the wrong order only twists the object"
    return Finding(READOUT, CANNOT_TELL, errors, -_ERRORS, "standard errors", text, advice)


def _compared(hypothesis: str, stated: np.ndarray, other: np.ndarray) -> tuple[str, float, float]:
    """Returns a sentence about the readout ``hypothesis``, the number of standard errors by which the stated readout fits
    better, and the ratio Σ ``other`` / Σ ``stated`` of the two readouts' squared residuals."""
    ratio, errors = residual_ratio(stated, other), t_statistic(stated, other)
    return f"{hypothesis}, the squared residual is {ratio:.4g} times as large ({errors:+.1f} standard errors)", errors, ratio


def _other_readouts(scan: Scan) -> dict[str, Scan]:
    shutter = scan.shutter

    def read(axis: str, direction: int, readout_s: float) -> Scan:
        return replace(scan, shutter=replace(shutter, axis=axis, direction=direction, readout_s=readout_s), is_fly=True)

    other_axis = "columns" if shutter.axis == "rows" else "rows"
    if shutter.readout_s == 0:
        readout_s = _READOUT_SHARE * float(np.diff(scan.frame_start_s).min(initial=math.inf))
        orders = [(axis, direction) for axis in ("rows", "columns") for direction in (1, -1)]
        return {f"by {a}, index {'0' if d > 0 else 'last'} first": read(a, d, readout_s) for a, d in orders}
    return {
        _OTHER_WAY: reversed_readout(scan),
        "all at once": read(shutter.axis, 1, 0.0),
        _AT_REST: replace(scan, is_fly=False),
        f"by {other_axis}, index 0 first": read(other_axis, 1, shutter.readout_s),
        f"by {other_axis}, index last first": read(other_axis, -1, shutter.readout_s),
    }


def _readout_advice(scan: Scan, name: str) -> str:
    if name == _OTHER_WAY:
        mirror, option = ("v", MIRROR_V) if scan.shutter.axis == "rows" else ("u", MIRROR_U)
        reverse = f"set readout_direction to {-scan.shutter.direction}, or import with --first"
        return f"{reverse}; frames mirrored in {mirror} look the same: then import with the other {option}"
    if name == _AT_REST:
        return "did the gantry stop for every view? Then import without a frame time (stop-and-shoot)"
    return "check the readout's axis, direction and time: another readout fits the frames better"


def check_exposure(rt: Runtime, scan: Scan) -> Finding:
    """Fits a coarse scan with half and with twice the stated exposure.

    Only detail as fine as the arc of an exposure tells blur by motion from a blurred object. A sharper model always fits a
    little better, so the stated exposure is suspicious only if half of it leaves at most 60 % of the squared residual. It is
    "ok" if both half and twice the exposure fit worse."""
    if not scan.is_fly:
        text = "the gantry is stated to stand still: had it turned, a blurred object would fit as well"
        return Finding(EXPOSURE, CANNOT_TELL, 1.0, _HALF_RATIO, "share", text)
    if scan.shutter.pulse_s is not None:
        text = "the beam is pulsed: the pulse alone decides when lines see light"
        advice = "compare the pulse with the generator's log"
        return Finding(EXPOSURE, CANNOT_TELL, 1.0, _HALF_RATIO, "share", text, advice)
    stated, half = fit_squares(rt, scan), _squares_exposed(rt, scan, 0.5)
    ratio, errors = residual_ratio(stated, half), t_statistic(stated, half)
    text = f"exposed half as long, the squared residual is {ratio:.3g} times as large ({errors:+.1f} standard errors)"
    values = (ratio, _HALF_RATIO, "share", text)
    if ratio <= _HALF_RATIO and errors <= -_ERRORS:
        advice = f"correct the exposure time: {scan.shutter.exposure_s / 2:g} s explains the frames better"
        return Finding(EXPOSURE, SUSPICIOUS, *values, advice)
    with suppress(InputError):  # poses or angles may end too early for twice the exposure
        if _fits_worse(stated, half) and _fits_worse(stated, _squares_exposed(rt, scan, 2.0)):
            return Finding(EXPOSURE, OK, *values)
    return Finding(EXPOSURE, CANNOT_TELL, *values, "compare the exposure time with the scanner's log")


def _fits_worse(stated: np.ndarray, other: np.ndarray) -> bool:
    return residual_ratio(stated, other) >= _WORSE_RATIO and t_statistic(stated, other) >= _ERRORS


def _squares_exposed(rt: Runtime, scan: Scan, factor: float) -> np.ndarray:
    """Returns the frames' mean squared residuals (F,) if lines open as stated, and stay open ``factor`` times as long."""
    return fit_squares(rt, replace(scan, shutter=replace(scan.shutter, exposure_s=factor * scan.shutter.exposure_s)))
