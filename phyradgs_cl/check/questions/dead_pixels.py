"""Are there pixels that say the same in every frame, or always something other than their neighbours?"""

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.prepare.bad_pixels import LEAST_FRAMES, axis_column, find_dead

_SHARE = 2e-4  # of the panel's pixels
_QUESTION = "dead pixels"


def check_dead_pixels(scan: Scan) -> tuple[Finding, np.ndarray]:
    """The share of pixels that are dead (``prepare.dead``) and not masked, against 0.02 %; and where they are (v, u)
    bool."""
    known = ~scan.valid.any(0)
    if scan.frames < LEAST_FRAMES:
        text = f"fewer than {LEAST_FRAMES} frames"
        finding = Finding(_QUESTION, CANNOT_TELL, 0.0, _SHARE, "share of pixels", text)
        return finding, np.zeros(known.shape, bool)
    dead = find_dead(scan.projections, axis_column=axis_column(scan)) & ~known
    count = int(dead.sum())
    share = count / max(int((~known).sum()), 1)
    text = f"{count} pixels ({100 * share:.3g} %) that the mask does not have"
    if share <= _SHARE:
        return Finding(_QUESTION, OK, share, _SHARE, "share of pixels", text), dead
    row, column = (int(i[0]) for i in np.nonzero(dead))
    text += f", the first at row {row}, column {column}"
    advice = "'phyradgs prepare --steps dead' masks them"
    return Finding(_QUESTION, SUSPICIOUS, share, _SHARE, "share of pixels", text, advice), dead
