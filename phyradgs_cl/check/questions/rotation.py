"""Does the gantry turn the way that the angles say?"""

from dataclasses import replace

from phyradgs_cl.check.finding import CANNOT_TELL, MIRROR_U, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.questions.offset import Offset
from phyradgs_cl.check.statistics import residual_ratio, t_statistic

_ERRORS = 4.0
_LEAST_RATIO, _CLEAR_RATIO = 1.2, 3.0
SIGN = "sign of rotation"


def is_clear(stated: Offset, other: Offset) -> bool:
    """Whether one of two rough offsets explains the frames so much better that the other needs no second look."""
    ratio = residual_ratio(stated.residuals, other.residuals)
    return max(ratio, 1 / max(ratio, 1e-30)) >= _CLEAR_RATIO


def check_rotation(stated: Offset, other: Offset) -> Finding:
    """Coarse reconstructions with the angles as they are and turned round, each with its own best panel shift. Four
    standard errors decide, and 20 % of the squared residual: a mirror image in a narrow fan fits as well. Frames mirrored
    in u fit with the angles turned round as well, and with the opposite offset: ``blamed`` says which of the two it is."""
    errors, ratio = t_statistic(stated.residuals, other.residuals), residual_ratio(stated.residuals, other.residuals)
    text = f"turned the other way, the squared residual is {ratio:.3g} times as large ({errors:+.1f} standard errors)"
    values = (errors, -_ERRORS, "standard errors", text)
    if errors >= _ERRORS and ratio >= _LEAST_RATIO:
        return Finding(SIGN, OK, *values)
    if errors <= -_ERRORS and ratio <= 1 / _LEAST_RATIO:
        return Finding(SIGN, SUSPICIOUS, *values)
    advice = "look for a feature whose side is known: a mirror image would fit as well"
    return Finding(SIGN, CANNOT_TELL, *values, advice)


def blamed(finding: Finding, moved_px: float, stated_px: float, tolerance_px: float) -> Finding:
    """The suspicious ``finding`` with its cause: frames are mirrored where the panel, turned round, fits nearer to the
    opposite of the stated offset than to it. An offset below the tolerance does not tell."""
    if abs(stated_px) < tolerance_px:
        text = f"{finding.text}; frames mirrored in u would look the same"
        advice = f"change the sign of the angles ('gantry' for 'sample'), or import with the other {MIRROR_U}"
    elif abs(moved_px + 2 * stated_px) < abs(moved_px):
        text = f"frames are mirrored in u: {finding.text}, with detector_offset of the other sign"
        advice = f"import with the other {MIRROR_U}, or change the signs of the angles and of detector_offset along u"
    else:
        text = f"{finding.text}, with detector_offset as stated"
        advice = "change the sign of the angles ('gantry' for 'sample')"
    return replace(finding, text=text, advice=f"{advice}, and check again")
