"""How noisy line integrals are, estimated from themselves, and how far each can be trusted."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Median of |x| over the standard deviation of a normal x, and the norm of the filter (-1/2, 1, -1/2).
_MEDIAN_OF_NORMAL, _FILTER_NORM = 0.6745, 1.5**0.5
_LARGEST_SAMPLE = 1_000_000
_TENTHS = 10
_BEHIND = 5.0  # times the noise: what is larger has met the object
_FRAMES = 16  # that tell the noise


def noise_level(line_integrals: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> float:
    """Standard deviation of the noise of a pixel behind the object, dimensionless.

    From the median of |second differences| along rows where values are above 0: structure is smooth beside white noise, and
    a median does not mind edges (Donoho and Johnstone, Biometrika 81 (1994) 425). Structure as fine as a pixel raises it,
    noise correlated along rows lowers it. line_integrals (F, v, u); valid likewise, None: all. 0 where nothing can be told.
    """
    if line_integrals.shape[-1] < 3:
        return 0.0
    left, middle, right = line_integrals[..., :-2], line_integrals[..., 1:-1], line_integrals[..., 2:]
    usable = middle > 0
    if valid is not None:
        usable = usable & valid[..., :-2] & valid[..., 1:-1] & valid[..., 2:]
    chosen = np.flatnonzero(usable)
    chosen = chosen[:: max(1, chosen.size // _LARGEST_SAMPLE)]
    if chosen.size == 0:
        return 0.0
    second = middle.ravel()[chosen] - 0.5 * (left.ravel()[chosen] + right.ravel()[chosen])
    return float(np.median(np.abs(second))) / (_MEDIAN_OF_NORMAL * _FILTER_NORM)


def noise_rms(line_integrals: NDArray[np.float32], chosen: NDArray[np.bool_], valid: NDArray[np.bool_]) -> float:
    """Root mean square of the noise of the pixels ``chosen`` (F, v, u), dimensionless; ``valid`` likewise.

    Noise grows with what a ray loses: it is estimated by tenths of the line integrals, and taken where the pixels lie. From
    the median of |second differences along rows of those along columns|, which no straight edge along either survives
    (Immerkær, Comput. Vis. Image Underst. 64 (1996) 300); of a panel of fewer than three rows along rows alone.
    """
    usable, differences, means = valid, line_integrals, line_integrals
    cuts = (_along_rows, _along_columns) if line_integrals.shape[-2] >= 3 else (_along_rows,)
    for cut in cuts:
        left, middle, right = cut(differences)
        differences = middle - 0.5 * (left + right)
        means = np.mean(cut(means), axis=0, dtype=np.float32)
        usable = np.logical_and.reduce(cut(usable))
    mean, size = means[usable], np.abs(differences[usable])
    if mean.size == 0 or not chosen.any():
        return 0.0
    edges = np.quantile(mean, np.linspace(0, 1, _TENTHS + 1)[1:-1])
    tenth = np.digitize(mean, edges)
    levels = np.array([np.median(size[tenth == k]) if (tenth == k).any() else 0.0 for k in range(_TENTHS)])
    share = np.bincount(np.digitize(line_integrals[chosen], edges), minlength=_TENTHS) / chosen.sum()
    return float(np.sqrt(share @ levels**2)) / (_MEDIAN_OF_NORMAL * _FILTER_NORM ** len(cuts))


def noise_behind(line_integrals: NDArray[np.float32], valid: NDArray[np.bool_]) -> float:
    """``noise_rms`` behind the object, from some of the frames: beside it there is less, and half of that is clipped at 0
    in some files. line_integrals and valid (F, v, u)."""
    some = slice(None, None, max(1, len(line_integrals) // _FRAMES))
    frames, usable = line_integrals[some], valid[some]
    behind = usable & (frames > _BEHIND * noise_level(frames, usable))
    return noise_rms(frames, behind, behind)


def _along_rows(frames: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    return frames[..., :-2], frames[..., 1:-1], frames[..., 2:]


def _along_columns(frames: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    return frames[..., :-2, :], frames[..., 1:-1, :], frames[..., 2:, :]


def transmission_weights(
    line_integrals: NDArray[np.float32], valid: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Weights exp(−p) of a scan's pixels p (F, v, u), scaled to the mean 1 over those that are ``valid`` (None: all).

    Those of least squares for photon noise (Sauer and Bouman, IEEE Trans. Signal Process. 41 (1993) 534). What lies below 0
    counts as air: noise should not be trusted more for being bright.
    """
    weights = np.exp(-np.maximum(line_integrals, 0)).astype(np.float32)
    if valid is None:
        mean = float(weights.mean(dtype=np.float64))
    else:
        chosen = np.broadcast_to(valid, weights.shape)
        mean = float(weights.mean(dtype=np.float64, where=chosen)) if chosen.any() else 1.0
    return weights / np.float32(mean) if mean > 0 else np.ones_like(weights)
