"""Removes rings: a pixel's wrong gain adds the same error to its line integrals in every view.

Over a full turn, the mean of all views shows the object averaged around the axis, which is symmetric about it. So a column
that differs from its mirror image shows an error of the panel. Two independent sets of views both show this error: their
covariance says whether there are rings, and how strong. Without rings the frames stay unchanged. The pattern is the mean
over views minus its denoised copy, which keeps the strong cosine coefficients of overlapping blocks, because these belong to
the object.

A single column or pixel of wrong gain deviates on one side of the axis only. Its neighbours and their mirror images do not,
and both sets of views show it. (On an arc the mean is symmetric for a round object only.)"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import middle_poses
from phyradgs_cl.detector import robust_deviation
from phyradgs_cl.detector.noise_level import NORMAL_MAD
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.bad_pixels import axis_column
from phyradgs_cl.prepare.step import Facts, MakeModel, StepOptions, unmasked_frames

_LEAST_FRAMES = 8  # fewer views do not average the object enough to show rings: such scans stay unchanged
_LEAST_PAIRS = 0.25  # columns are compared with their mirror images if at least this fraction of them has one on the panel
_LEAST_SHARE = 0.25  # a pattern whose variance is below this fraction of the variance of the mean's noise is not corrected
_NEGLIGIBLE = 1e-4  # a pattern with a smaller standard deviation in line integrals is invisible: gains off by 0.01 %
_SURE = 12.0  # a pattern is certain if its variance exceeds (this / √pixels) times the noise's: 12 standard errors
_THRESHOLD = 3.5  # cosine coefficients above this many standard deviations of the pattern belong to the object
_SHIFTS = 8  # positions of the blocks along each side, over which the result is averaged so that no block edges show
_DEVIATIONS = 8.0  # a gain is wrong if it is off by more than this many robust standard deviations in both sets of views
_LEAST = 2e-3  # a gain that is off by less than this, 0.2 %, is left alone
_NEIGHBOURS = 7  # deviations are measured from the median of this many columns
_NEAR = 21  # the usual deviation near a pixel is the median over this many columns
_AXIS = 3  # near the axis an object's edges stay in one column, like rings: this many columns on each side are left alone
_UNEQUAL = 0.25  # a wrong gain's value in the two sets of views may differ by this fraction of it plus 2 standard deviations
_OBJECT = 0.5  # a pixel whose mirror image deviates by more than this fraction of its own deviation is left alone
_EQUALLY_FAR = 1.15  # in a full turn, (largest distance / smallest distance) of the sources from their mean is below this


@dataclass(frozen=True)
class RingOptions(StepOptions, step="rings"):
    """Options of the step ``rings``. window: side in pixels of the blocks of cosines. Patterns wider than a block stay."""

    window: int = checks.ranged(10, 3, 999)


class Strength(NamedTuple):
    """Three variances, in line integrals squared: of the pattern, of its part that whole columns share, and of the noise in
    the mean of all views. least: the variance above which a pattern is certain."""

    pattern: float
    column: float
    noise: float
    least: float


def _strength(means: np.ndarray, axis_column: float) -> Strength:
    """Measures the pattern that all views share and no object can cause, from the means (2, v, u) of two sets of views.

    Subtracting its mirror image from each column cancels the object, if at least a quarter of the columns have one. Second
    differences along rows remove the rest of it. The covariance of both sets is the pattern's variance. The factors √2 and
    √6 keep the variance of white noise."""
    mirrored = mirror_columns(means.shape[2], axis_column)
    if len(mirrored) >= _LEAST_PAIRS * means.shape[2]:
        means = (means[..., mirrored[::-1]] - means[..., mirrored]) / np.sqrt(2)
    one, other = (2 * means[..., 1:-1] - means[..., :-2] - means[..., 2:]) / np.sqrt(6)
    # a mean over half the views has twice the noise variance of that over all, and the difference of two such means four
    # times
    noise, rows = robust_deviation(one - other) ** 2 / 4, len(one) // 2
    least = noise * max(_LEAST_SHARE, _SURE / np.sqrt(one.size))
    pattern = _covariance(one, other)
    column = _covariance(one[:rows], other[rows : 2 * rows]) if rows else 0.0
    return Strength(pattern, float(np.clip(column, 0, max(pattern, 0))), noise, max(least, _NEGLIGIBLE**2))


def remove_rings(scan: Scan, options: RingOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan without rings and single wrong gains, or unchanged if no error is certain; and the step's numbers."""
    frames = unmasked_frames(scan)
    if options.window > frames.shape[2]:
        expected = f"no more than the panel's {frames.shape[2]} columns"
        raise InputError("rings.window", str(options.window), expected, "state fewer pixels")
    column, sources = axis_column(scan), middle_poses(scan)[:, :3]
    distance = np.linalg.norm(sources - sources.mean(axis=0), axis=1)
    full_turn = bool(distance.max() < _EQUALLY_FAR * distance.min())  # the sources lie on a full circle around their mean
    means, mirrored = _means(frames, full_turn), mirror_columns(frames.shape[2], column)
    usable = np.full(frames.shape[1:], scan.frames >= _LEAST_FRAMES) & (scan.valid.mean(axis=0) > 0.5)
    offset, words = find_single_gains(means, mirrored, usable, full_turn)
    facts: Facts = {"result": "nothing to do"}
    if words:
        frames, means = frames - offset, means - offset
        scan = replace(scan, projections=scan.projections - offset)
        facts = {"result": "removed", "single": words}
    strength = _strength(means, column)
    facts |= {"spread": float(np.sqrt(max(strength.pattern, 0))), "noise_of_mean": float(np.sqrt(strength.noise))}
    if scan.frames < _LEAST_FRAMES or strength.pattern <= strength.least:
        return scan, facts
    pattern = _pattern(frames, strength, options.window, column if full_turn else np.inf)
    facts |= {"result": "removed", "rms_change": float(np.sqrt(np.mean(pattern.astype(np.float64) ** 2)))}
    if left := find_single_gains(means - pattern, mirrored, usable, full_turn)[1]:
        facts["left"] = left
    return replace(scan, projections=frames - pattern), facts


def _means(frames: np.ndarray, full_turn: bool) -> np.ndarray:
    """Returns the means (2, v, u) of two independent sets of views: even and odd ones or, on an arc, the first and the
    second half, in which the object looks different."""
    half = (len(frames) + 1) // 2
    sets = (frames[::2], frames[1::2]) if full_turn else (frames[:half], frames[half:])
    return np.stack([part.mean(axis=0, dtype=np.float64) for part in sets])


def _pattern(frames: np.ndarray, strength: Strength, window: int, axis_column: float | None) -> np.ndarray:
    """Returns the pattern (v, u) float32. If all columns have a mirror image, the symmetric and the antisymmetric part of
    the mean over views hold half of the pattern's variance each, and are denoised separately."""
    mean = frames.mean(axis=0, dtype=np.float64)
    mirrored = mirror_columns(mean.shape[1], axis_column)
    whole = len(mirrored) == mean.shape[1]
    parts = [(mean + mean[:, mirrored]) / 2, (mean - mean[:, mirrored]) / 2] if whole else [mean]
    variances = np.array([strength.pattern - strength.column, strength.column]) / len(parts)
    rough = sum(part - _denoised(part, variances, window) for part in parts)
    # Denoising removes the pattern together with the noise of the mean: only this fraction of the sum is the pattern.
    return np.asarray(rough * strength.pattern / (strength.pattern + strength.noise), np.float32)


def _denoised(image: np.ndarray, variances: np.ndarray, window: int) -> np.ndarray:
    """Denoises an image (v, u): thresholds the coefficients of overlapping cosine blocks of side ``window``, then guides a
    Wiener filter by the result. variances (2,): that of each pixel's own noise, and that of the noise that a whole column
    shares."""
    sigma = np.full((window, window), variances[0])
    # an error that a column shares is constant along it, so only the first row of coefficients has it
    sigma[0] += window * variances[1]
    sigma = np.sqrt(np.maximum(sigma, 1e-30))
    first = _blockwise(image, image, lambda c: (np.abs(c) > _THRESHOLD * sigma).astype(np.float64), window)
    return _blockwise(image, first, lambda c: c**2 / (c**2 + sigma**2), window)


def _blockwise(
    image: np.ndarray, guide: np.ndarray, share_of: Callable[[np.ndarray], np.ndarray], window: int
) -> np.ndarray:
    """Multiplies the cosine coefficients of overlapping blocks of ``image`` by ``share_of``(coefficients of ``guide``), and
    averages blocks where they overlap. Each block keeps its mean value. A block with fewer coefficients left has less noise
    and weighs more."""
    width = [(window, window + (-n) % window) for n in image.shape]
    padded, guiding = (np.pad(part, width, mode="symmetric") for part in (image, guide))
    total, weight = np.zeros_like(padded), np.zeros_like(padded)
    rows, columns = (n - window for n in padded.shape)
    starts = range(0, window, max(1, window // _SHIFTS))
    for v in starts:
        for u in starts:
            where = np.s_[v : v + rows, u : u + columns]
            coefficients, guides = (_cosines(part[where], window) for part in (padded, guiding))
            share = share_of(guides)
            share[..., 0, 0] = 1
            certain = 1 / (share**2).sum(axis=(2, 3), keepdims=True)
            block = scipy.fft.idctn(share * coefficients, axes=(2, 3), norm="ortho") * certain
            total[where] += _joined(block)
            weight[where] += _joined(np.broadcast_to(certain, block.shape))
    inside = np.s_[window : window + image.shape[0], window : window + image.shape[1]]
    return total[inside] / weight[inside]


def _cosines(image: np.ndarray, window: int) -> np.ndarray:
    """Returns cosine coefficients (block v, block u, window, window) of an image (v, u) that whole blocks fill."""
    rows, columns = (n // window for n in image.shape)
    blocks = image.reshape(rows, window, columns, window).swapaxes(1, 2)
    return np.asarray(scipy.fft.dctn(blocks, axes=(2, 3), norm="ortho"))


def _joined(blocks: np.ndarray) -> np.ndarray:
    rows, columns, window, _ = blocks.shape
    return blocks.swapaxes(1, 2).reshape(rows * window, columns * window)


def mirror_columns(columns: int, axis_column: float | None) -> np.ndarray:
    """Returns each column's mirror image about the axis, in descending order. Images that lie off the panel are left out.
    ``axis_column`` None: the axis is in the panel's middle."""
    twice = columns - 1 if axis_column is None else 2 * axis_column
    if not abs(twice) < 2 * columns:
        return np.zeros(0, int)
    mirrored = round(twice) - np.arange(columns)
    return mirrored[(mirrored >= 0) & (mirrored < columns)]


def _covariance(one: np.ndarray, other: np.ndarray) -> float:
    """Returns a robust covariance: few edge pixels hardly change it (Gnanadesikan and Kettenring, Biometrics 1972)."""
    return (robust_deviation(one + other) ** 2 - robust_deviation(one - other) ** 2) / 4


def find_single_gains(
    means: np.ndarray, mirrored: np.ndarray, usable: np.ndarray, full_turn: bool
) -> tuple[np.ndarray, str]:
    """Finds wrong gains of single columns and pixels in the means (2, v, u) of two sets of views. Returns the error (v, u)
    float32 that they add to line integrals, 0 elsewhere, and words, as "1 column, gain off by 3.0 %"; "" without any.

    mirrored: the columns' mirror images, from ``mirror_columns``; columns without a mirror image are left alone. usable:
    bool (v, u), False for masked pixels. full_turn: finds wrong pixels too; on an arc an edge of the object looks like
    one."""
    offset = np.zeros(usable.shape, np.float32)
    if len(mirrored) < _NEAR:
        return offset, ""
    paired = np.s_[:, mirrored[::-1]]
    usable = usable[paired] & usable[:, mirrored]
    if not full_turn:  # the median over neighbours is one-sided at the ends, where the mean of an arc may slope
        usable[:, [0, -1]] = False
    means = means[..., mirrored[::-1]]
    medians = [np.median(_deviation(m), axis=1, keepdims=True) for m in (means, means - means[..., ::-1])]
    lines = _outliers(medians[0], medians[1], usable.mean(axis=0, keepdims=True) > 0.5)
    means = means - lines
    pixels = np.zeros(usable.shape)
    if full_turn:  # on an arc, a single wrong pixel looks like an edge of the object
        along, across = _deviation(means), _deviation(means.swapaxes(1, 2)).swapaxes(1, 2)
        deviation = np.where(np.abs(along) < np.abs(across), along, across)
        pixels = _outliers(deviation, _deviation(means - means[..., ::-1]), usable)
    offset[paired] = lines + pixels
    counted = (np.count_nonzero(lines), "column"), (np.count_nonzero(pixels), "pixel")
    names = " and ".join(f"{n} {name}{'s' if n > 1 else ''}" for n, name in counted if n)
    return offset, names and f"{names}, gain off by {100 * float(np.abs(np.expm1(-offset)).max()):.1f} %"


def _deviation(means: np.ndarray) -> np.ndarray:
    """Returns means (set, v, u) minus their median over neighbours along the row."""
    return means - scipy.ndimage.median_filter(means, (1, 1, _NEIGHBOURS))


def _outliers(deviation: np.ndarray, unlike: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Returns the errors (v, u) of outliers, 0 elsewhere. deviation: ``_deviation`` (set, v, u) of the means. unlike:
    ``_deviation`` of the means minus their mirror images, which cancels the object. usable: pixels that may be outliers."""
    around = (1, 3, 3)
    mirrored = deviation[..., ::-1]
    low, high = scipy.ndimage.minimum_filter(mirrored, around), scipy.ndimage.maximum_filter(mirrored, around)
    beyond = deviation - np.clip(deviation, low, high)
    usual = NORMAL_MAD * scipy.ndimage.median_filter(np.abs(unlike), (1, 1, _NEAR))
    noise = NORMAL_MAD * scipy.ndimage.median_filter(np.abs(unlike[0] - unlike[1]), (5, 3 if usable.shape[0] > 1 else 5))
    sigma = np.maximum(usual, noise).max(axis=0)
    offset, size = unlike.mean(axis=0), np.abs(unlike).min(axis=0)
    is_outlier = usable & (size > np.maximum(_DEVIATIONS * sigma, _LEAST)) & (unlike[0] * unlike[1] > 0)
    is_outlier &= np.abs(unlike[0] - unlike[1]) < _UNEQUAL * np.abs(offset) + 2 * sigma
    is_outlier &= (beyond * offset > 0).all(axis=0) & (np.abs(beyond).min(axis=0) > _OBJECT * size)
    is_outlier &= np.abs(mirrored).max(axis=0) < _OBJECT * size
    columns = usable.shape[1]
    is_outlier &= np.abs(np.arange(columns) - (columns - 1) / 2) > _AXIS
    return np.where(is_outlier, offset**3 / np.maximum(offset**2 + sigma**2, 1e-30), 0)
