"""Do the frames say how far the panel is from the source?"""

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, PIXEL_SIZES, Finding
from phyradgs_cl.check.hypotheses import nearly_sized
from phyradgs_cl.check.questions.offset import free_offset
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import residual_ratio, t_statistic
from phyradgs_cl.runtime import Runtime

_OTHERS = (0.8, 1.25)
_OK_RATIO, _ERRORS = 1.05, 4.0
DISTANCES = "distances"
UNVERIFIED = "neither pixel sizes nor distances are verified by these frames"


def check_distances(rt: Runtime, scan: Scan) -> Finding:
    """Pixels 0.8 and 1.25 times as large over the panel's distance, each with the panel's offset that fits it best, by a
    coarse ``scan``'s squared residuals.

    Only the fan tells them apart: it is ``ok`` where both fit worse. Sizes that fit far better are no matter of this
    question: under those the frames are not consistent.
    """
    stated = fitted(rt, scan)
    others = {factor: fitted(rt, free_offset(rt, nearly_sized(scan, factor))) for factor in _OTHERS}
    ratios = {factor: residual_ratio(stated, other) for factor, other in others.items()}
    best = min(ratios, key=lambda factor: ratios[factor])
    text = f"pixels over the panel's distance {best:g} times as large leave {ratios[best]:.3g} times the squared residual"
    fit_worse = all(ratios[f] >= _OK_RATIO and t_statistic(stated, others[f]) >= _ERRORS for f in _OTHERS)
    advice = "" if fit_worse else f"compare distances and {PIXEL_SIZES} with the scanner's log"
    return Finding(DISTANCES, OK if fit_worse else CANNOT_TELL, ratios[best], _OK_RATIO, "share", text, advice)
