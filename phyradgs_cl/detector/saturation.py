"""Pixels at the end of a detector's range: asked of raw counts, before they become line integrals."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import Saturation

LEAST_SHARE = 1e-3
"""Of the pixels at one extreme: more is suspicious."""
_TOUCHING = 0.5  # of those, with all four neighbours at the same extreme
_SAME = 1e-3  # relative difference of a flat that still is the projections' ceiling
_MOST_FRAMES, _LONGEST_EDGE = 8, 1024  # of what noise is looked for in
_ROUNDING, _RELATIVE = 0.5, 2e-5  # noise in counts, and of the ceiling, that is none
_WHITE = 0.5  # least ratio of two estimates that agree on white noise and differ by far on smooth structure


def find_saturation(frames: NDArray[np.generic], flat: NDArray[np.floating]) -> Saturation:
    """The largest count of projections (P, v, u), and the share of their pixels clipped there: whole areas, unless they
    may as well be air without noise, at the mean ``flat``'s (v, u) count in frames that show no noise elsewhere."""
    level = float(np.fmax.reduce([np.fmax.reduce(frame, axis=None) for frame in frames]))
    share = clustered_share(frame == level for frame in frames)
    if share <= LEAST_SHARE or not (_flat_differs(frames, flat, level) or _shows_noise(frames, level)):
        share = 0.0
    return Saturation(level, share)


def clustered_share(extreme: Iterable[NDArray[np.bool_]]) -> float:
    """The share of pixels at an extreme, frame by frame (v, u), if most have four such neighbours; else 0: noise that
    is cut off puts single pixels there, saturation whole areas."""
    pixels = count = inner = touching = 0
    for at in extreme:
        pixels, count = pixels + at.size, count + int(np.count_nonzero(at))
        if min(at.shape) < 3 or not at.any():
            continue
        middle = at[1:-1, 1:-1]
        inner += int(np.count_nonzero(middle))
        sides = at[:-2, 1:-1] & at[2:, 1:-1] & at[1:-1, :-2] & at[1:-1, 2:]
        touching += int(np.count_nonzero(middle & sides))
    return count / pixels if inner and touching / inner > _TOUCHING else 0.0


def _flat_differs(frames: NDArray[np.generic], flat: NDArray[np.floating], level: float) -> bool:
    """Whether the clipped pixels would have to be air of another brightness than the flats."""
    hit = np.zeros(frames.shape[1:], bool)
    for frame in frames:
        hit |= frame == level
    return bool(np.median(np.abs(flat[hit] - level)) > _SAME * abs(level))


def _shows_noise(frames: NDArray[np.generic], level: float) -> bool:
    """Whether the pixels below the ceiling scatter: second differences along both axes, against those along rows."""
    along_rows, along_both = [], []
    top, left = (max(0, n - _LONGEST_EDGE) // 2 for n in frames.shape[1:])
    middle = np.s_[top : top + _LONGEST_EDGE, left : left + _LONGEST_EDGE]
    for frame in frames[:: -(-len(frames) // _MOST_FRAMES)]:
        values = np.where(frame[middle] < level, frame[middle], np.nan).astype(np.float64)
        along_rows.append(np.diff(values, 2, axis=1)[1:-1].ravel())
        along_both.append(np.diff(np.diff(values, 2, axis=1), 2, axis=0).ravel())
    rows, both = np.concatenate(along_rows), np.concatenate(along_both)
    known = np.isfinite(both)
    if not known.any():
        return True  # nothing but clipped pixels and their rims
    in_rows, in_both = (float(np.median(np.abs(d[known]))) / norm for d, norm in ((rows, 6**0.5), (both, 6.0)))
    return in_both > max(_ROUNDING, _RELATIVE * level, _WHITE * in_rows)
