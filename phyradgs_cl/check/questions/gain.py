"""Does the gain of source or detector change over the scan?"""

import math

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.questions.timing import start_azimuths_rad
from phyradgs_cl.check.residual import fit, system_of
from phyradgs_cl.runtime import Runtime

_LARGEST = 0.015
_DEVIATIONS = 5.0
_FEWEST = 8  # frames
GAIN = "gain drift"


def check_gain(rt: Runtime, scan: Scan) -> Finding:
    """The change of gain that the levels of the frames (line integrals that are the same in all pixels) give: a ramp
    and the largest step, beside what turns with the gantry. More than 1.5 % and five standard deviations is suspicious."""
    if scan.frames < _FEWEST:
        return Finding(GAIN, CANNOT_TELL, 0.0, _LARGEST, "share", f"fewer than {_FEWEST} frames")
    level = fit(system_of(rt, scan)).level
    angle = start_azimuths_rad(scan)
    share = np.linspace(-0.5, 0.5, scan.frames)
    turning = np.stack([np.ones(scan.frames), np.cos(angle), np.sin(angle)], 1)
    frames = np.arange(scan.frames)
    shapes = {"from the first frame to the last": share}
    shapes |= {f"at frame {at} (from 0)": (frames >= at).astype(float) for at in range(3, scan.frames - 2)}
    found = {where: _change(turning, shape, level) for where, shape in shapes.items()}
    where, (change, spread, _) = min(found.items(), key=lambda item: item[1][2])
    change = math.expm1(-change)  # more light, smaller line integrals
    text = f"the gain changes by {100 * change:+.2f} ± {100 * spread:.2f} % {where}"
    if abs(change) <= max(_LARGEST, _DEVIATIONS * spread):
        verdict = OK if spread * _DEVIATIONS < 3 * _LARGEST else CANNOT_TELL
        return Finding(GAIN, verdict, change, _LARGEST, "share", text, uncertainty=spread)
    advice = "take flats before and after the scan, or normalise each frame by a patch of air"
    return Finding(GAIN, SUSPICIOUS, change, _LARGEST, "share", text, advice, spread)


def _change(turning: np.ndarray, shape: np.ndarray, level: np.ndarray) -> tuple[float, float, float]:
    """(change of ``level`` (F,) along ``shape`` (F,), its standard deviation, squared residual); ``turning`` is (F, n)."""
    design = np.column_stack([turning, shape])
    found, *_ = np.linalg.lstsq(design, level, rcond=None)
    left = level - design @ found
    free = max(len(level) - design.shape[1], 1)
    spread = math.sqrt(float(left @ left) / free * float(np.linalg.pinv(design.T @ design)[-1, -1]))
    return float(found[-1]), spread, float(left @ left)
