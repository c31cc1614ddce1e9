"""Sparks (zingers): single pixels of single frames that an X-ray, a cosmic ray or noise hit directly.

As for cosmic rays on astronomers' panels, what is sharper than the optics allow in every direction is no object: van Dokkum,
Publ. Astron. Soc. Pac. 113 (2001) 1420.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.prepare.masked import unmasked_frames, with_masked
from phyradgs_cl.prepare.step import Facts, MakeModel

_NORMAL_MAD = 1.4826
_SHARPNESS = 0.3  # of a spark's height, above what lies on either side
_NEAR, _FAR = 2, 3  # pixels away
_MOVED = 5  # pixels in which the next frame shows a gap of the object again
_SHOWN_AGAIN = 0.5  # of a spark's height
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_AROUND = np.ones((3, 3), bool)


@dataclass(frozen=True)
class SparkOptions:
    """threshold: least height in local deviations (``find_sparks``); least: and in line integrals, dimensionless; pixels:
    largest number that touch and still are one spark."""

    threshold: float = 5.0
    least: float = 0.1
    pixels: int = 6

    def __post_init__(self) -> None:
        checks.fields_within("sparks.", self, {"threshold": (1, 1e3), "least": (0, 10), "pixels": (1, 100)})


def find_sparks(
    frames: np.ndarray, *, threshold: float = 5.0, least: float = 0.1, pixels: int = 6
) -> np.ndarray:
    """Pixels of line integrals (F, v, u) that are brighter than any object can make them, bool (F, v, u).

    Those below the median of 5 × 5 by ``least`` and by ``threshold`` deviations (from the median of 9 × 9 absolute
    differences), in every direction, in groups of at most ``pixels``. What the frames before and after both show nearby, at
    least half as high, is a gap of the object that moves on.
    """
    found = np.stack([_in_frame(frame, threshold, least, pixels) for frame in frames])
    for f in np.flatnonzero(found.any(axis=(1, 2))) if len(frames) > 2 else ():
        height = _height(frames[f])
        around = (frames[f - 1 if f else 1], frames[f + 1 if f + 1 < len(frames) else f - 1])
        shown = [scipy.ndimage.maximum_filter(_height(frame), size=_MOVED) for frame in around]
        found[f] &= np.minimum(*shown) < _SHOWN_AGAIN * height
    return found


def mask_sparks(scan: Scan, options: SparkOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan with its sparks masked and filled in."""
    frames = unmasked_frames(scan)
    found = find_sparks(frames, **vars(options)) & scan.valid
    count = int(found.sum())
    return with_masked(scan, found), {"pixels": count, "share": count / found.size}


def _in_frame(frame: np.ndarray, threshold: float, least: float, pixels: int) -> np.ndarray:
    height = _height(frame)
    bright = height > least
    if not bright.any():
        return bright
    usual = scipy.ndimage.median_filter(np.abs(height), size=9, mode="nearest")
    bright &= height > threshold * _NORMAL_MAD * usual
    for sides in _opposite(frame):
        bright &= sides - frame > _SHARPNESS * height
    groups, count = scipy.ndimage.label(bright, _AROUND)
    sizes = np.bincount(groups.ravel(), minlength=count + 1)
    return bright & (sizes[groups] <= pixels)


def _height(frame: np.ndarray) -> np.ndarray:
    """How much brighter than the median of 5 × 5 pixels a frame (v, u) is, in line integrals."""
    return np.asarray(scipy.ndimage.median_filter(frame, size=5, mode="nearest") - frame)


def _opposite(frame: np.ndarray) -> Iterable[np.ndarray]:
    """Per direction, the lower of the two pixels on either side (v, u), two pixels away or, where another spark is there,
    three; beyond the panel goes on what is at its edge, mirrored."""
    wide = np.pad(frame, _FAR, mode="symmetric")
    rows, columns = frame.shape

    def moved(v: int, u: int) -> np.ndarray:
        return wide[_FAR + v : _FAR + v + rows, _FAR + u : _FAR + u + columns]

    for v, u in _DIRECTIONS:
        pairs = (np.minimum(moved(k * v, k * u), moved(-k * v, -k * u)) for k in (_NEAR, _FAR))
        yield np.maximum(*pairs)
