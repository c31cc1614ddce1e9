"""Are pixels at the end of the detector's range?"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from phyradgs_cl.acquisition import Saturation, Scan
from phyradgs_cl.check.finding import OK, SUSPICIOUS, Finding
from phyradgs_cl.detector import clustered_share, counts_to_attenuation

_SHARE = 1e-3  # of the pixels at one end
_ZERO = 1e-6  # line integral
_QUESTION = "saturation"


@dataclass
class CountReader:
    """Turns stored frames into line integrals, as ``counts_to_attenuation`` does, and remembers what the counts say.

    For ``read_scan``; ``at_ceiling`` is the share of the projections' pixels at ``ceiling``, the largest count that any
    frame has, None where the file does not hold counts.
    """

    ceiling: float | None = None
    at_ceiling: float = field(default=0.0)

    def __call__(
        self, data: np.ndarray, image_key: np.ndarray, quantity: str
    ) -> tuple[np.ndarray, np.ndarray]:
        if quantity == "counts":
            frames = data[image_key == 0]
            self.ceiling = float(data[image_key != 2].max())
            self.at_ceiling = clustered_share(frames == self.ceiling)
        return counts_to_attenuation(data, image_key, quantity)


def check_saturation(scan: Scan, counts: CountReader | None = None) -> Finding:
    """The share of pixels that sit, with all their neighbours, at the same extreme value; 0.1 % is suspicious.

    Noise that is cut off at 0 puts single pixels there, saturation whole areas. A line integral of exactly 0 is not
    asked: it is air in simulated and in clipped scans.
    """
    if counts is not None and counts.ceiling is not None and counts.at_ceiling > _SHARE:
        return _clipped(Saturation(counts.ceiling, counts.at_ceiling), "lower the exposure, or mask these pixels")
    if scan.saturation is not None and scan.saturation.share > _SHARE:
        return _clipped(scan.saturation, "lower the exposure; the import has masked these pixels, or taken them as air")
    p = np.asarray(scan.projections)
    masked = (
        np.zeros(p.shape, bool) if scan.pixel_mask is None else np.broadcast_to(scan.pixel_mask != 0, p.shape)
    )
    lowest, highest = float(p[~masked].min()), float(p[~masked].max())
    ends = {
        "least": (0.0 if abs(lowest) < _ZERO else clustered_share((p == lowest) & ~masked), lowest),
        "largest": (clustered_share((p == highest) & ~masked) if highest > _ZERO else 0.0, highest),
    }
    name, (share, value) = max(ends.items(), key=lambda item: item[1][0])
    text = f"{100 * share:.3g} % of the pixels lie together at the {name} line integral, {value:.4g}"
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
