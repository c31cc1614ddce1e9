"""Rings: what stays in a pixel over all views, because its gain is not what the flats say.

``few``: per frame what a median along the row takes away, its median over the views (Boin and Haibel, Opt. Express 14 (2006)
12071, who average), and of that what stands out of its own scatter. It asks no more of a view than that the object moves on,
and holds for fly-scans. ``many``: the sorting of Vo, Atwood and Drakopoulos, Opt. Express 26 (2018) 28396, algorithm 3: over a
turn all neighbouring pixels see much the same values, in another order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.prepare.dead import axis_column
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel

METHODS = ("auto", "few", "many")
MANY_VIEWS = 180
_NORMAL_MAD, _MEDIAN_ERROR = 1.4826, 1.2533  # of normal values; a median's standard error over a mean's
_SURE = 4.0  # standard errors: a pixel this far off is a ring whatever the others are
_NEAR_AXIS = 3.0  # columns: here the object's own rings look like the panel's


@dataclass(frozen=True)
class RingOptions:
    """method: few, many, or auto by the number of views. window: pixels of the median along a row; wider rings stay."""

    method: str = "auto"
    window: int = 9

    def __post_init__(self) -> None:
        checks.one_of("rings.method", self.method, METHODS)
        checks.within("rings.window", self.window, 3, 999)


def ring_pattern(frames: np.ndarray, *, window: int = 9, axis_column: float | None = None) -> np.ndarray:
    """What the pixels add to all line integrals (F, v, u), (v, u) float32: the method ``few``.

    Every pixel's share of what was found is what the scatter over the views says is real (Wiener's, with the variance of the
    pattern itself from all pixels), near ``axis_column`` no more than that.
    """
    rest = frames - scipy.ndimage.median_filter(frames, size=(1, 1, window), mode="nearest")
    middle = np.median(rest, axis=0)
    error = _NORMAL_MAD * np.median(np.abs(rest - middle), axis=0) * _MEDIAN_ERROR / np.sqrt(len(frames))
    spread = _NORMAL_MAD * np.median(np.abs(middle - np.median(middle)))
    signal = max(0.0, float(spread**2 - np.median(error**2)))
    noise = np.maximum(error**2, 1e-20)
    share = signal / (signal + noise)
    sure = 1 - noise * _SURE**2 / np.maximum(middle**2, 1e-20)
    if axis_column is not None:
        sure[:, np.abs(np.arange(frames.shape[2]) - axis_column) <= _NEAR_AXIS] = 0
    return (middle * np.maximum(share, sure)).astype(np.float32)


def sort_rings(frames: np.ndarray, *, window: int = 9) -> np.ndarray:
    """Line integrals (F, v, u) without rings, float32: the method ``many``."""
    order = np.argsort(frames, axis=0)
    ranked = np.take_along_axis(frames, order, axis=0)
    smooth = scipy.ndimage.median_filter(ranked, size=(1, 1, window), mode="nearest")
    result = np.empty(frames.shape, np.float32)
    np.put_along_axis(result, order, smooth.astype(np.float32), axis=0)
    return result


def remove_rings(scan: Scan, options: RingOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan without its rings, by the method that is chosen."""
    method = options.method
    if method == "auto":
        method = "many" if scan.frames >= MANY_VIEWS else "few"
    frames = unmasked_frames(scan)
    if method == "few":
        pattern = ring_pattern(frames, window=options.window, axis_column=axis_column(scan))
        clean = frames - pattern
    else:
        clean = sort_rings(frames, window=options.window)
    change = float(np.sqrt(np.mean((clean - frames).astype(np.float64) ** 2)))
    return replace(scan, projections=clean), {"method": method, "rms_change": change}
