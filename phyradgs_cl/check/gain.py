"""Does the gain of source or detector drift over the scan?"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.residual import fitted
from phyradgs_cl.check.statistics import vertex
from phyradgs_cl.runtime import Runtime

_TRIAL = 0.05  # line integral, over the whole scan
_LARGEST = 0.01
_DEVIATIONS = 4.0
_QUESTION = "gain drift"


def check_gain(rt: Runtime, scan: Scan) -> Finding:
    """The change of gain from the first frame to the last that makes a coarse ``scan`` most consistent.

    A gain that grows evenly adds the same ramp to all line integrals of a frame; residuals are quadratic in it. More than
    1 % and four standard deviations is suspicious.
    """
    drifts = np.array([-_TRIAL, 0.0, _TRIAL])
    drift, spread = vertex(drifts, np.stack([fitted(rt, without_drift(scan, d)) for d in drifts]))
    if not (math.isfinite(drift) and math.isfinite(spread)):
        return Finding(_QUESTION, CANNOT_TELL, 0.0, _LARGEST, "share", "residuals have no minimum")
    change, spread = math.expm1(drift), spread * math.exp(drift)
    text = f"the gain changes by {100 * change:+.2f} ± {100 * spread:.2f} % from the first frame to the last"
    if abs(change) <= max(_LARGEST, _DEVIATIONS * spread):
        verdict = OK if spread * _DEVIATIONS < 3 * _LARGEST else CANNOT_TELL
        return Finding(_QUESTION, verdict, change, _LARGEST, "share", text, uncertainty=spread)
    advice = "take flats before and after the scan, or normalise each frame by a patch of air"
    return Finding(_QUESTION, SUSPICIOUS, change, _LARGEST, "share", text, advice, spread)


def best_level(rt: Runtime, scan: Scan) -> float:
    """The constant that makes a coarse ``scan`` most consistent when it is added to all line integrals; 0 without one."""
    levels = np.array([-_TRIAL, 0.0, _TRIAL])
    level, _ = vertex(levels, np.stack([fitted(rt, without_drift(scan, 0.0, at)) for at in levels]))
    return level if math.isfinite(level) else 0.0


def without_drift(scan: Scan, drift: float, level: float = 0.0) -> Scan:
    """Line integrals (F, v, u) without a logarithm of the gain that grows evenly by ``drift``; ``level`` added to all."""
    start_s = np.asarray(scan.frame_start_s, np.float64)
    share = (start_s - start_s[0]) / max(float(start_s[-1] - start_s[0]), 1e-300)
    ramp = (level + drift * (share - 0.5)).astype(np.float32)
    return replace(scan, projections=scan.projections + ramp[:, None, None])
