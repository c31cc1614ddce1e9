"""Estimates from the frames: their noise, statistical weights, and saturation of raw counts."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl.acquisition import Saturation
from phyradgs_cl.checks import ceil_div

NORMAL_MAD = 1.4826  # standard deviation / median absolute deviation of a normal variable
_MEDIAN_OF_NORMAL = 0.6745  # median of |x| / standard deviation of x, for a normal variable x with mean 0
_FILTER_NORM = 1.5**0.5  # factor by which the filter (-1/2, 1, -1/2) multiplies the standard deviation of white noise
_LARGEST_SAMPLE = 1_000_000  # about the most pixels of which a median is computed: their median is exact enough
_TENTHS = 10  # number of equally large classes of line integrals whose noise is estimated apart: it grows with attenuation
_BEHIND = 5.0  # pixels lie behind the object if (line integral) / (noise) exceeds this
_FRAMES = 16  # noise is estimated from about this many frames, evenly spread, to save time

LEAST_SHARE = 1e-3
"""Saturation is suspected if a larger fraction of the pixels has one extreme value."""
_TOUCHING = 0.5  # saturation covers areas: pixels at an extreme are clipped if most of them have four neighbours at it
_SAME = 1e-3  # flats within this fraction of the largest count are as bright as it: pixels clipped there may be air
_MOST_FRAMES = 8  # noise outside saturated pixels is sought in at most this many frames
_LONGEST_EDGE = 1024  # of larger frames only the middle, this many pixels a side, is searched for noise
_ROUNDING = 0.5  # largest noise, in counts, that is estimated from rounded counts without noise
_RELATIVE = 2e-5  # an estimate shows noise only if (estimated noise) / (largest count) exceeds this
# Frames show noise if (estimate along both axes) / (estimate along rows alone) exceeds this. Structure gives less.
_WHITE = 0.5
_ROOT_OF_NORMAL = 0.8222  # mean of √|x| / √(standard deviation of x), for a normal variable x with mean 0
_NOISY_AIR = 0.45  # air has no noise if fewer than this share of pixels are not 0: in clipped noise half of them are not
_NEAR = 9  # the noise of a pixel is estimated from a square of this side around it


def robust_deviation(values: np.ndarray) -> float:
    """Returns the standard deviation of values (any shape) by their median absolute deviation: outliers hardly count."""
    return NORMAL_MAD * float(np.median(np.abs(values - np.median(values))))


def noise_level(line_integrals: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> float:
    """Returns the standard deviation of a pixel's noise behind the object, dimensionless. Without usable pixels it is 0.

    It comes from the median of |second differences| along rows, where line integrals (F, v, u) are above 0. An object is
    smooth compared with white noise, and a median ignores edges (Donoho and Johnstone, Biometrika 81 (1994) 425). Detail as
    fine as a pixel raises the estimate; noise correlated along rows lowers it. valid (F, v, u): pixels to use; None: all."""
    if line_integrals.shape[-1] < 3:
        return 0.0
    left, middle, right = _threes(line_integrals, -1)
    usable = np.ones(middle.shape, bool) if valid is None else np.logical_and.reduce(_threes(valid, -1))
    if not usable.any():
        return 0.0
    if np.count_nonzero(middle[usable]) < _NOISY_AIR * np.count_nonzero(usable):
        frames = _some(line_integrals)
        return _rms_above(0.0, frames, np.ones(frames.shape, bool) if valid is None else _some(valid))
    # Zeros may be clipped noise. Pixels from the median on count too: those above 0 may be edges of small bodies alone.
    usable &= (middle > 0) | (middle >= np.median(middle[usable], overwrite_input=True))
    pixels = np.flatnonzero(usable)
    pixels = pixels[:: max(1, pixels.size // _LARGEST_SAMPLE)]
    second = middle.ravel()[pixels] - 0.5 * (left.ravel()[pixels] + right.ravel()[pixels])
    return float(np.median(np.abs(second))) / (_MEDIAN_OF_NORMAL * _FILTER_NORM)


def noise_rms(line_integrals: NDArray[np.float32], chosen: NDArray[np.bool_], valid: NDArray[np.bool_]) -> float:
    """Returns the root mean square of the noise of the pixels ``chosen``, dimensionless. chosen, valid: bool (F, v, u).

    Noise grows with attenuation. So it is estimated in each tenth of the ``valid`` line integrals (F, v, u), and averaged by
    how many chosen pixels lie in each. An estimate is the median of |second differences along rows and then along columns|,
    which vanish at edges along either (Immerkær, Comput. Vis. Image Underst. 64 (1996) 300). Detail as fine as a pixel
    raises the estimate, by up to 70 % on panels of 64² with noise of 0.5 %. On panels of fewer than three rows, differences
    are along rows alone."""
    usable, differences = valid, line_integrals
    means = line_integrals
    axes = (-1, -2) if line_integrals.shape[-2] >= 3 else (-1,)
    for axis in axes:
        left, middle, right = _threes(differences, axis)
        differences = middle - 0.5 * (left + right)
        means = np.mean(_threes(means, axis), axis=0, dtype=np.float32)
        usable = np.logical_and.reduce(_threes(usable, axis))
    mean, size = means[usable], np.abs(differences[usable])
    if mean.size == 0 or not chosen.any():
        return 0.0
    edges = np.quantile(mean, np.linspace(0, 1, _TENTHS + 1)[1:-1])
    tenth = np.digitize(mean, edges)
    levels = np.array([np.median(size[tenth == k]) if (tenth == k).any() else 0.0 for k in range(_TENTHS)])
    share = np.bincount(np.digitize(line_integrals[chosen], edges), minlength=_TENTHS) / chosen.sum()
    return float(np.sqrt(share @ levels**2)) / (_MEDIAN_OF_NORMAL * _FILTER_NORM ** len(axes))


def noise_map(residual: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Returns the standard deviation of each pixel's noise (v, u), from the 9 × 9 pixels of a residual (v, u) around it.

    It comes from the mean of √|second differences along rows and then along columns|. The differences vanish for smooth
    structure, which is no noise even if the volume does not explain it. The roots give edges little weight. An axis shorter
    than three pixels is left out. Without ``valid`` (v, u) pixels nearby the noise is 0."""
    differences, usable, axes = residual.astype(np.float64), valid, [axis for axis in (0, 1) if residual.shape[axis] >= 3]
    for axis in axes:
        differences = scipy.ndimage.correlate1d(differences, (-0.5, 1, -0.5), axis, mode="mirror")
        usable = scipy.ndimage.binary_erosion(usable, np.ones((3, 1) if axis == 0 else (1, 3)), border_value=1)
    roots = np.where(usable, np.abs(differences) ** 0.5, 0.0)
    mean, share = (scipy.ndimage.uniform_filter(values, _NEAR) for values in (roots, usable.astype(np.float64)))
    return ((mean / np.maximum(share, 1e-9) / _ROOT_OF_NORMAL) ** 2 / _FILTER_NORM ** len(axes)).astype(np.float32)


def noise_behind(line_integrals: NDArray[np.float32], valid: NDArray[np.bool_]) -> float:
    """Returns the root mean square of the noise behind the object, dimensionless, from some frames. line_integrals, valid:
    (F, v, u).

    Air is left out: its noise is lower, and in some files clipped at 0."""
    frames, usable = _some(line_integrals), _some(valid)
    return _rms_above(_BEHIND * noise_level(frames, usable), frames, usable)


def _some(frames: NDArray[Any]) -> NDArray[Any]:
    return frames[:: max(1, len(frames) // _FRAMES)]


def _rms_above(least: float, frames: NDArray[np.float32], valid: NDArray[np.bool_]) -> float:
    """Returns the root mean square of the noise of the ``valid`` pixels (F, v, u) above ``least``, without air. Where most
    of them lie at edges of small bodies, a median takes edges for noise: then it is at most the estimate with air."""
    behind = valid & (frames > least)
    inner = scipy.ndimage.binary_erosion(behind, np.ones((1, 3, 3)), border_value=1)
    has_edges = 2 * np.count_nonzero(inner) < np.count_nonzero(behind)
    return min(noise_rms(frames, behind, usable) for usable in ((behind, valid) if has_edges else (behind,)))


def _threes(frames: NDArray[Any], axis: int) -> tuple[NDArray[Any], ...]:
    """Returns views of the pixels before, at and behind each inner pixel along an axis."""
    lines = np.moveaxis(frames, axis, 0)
    return tuple(np.moveaxis(part, 0, axis) for part in (lines[:-2], lines[1:-1], lines[2:]))


def transmission_weights(
    line_integrals: NDArray[np.float32], valid: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Returns weights exp(−p) of line integrals p (F, v, u), with mean 1 over the ``valid`` pixels (None: all).

    They are the least-squares weights of photon noise (Sauer and Bouman, IEEE Trans. Signal Process. 41 (1993) 534).
    Negative line integrals count as 0: a pixel that is bright by chance is not more precise than air."""
    weights = np.exp(-np.maximum(line_integrals, 0)).astype(np.float32)
    if valid is None:
        mean = float(weights.mean(dtype=np.float64))
    else:
        usable = np.broadcast_to(valid, weights.shape)
        mean = float(weights.mean(dtype=np.float64, where=usable)) if usable.any() else 1.0
    return weights / np.float32(mean) if mean > 0 else np.ones_like(weights)


def find_saturation(frames: NDArray[np.generic], flat: NDArray[np.floating]) -> Saturation:
    """Returns the largest count of projections (P, v, u), and the fraction of their pixels that are clipped at it.

    Only whole areas count as clipped. An area as bright as the mean ``flat`` (v, u), or at a level that is no whole number,
    may be air without noise: it counts only if the other pixels of the frames are noisy."""
    level = float(np.fmax.reduce([np.fmax.reduce(frame, axis=None) for frame in frames]))
    share = clustered_share(frame == level for frame in frames)
    is_other = level.is_integer() and _flat_differs(frames, flat, level)
    if share <= LEAST_SHARE or not (is_other or _shows_noise(frames, level)):
        share = 0.0
    return Saturation(level, share)


def clustered_share(extreme: Iterable[NDArray[np.bool_]]) -> float:
    """Returns the fraction of pixels at an extreme value, given frame by frame as bool (v, u). It is 0 unless most of them
    have four neighbours at that value too: saturation covers areas, clipped noise hits single pixels."""
    pixels = count = inner = touching = 0
    for at in extreme:
        pixels, count = pixels + at.size, count + int(np.count_nonzero(at))
        if at.any():
            inner += int(np.count_nonzero(at[1:-1, 1:-1]))
            touching += int(np.count_nonzero(scipy.ndimage.binary_erosion(at)))  # beyond the panel there are no neighbours
    return count / pixels if inner and touching / inner > _TOUCHING else 0.0


def _flat_differs(frames: NDArray[np.generic], flat: NDArray[np.floating], level: float) -> bool:
    """Returns whether the clipped pixels differ in brightness from the same pixels of the flats, so they are not air."""
    hit = np.zeros(frames.shape[1:], bool)
    for frame in frames:
        hit |= frame == level
    return bool(np.median(np.abs(flat[hit] - level)) > _SAME * abs(level))


def _shows_noise(frames: NDArray[np.generic], level: float) -> bool:
    """Returns whether unclipped pixels are noisy, by their second differences along both axes. The noise that these give
    must exceed the error of rounding, and half of the noise by differences along rows alone: structure gives less."""
    along_rows, along_both = [], []
    top, left = (max(0, n - _LONGEST_EDGE) // 2 for n in frames.shape[1:])
    middle = np.s_[top : top + _LONGEST_EDGE, left : left + _LONGEST_EDGE]
    for frame in frames[:: ceil_div(len(frames), _MOST_FRAMES)]:
        values = np.where(frame[middle] < level, frame[middle], np.nan).astype(np.float64)
        along_rows.append(np.diff(values, 2, axis=1)[1:-1].ravel())
        along_both.append(np.diff(np.diff(values, 2, axis=1), 2, axis=0).ravel())
    rows, both = np.concatenate(along_rows), np.concatenate(along_both)
    unclipped = np.isfinite(both)
    if not unclipped.any():
        return True  # all pixels are clipped or next to clipped ones, so none can tell
    in_rows, in_both = (float(np.median(np.abs(d[unclipped]))) / norm for d, norm in ((rows, 6**0.5), (both, 6.0)))
    return in_both > max(_ROUNDING, _RELATIVE * level, _WHITE * in_rows)
