"""Peak signal-to-noise ratio."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import finite, positive, shape
from phyradgs_cl.errors import InputError


def psnr(result: ArrayLike, reference: ArrayLike, data_range: float | None = None) -> float:
    """10 · log10(data_range² / mean squared error) in dB, over all voxels, without clipping; infinity for equals.

    ``data_range``: by default the reference's maximum. InputError: shapes that differ, NaN or infinity, a range
    that is not positive.
    """
    a, b, peak = checked_pair(result, reference, data_range)
    # A slice at a time: float64 copies of whole volumes would triple the memory.
    squares = sum(float(np.sum((p.astype(np.float64) - q) ** 2)) for p, q in zip(a, b, strict=True))
    return math.inf if squares == 0 else 10 * math.log10(peak**2 * a.size / squares)


def checked_pair(
    result: ArrayLike, reference: ArrayLike, data_range: float | None
) -> tuple[NDArray[np.floating], NDArray[np.floating], float]:
    """Both arrays with at least one axis, and the data range; InputError where they do not fit."""
    a, b = np.atleast_1d(np.asarray(result)), np.atleast_1d(np.asarray(reference))
    shape("result", a, b.shape)
    if b.size == 0:
        raise InputError("reference", f"shape {b.shape}", "at least one voxel")
    finite("result", a)
    finite("reference", b)
    peak = float(b.max()) if data_range is None else data_range
    positive("data range (by default the reference's maximum)", peak)
    return a, b, peak
