"""Rings: what stays in a pixel over all views, because its gain is not what the flats say.

``few``: per frame what a median along the row takes away, and what of that the sectors of a turn have in common (Boin and
Haibel, Opt. Express 14 (2006) 12071, with averages). It asks no more of a view than that the object moves on, and holds for
fly-scans. ``fitted``: likewise of what a volume with little total variation, which has few rings, leaves of the frames
(after Paleo and Mirone, J. Synchrotron Radiat. 22 (2015) 1268): patterns of any width, of an object that is on the grid.
``many``: the sorting of Vo, Atwood and Drakopoulos, Opt. Express 26 (2018) 28396, algorithm 3: over a turn all neighbouring
pixels see much the same values, in another order.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.dead import axis_column
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel, Model

METHODS = ("auto", "few", "fitted", "many")
MANY_VIEWS = 180
_NORMAL_MAD, _MEDIAN_ERROR = 1.4826, 1.2533  # of normal values; a median's standard error over a mean's
_PASSES, _SECTORS = 3, 15
_LEAST_ERROR = 0.5  # of the panel's median: no pixel is surer than this
_SURE = 6.0  # standard errors: a pixel this far off is a ring whatever the others are
_NEAR_AXIS = 3.0  # columns: here the object's own rings look like the panel's


@dataclass(frozen=True)
class RingOptions:
    """method: few or many, or auto by the number of views; fitted. window: pixels of the median along a row; wider rings
    stay, but for ``fitted``."""

    method: str = "auto"
    window: int = 7

    def __post_init__(self) -> None:
        checks.one_of("rings.method", self.method, METHODS)
        checks.within("rings.window", self.window, 3, 999)


def ring_pattern(frames: np.ndarray, *, window: int = 7, axis_column: float | None = None) -> np.ndarray:
    """What the pixels add to all line integrals (F, v, u), (v, u) float32: the method ``few``.

    Views are taken in sectors of the turn. Of what their medians have in common every pixel gets the share that their
    scatter says is real (Wiener's, the variance of the pattern from all pixels): structure that stays for some views only is
    left alone. Pixels far beyond that scatter get all of it, but for those near ``axis_column``.
    """
    pattern = np.zeros(frames.shape[1:], np.float32)
    may_be_object = np.zeros(frames.shape[2], bool)
    if axis_column is not None:
        may_be_object = np.abs(np.arange(frames.shape[2]) - axis_column) <= _NEAR_AXIS
    for _ in range(_PASSES):  # a baseline of frames with fewer rings has fewer rings
        smooth = scipy.ndimage.median_filter(frames - pattern, size=(1, 1, window), mode="nearest")
        pattern = _common(frames - smooth, may_be_object)
    return pattern


def _common(rest: np.ndarray, may_be_object: np.ndarray) -> np.ndarray:
    """What the sectors of ``rest`` (F, v, u) share, (v, u) float32, as far as it is sure."""
    count = min(_SECTORS, len(rest))
    sectors = np.stack([np.median(part, axis=0) for part in np.array_split(rest, count)])
    middle = np.median(sectors, axis=0)
    error = _NORMAL_MAD * np.median(np.abs(sectors - middle), axis=0) * _MEDIAN_ERROR / np.sqrt(count)
    error = np.maximum(error, _LEAST_ERROR * np.median(error))
    spread = _NORMAL_MAD * np.median(np.abs(middle - np.median(middle)))
    signal, noise = max(0.0, float(spread**2 - np.median(error**2))), np.maximum(error**2, 1e-20)
    sure = 1 - noise * _SURE**2 / np.maximum(middle**2, 1e-20)
    sure[:, may_be_object] = 0
    return (middle * np.maximum(signal / (signal + noise), sure)).astype(np.float32)


def fitted_pattern(frames: np.ndarray, model: Model, first: np.ndarray) -> np.ndarray:
    """What the pixels add to all line integrals (F, v, u), (v, u) float32, from a ``first`` guess on: ``fitted``."""
    pattern, nowhere = first, np.zeros(frames.shape[2], bool)
    for _ in range(_PASSES):  # a volume of frames with fewer rings has fewer rings
        left = frames - model.frames(model.regularised(frames - pattern))
        pattern = _common(left, nowhere)
    return pattern


def sort_rings(frames: np.ndarray, *, window: int = 7) -> np.ndarray:
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
    if options.window > frames.shape[2]:
        expected = f"no more than the panel's {frames.shape[2]} columns"
        raise InputError("rings.window", str(options.window), expected, "a little more than the rings are wide")
    if method == "many":
        clean = sort_rings(frames, window=options.window)
    else:
        pattern = ring_pattern(frames, window=options.window, axis_column=axis_column(scan))
        clean = frames - (pattern if method == "few" else fitted_pattern(frames, make_model(scan), pattern))
    change = float(np.sqrt(np.mean((clean - frames).astype(np.float64) ** 2)))
    return replace(scan, projections=clean), {"method": method, "rms_change": change}
