"""Are pixels at the end of the detector's range?"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from phyradgs_cl.acquisition import Saturation, Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding
from phyradgs_cl.detector import clustered_share, counts_to_attenuation

_SHARE = 1e-3  # of the pixels at one end
_AGAIN = 3  # frames
_ZERO = 1e-6  # line integral
_CLIFF = 0.75  # of the brightest transmission, from a pixel to the next
_CLIFFS = 5e-4  # of the pixels
OVERFLOW = "overflow"  # unit of a finding after which line integrals mean nothing
_QUESTION = "saturation"


@dataclass
class CountReader:
    """``counts_to_attenuation`` for ``read_scan``, which remembers what the counts say: ``at_ceiling`` is the share of
    the projections' pixels at ``ceiling``, the largest count of any frame; None of files without counts."""

    ceiling: float | None = None
    at_ceiling: float = 0.0

    def __call__(
        self, data: np.ndarray, image_key: np.ndarray, quantity: str
    ) -> tuple[np.ndarray, np.ndarray]:
        if quantity == "counts":
            frames = data[image_key == 0]
            self.ceiling = float(data[image_key != 2].max())
            self.at_ceiling = clustered_share(frames == self.ceiling)
        return counts_to_attenuation(data, image_key, quantity)


def check_saturation(scan: Scan, counts: CountReader | None = None) -> Finding:
    """The share of pixels that sit, with all their neighbours, at the same extreme value; 0.1 % is suspicious. Noise
    cut off at 0 puts single pixels there, saturation whole areas; areas of exactly 0 may be air, and cannot tell."""
    if counts is not None and counts.ceiling is not None and counts.at_ceiling > _SHARE:
        return _clipped(Saturation(counts.ceiling, counts.at_ceiling), "lower the exposure, or mask these pixels")
    if scan.saturation is not None and scan.saturation.share > _SHARE:
        return _clipped(scan.saturation, "lower the exposure; the import has masked these pixels, or taken them as air")
    p = np.asarray(scan.projections)
    masked = ~scan.valid
    cliffs = _cliffs(p, masked)
    if cliffs > _CLIFFS:
        text = f"from a pixel to the next {100 * cliffs:.3g} % go from brightest to darkest"
        advice = "did counts overflow (65,536 becomes 0)? Read the frames as unsigned, or lower the exposure"
        return Finding(_QUESTION, SUSPICIOUS, cliffs, _CLIFFS, OVERFLOW, text, advice)
    lowest, highest = float(p[~masked].min()), float(p[~masked].max())
    inverted = float(np.median(p[:, :, [0, -1]])) == highest  # air is at the wrong end: not for this question to say
    at_own_least = 0.0 if inverted else _at_own_least(p, masked)
    ends = {
        "least": (max(clustered_share((p == lowest) & ~masked & (abs(lowest) > _ZERO)), at_own_least), lowest),
        "largest": (clustered_share((p == highest) & ~masked) if highest > _ZERO and not inverted else 0.0, highest),
    }
    name, (share, value) = max(ends.items(), key=lambda item: item[1][0])
    text = f"{100 * share:.3g} % of the pixels lie together at the {name} line integral, {value:.4g}"
    zeros = clustered_share((np.abs(p) < _ZERO) & ~masked)
    if share <= _SHARE < zeros:
        text = f"{100 * zeros:.3g} % of the pixels lie together at 0: air without noise, or flats that are clipped too"
        return Finding(_QUESTION, CANNOT_TELL, zeros, _SHARE, "share of pixels", text, "look at the raw counts")
    if share <= _SHARE:
        return Finding(_QUESTION, OK, share, _SHARE, "share of pixels", text)
    advice = {
        "least": "the detector is saturated behind thin parts: lower the exposure, or mask these pixels",
        "largest": "no light comes through there: raise the exposure, or mask these pixels",
    }[name]
    return Finding(_QUESTION, SUSPICIOUS, share, _SHARE, "share of pixels", text, advice)


def _clipped(found: Saturation, remedy: str) -> Finding:
    text = f"{100 * found.share:.3g} % of the pixels lie together at {found.level:g} counts"
    advice = f"the detector is saturated there: {remedy}"
    return Finding(_QUESTION, SUSPICIOUS, found.share, _SHARE, "share of pixels", text, advice)


def _cliffs(p: np.ndarray, masked: np.ndarray) -> float:
    """The share of pixels (F, v, u) that are as bright as any beside one that is dark; one or two dead ones aside."""
    if p.shape[2] < 2:
        return 0.0
    transmission = np.where(masked, 1.0, np.exp(-np.clip(p, -20, 20))).astype(np.float32)
    brightest = float(np.percentile(transmission[:: max(1, len(p) // 20)], 99))
    jumps = np.abs(np.diff(median_filter(transmission, size=(1, 1, 5)), axis=2)) > _CLIFF * brightest
    return float(np.median(jumps.mean((1, 2))))  # of most frames: a few that are odd are another question


def _at_own_least(p: np.ndarray, masked: np.ndarray) -> float:
    """The share of pixels (F, v, u) at their own least value again and again: counts clipped before the flats. Pixels
    that never change are dead, and line integrals of 0 are air in scans without noise."""
    least = p.min(0)
    at = (p == least) & ~masked & (np.abs(least) > _ZERO) & (p.max(0) > least)
    return clustered_share(at & (at.sum(0) >= _AGAIN))
