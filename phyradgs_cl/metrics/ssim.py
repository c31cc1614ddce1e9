"""Structural similarity (Z. Wang et al., IEEE Trans. Image Process. 13(4), 600-612, 2004) of volumes.

In 2D, 11x11 Gaussian window of sigma 1.5, zeros beyond the border, averaged over the slices of each axis whose truth is
not empty, then over the axes: as in the published tables of radiative Gaussian splatting.
"""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics.psnr import checked_pair

Array = NDArray[np.float64]

WINDOW, SIGMA = 11, 1.5
K1, K2 = 0.01, 0.03
_VOXELS_PER_BATCH = 1 << 20  # about ten float64 arrays of this size live at once: 80 MB


def ssim(result: ArrayLike, reference: ArrayLike, data_range: float | None = None) -> float:
    """Mean structural similarity, at most 1, of the slices of a volume (z, y, x); those whose truth is zero do not count.

    ``data_range``: L in C1 = (0.01 L)², C2 = (0.03 L)², by default the reference's maximum. Raises InputError for what is
    not 3D, shapes that differ, NaN or infinity, a range that is not positive.
    """
    a, b, peak = checked_pair(result, reference, data_range)
    shape("reference", b, (None, None, None))
    return float(np.mean([_along_axis(a, b, peak, axis) for axis in range(3)]))


def ssim_map(result: ArrayLike, reference: ArrayLike, data_range: float) -> Array:
    """Structural similarity (..., v, u) float64 at every pixel of two stacks of images (..., v, u)."""
    a, b = np.asarray(result, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    mean_a, mean_b = _blur(a), _blur(b)
    both = mean_a * mean_b
    squares = mean_a**2 + mean_b**2
    variances = _blur(a * a) + _blur(b * b) - squares
    covariance = _blur(a * b) - both
    return ((2 * both + c1) * (2 * covariance + c2)) / ((squares + c1) * (variances + c2))


def _along_axis(
    result: NDArray[np.floating], reference: NDArray[np.floating], peak: float, axis: int
) -> float:
    """Mean over the slices across `axis` that are not empty in the reference."""
    a, b = np.moveaxis(result, axis, 0), np.moveaxis(reference, axis, 0)
    full = np.flatnonzero(b.any(axis=(1, 2)))
    if full.size == 0:
        raise InputError("reference", "zeros only", "a volume that is not empty")
    size = max(1, _VOXELS_PER_BATCH // b[0].size)
    batches = (full[i : i + size] for i in range(0, full.size, size))
    total = sum(float(ssim_map(a[batch], b[batch], peak).mean(axis=(1, 2)).sum()) for batch in batches)
    return total / full.size


def _blur(images: Array) -> Array:
    """Gaussian window over the last two axes, zeros outside, normalised once for the whole window."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    weights /= weights.sum()
    rows = scipy.ndimage.correlate1d(images, weights, axis=-2, mode="constant")
    return scipy.ndimage.correlate1d(rows, weights, axis=-1, mode="constant")
