"""Checks that the gantry turns as the angles say, that its axis is where it is stated, and that the distances fit."""

import math
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import has_opposite_views
from phyradgs_cl.acquisition.altered.variants import reversed_rotation, shifted
from phyradgs_cl.check.finding import (
    CANNOT_TELL,
    FEWEST_COLUMNS,
    MIRROR_U,
    OK,
    PIXEL_SIZES,
    SUSPICIOUS,
    Finding,
    same_from_everywhere,
    too_narrow,
)
from phyradgs_cl.check.hypotheses import (
    SIZE_FACTORS,
    has_axis_near_edge,
    nearly_sized,
    shifts_for_sense_px,
    stated_redundancy,
)
from phyradgs_cl.check.timing import is_full_turn
from phyradgs_cl.reconstructors.fits import axis
from phyradgs_cl.reconstructors.fits.axis import opposite_shift
from phyradgs_cl.reconstructors.fits.residuals import fit_squares, residual_ratio, t_statistic
from phyradgs_cl.reconstructors.fits.twice import shift_by_rays_seen_twice
from phyradgs_cl.runtime import Runtime

SIGN, CENTRE, DISTANCES = "sign of rotation", "centre of rotation", "distances"
OTHER_CAUSE = "pixels, if pixel sizes are right"  # unit of a finding about an offset that wrong pixel sizes explain as well
UNVERIFIED = "neither pixel sizes nor distances are verified by these frames"
_ERRORS = 4.0  # squared residuals of two hypotheses must differ by this many standard errors; else "cannot tell"
_SIGN_RATIO = 1.2  # least (squared residual of the wrong sense of rotation) / (that of the right sense)
_CLEAR_RATIO = 3.0  # shifts are not refined if the squared residuals of both senses' rough fits differ by this factor
_TOLERATED_PX = 1 / 3  # a shift of the panel by up to this many pixels is always tolerated
_DEVIATIONS = 4.0  # a shift by up to this many of its standard deviations is always tolerated
_BIAS_FULL_TURN = 0.003  # measured error of the axis in scans of a full turn, in coarse pixels
_BIAS_HALF_TURN = 0.04  # measured error of the axis in coarse pixels, if some rays are measured only once
_WHOLE_PIXELS = 2  # if shifts were found from full pixels, "ok" needs a threshold of at most this many pixels
_LEAST_REDUNDANCY = 0.1  # the fraction of rays measured twice, by which an error is divided, is raised to at least this
_NO_SIGN = "parallel rays show an object that turns one way and its mirror image that turns the other way alike"
_SIGN_ADVICE = "look for a feature whose side is known: a mirror image would fit as well"
_OTHER_SIZES = (0.8, 1.25)  # factors on the fan's width: distances are "ok" if both other fans fit worse than the stated fan
_SIZE_RATIO = 1.05  # another fan fits worse if (its squared residual) / (the stated fan's) is at least this


@dataclass(frozen=True, eq=False)
class Orbit:
    """The findings about the sense of rotation (``sign``) and the axis (``centre``). shift: how far the panel is from its
    stated place along u. is_reversed: whether the gantry turns the other way than stated."""

    sign: Finding
    centre: Finding
    shift: axis.AxisShift = axis.AxisShift(math.nan, math.nan, np.empty(0))
    is_reversed: bool = False

    def corrected(self, scan: Scan) -> Scan:
        """Returns a coarse scan with the sense of rotation that was found. The panel is shifted too, if the shift is
        significant."""
        scan = reversed_rotation(scan) if self.is_reversed else scan
        is_shifted = self.shift.is_found and abs(self.shift.pixels) > self.centre.threshold
        return shifted(scan, self.shift.pixels) if is_shifted else scan


def find_orbit(rt: Runtime, quick: Scan, as_stated: Scan, sees_angles: bool) -> Orbit:
    """Finds from the coarse scan ``quick`` which way the gantry turns and where the axis is. Neither is found on a panel of
    few columns, nor if the object looks the same from all angles (``sees_angles`` False)."""
    if quick.geometry.detector_shape[1] < FEWEST_COLUMNS:
        return Orbit(too_narrow(SIGN, "standard errors"), too_narrow(CENTRE, "pixels"))
    if not sees_angles:
        return Orbit(same_from_everywhere(SIGN), same_from_everywhere(CENTRE))
    block = axis.columns_per_block(quick)
    if has_opposite_views(as_stated):
        sign = Finding(SIGN, CANNOT_TELL, 0.0, -_ERRORS, "standard errors", _NO_SIGN, _SIGN_ADVICE)
        shift, centre = centre_of(axis.axis_shift(rt, quick), block, as_stated)
        return Orbit(sign, centre, shift)
    reverse, limits_px = reversed_rotation(quick), shifts_for_sense_px(quick)
    stated, other = (axis.rough_shift(rt, sense, limits_px) for sense in (quick, reverse))
    ratio = residual_ratio(stated.squares, other.squares)
    is_rough = max(ratio, 1 / max(ratio, 1e-30)) >= _CLEAR_RATIO  # a difference so large needs no refined shifts
    if not is_rough:
        stated = axis.refined_shift(rt, quick, stated, limits_px)
        other = axis.refined_shift(rt, reverse, other, limits_px)
    sign = check_rotation(stated, other)
    is_reversed = sign.verdict == SUSPICIOUS
    shift = other if is_reversed else stated
    if is_rough or limits_px != axis.ANYWHERE:
        shift = axis.refined_shift(rt, reverse if is_reversed else quick, shift)
    shift, centre = centre_of(shift, block, reversed_rotation(as_stated) if is_reversed else as_stated)
    if is_reversed:
        stated_px = as_stated.geometry.detector_offset_mm[1] / as_stated.geometry.pixel_size_mm[1]
        sign = with_cause(sign, shift.pixels, stated_px, centre.threshold)
        centre = replace(centre, verdict=CANNOT_TELL, text=f"rests on {SIGN}: {SUSPICIOUS}", advice="")
    return Orbit(sign, centre, shift, is_reversed)


def check_rotation(stated: axis.AxisShift, other: axis.AxisShift) -> Finding:
    """Compares the residuals with the angles as stated and reversed, each with its own best shift of the panel.

    To decide, squared residuals must differ by four standard errors and by a factor of 1.2: in a narrow fan a mirror image
    fits as well. Frames mirrored in u fit reversed angles with the opposite offset; ``with_cause`` tells the two apart."""
    errors, ratio = t_statistic(stated.squares, other.squares), residual_ratio(stated.squares, other.squares)
    text = f"turned the other way, the squared residual is {ratio:.3g} times as large ({errors:+.1f} standard errors)"
    values = (errors, -_ERRORS, "standard errors", text)
    if errors >= _ERRORS and ratio >= _SIGN_RATIO:
        return Finding(SIGN, OK, *values)
    if errors <= -_ERRORS and ratio <= 1 / _SIGN_RATIO:
        return Finding(SIGN, SUSPICIOUS, *values)
    return Finding(SIGN, CANNOT_TELL, *values, _SIGN_ADVICE)


def with_cause(finding: Finding, shift_px: float, stated_px: float, tolerance_px: float) -> Finding:
    """Returns the finding about a wrong sense of rotation with its cause: angles are reversed, or frames mirrored in u.

    stated_px: the panel's offset along u. stated_px + shift_px: the offset that fits best under reversed angles. If it is
    nearer to −stated_px than to stated_px, frames are mirrored. If |stated_px| < ``tolerance_px``, the advice names both
    causes."""
    if abs(stated_px) < tolerance_px:
        text = f"{finding.text}; frames mirrored in u would look the same"
        advice = f"change the sign of the angles ('gantry' for 'sample'), or import with the other {MIRROR_U}"
    elif abs(shift_px + 2 * stated_px) < abs(shift_px):
        text = f"frames are mirrored in u: {finding.text}, with detector_offset of the other sign"
        advice = f"import with the other {MIRROR_U}, or change the signs of the angles and of detector_offset along u"
    else:
        text = f"{finding.text}, with detector_offset as stated"
        advice = "change the sign of the angles ('gantry' for 'sample')"
    return replace(finding, text=text, advice=f"{advice}, and check again")


def centre_of(shift: axis.AxisShift, block: int, scan: Scan) -> tuple[axis.AxisShift, Finding]:
    """Returns the panel's shift along u and the finding about it. ``shift`` was found with blocks of ``block`` pixels.

    The standard deviation also gets the error by coarse pixels, which the bootstrap over frames does not include. This error
    is larger where ``scan`` measures fewer rays twice. Opposite views of parallel rays give a shift too, from pixels of full
    size; the shift with the smaller deviation counts. If the panel sees the axis but measures fewer than half of the rays
    twice, ``shift_by_rays_seen_twice`` decides: in a fit, any shift with fewer such rays would leave less residual."""
    pitch_mm = scan.geometry.pixel_size_mm[1]
    if has_axis_near_edge(scan):
        shift = shift_by_rays_seen_twice(scan)
        return shift, check_centre(shift, _WHOLE_PIXELS, pitch_mm, scan.geometry.detector_offset_mm[1] / pitch_mm)
    twice = min(2 * stated_redundancy(scan), 1.0)
    is_whole = is_full_turn(scan) and twice == 1
    bias = _BIAS_FULL_TURN if is_whole else _BIAS_HALF_TURN / max(twice, _LEAST_REDUNDANCY)
    shift = replace(shift, deviation=math.hypot(shift.deviation, block * bias))
    by_views = opposite_shift(scan)
    if by_views.is_found and not by_views.deviation >= shift.deviation:
        shift, block = by_views, min(block, _WHOLE_PIXELS)
    return shift, check_centre(shift, block, pitch_mm, scan.geometry.detector_offset_mm[1] / pitch_mm)


def check_centre(shift: axis.AxisShift, block: int, pitch_mm: float, stated_px: float) -> Finding:
    """Finds whether the panel is shifted along u by more than 1/3 pixel and more than four standard deviations.

    If (offset found) / (stated offset) is a factor between units, the offset may be right in mm and pixel sizes wrong."""
    threshold = max(_TOLERATED_PX, _DEVIATIONS * shift.deviation)
    if not (shift.is_found and math.isfinite(shift.deviation)):
        return Finding(CENTRE, CANNOT_TELL, 0.0, _TOLERATED_PX, "pixels", "no shift fits best")
    shift_mm = shift.pixels * pitch_mm
    pixels = f"{shift.pixels:+.2f} ± {shift.deviation:.2f} pixels"
    text = f"the panel is {pixels} ({shift_mm:+.4g} mm) from its stated place along u"
    if abs(shift.pixels) <= threshold:
        verdict = OK if threshold <= block else CANNOT_TELL
        return Finding(CENTRE, verdict, shift.pixels, threshold, "pixels", text, uncertainty=shift.deviation)
    near = [f for f in SIZE_FACTORS if abs(stated_px + shift.pixels - stated_px / f) <= threshold < abs(stated_px / f)]
    if near:
        text += f": {1 / near[0]:g} times the stated offset, as if pixel sizes were {near[0]:g} times as large"
        advice = "compare detector_offset and pixel sizes, and their units, with the scanner's log: frames fit either"
        return Finding(CENTRE, SUSPICIOUS, shift.pixels, threshold, OTHER_CAUSE, text, advice, shift.deviation)
    if abs(2 * stated_px + shift.pixels) <= threshold:
        text += "; frames mirrored in u and turned the other way would look the same"
    advice = (
        f"add {shift_mm:.4g} mm to detector_offset along u: --fix-offset writes a copy of the scan; "
        "'phyradgs calibrate' looks for roll as well"
    )
    return Finding(CENTRE, SUSPICIOUS, shift.pixels, threshold, "pixels", text, advice, shift.deviation)


def check_distances(rt: Runtime, scan: Scan) -> Finding:
    """Fits a coarse scan with its fan 0.8 and 1.25 times as wide, each with its own best shift of the panel.

    Sizes and distances show only in the fan. The answer is "ok" if both other fans fit worse, otherwise "cannot tell". A fan
    that leaves less than half of the stated fan's squared residual is found by ``check_consistency``."""
    stated = fit_squares(rt, scan)
    others = {factor: fit_squares(rt, axis.with_best_shift(rt, nearly_sized(scan, factor))) for factor in _OTHER_SIZES}
    ratios = {factor: residual_ratio(stated, other) for factor, other in others.items()}
    best = min(ratios, key=lambda factor: ratios[factor])
    text = f"pixels over the panel's distance {best:g} times as large leave {ratios[best]:.3g} times the squared residual"
    values = (ratios[best], _SIZE_RATIO, "share", text)
    if all(ratios[f] >= _SIZE_RATIO and t_statistic(stated, others[f]) >= _ERRORS for f in _OTHER_SIZES):
        return Finding(DISTANCES, OK, *values)
    return Finding(DISTANCES, CANNOT_TELL, *values, f"compare distances and {PIXEL_SIZES} with the scanner's log")
