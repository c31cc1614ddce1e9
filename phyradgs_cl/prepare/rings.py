"""Removes rings: a pixel's wrong gain adds the same error to its line integrals in every view.

Over a full turn the mean of all views is the projection of the object averaged around the axis, and symmetric about it. A
difference between a column and its mirror image is therefore an error of the panel. Its covariance between two independent
sets of views tells whether there are rings and how strong they are; without rings the frames stay unchanged.
The pattern comes from the mean over views, which is denoised in overlapping blocks of cosines with the measured strength:
coefficients above the noise belong to the object."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import middle_poses
from phyradgs_cl.detector import robust_deviation
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.bad_pixels import axis_column
from phyradgs_cl.prepare.single_gains import find_single_gains
from phyradgs_cl.prepare.step import Facts, MakeModel, unmasked_frames

_LEAST_FRAMES = 8  # scans of fewer frames stay as they are
_LEAST_PAIRS = 0.25  # fraction of all columns: with fewer pairs, columns are not compared with their mirror images
_LEAST_SHARE = 0.25  # least variance of a pattern over that of the mean's noise: weaker ones are not worth a correction
_NEGLIGIBLE = 1e-4  # standard deviation of a negligible pattern, in line integrals: gains that are 0.01 % off
_SURE = 12.0  # least variance of a pattern over that of the noise, in standard errors of about 1/√pixels
_THRESHOLD = 3.5  # standard deviations of the pattern above which coefficients belong to the object
_SHIFTS = 8  # positions of the blocks along each side, over which the result is averaged
_EQUALLY_FAR = 1.15  # largest over smallest distance of the sources from their mean, on a full turn


@dataclass(frozen=True)
class RingOptions:
    """window: side in pixels of the blocks of cosines; wider patterns are not removed."""

    window: int = 10

    def __post_init__(self) -> None:
        checks.within("rings.window", self.window, 3, 999)


@dataclass(frozen=True)
class Strength:
    """Variances, in line integrals squared, of the pattern, of its part common to a column, and of the noise in the mean of
    all views. least: the variance above which a pattern is certain."""

    pattern: float
    column: float
    noise: float
    least: float

    @property
    def is_certain(self) -> bool:
        return self.pattern > self.least


def ring_strength(frames: np.ndarray, *, axis_column: float | None = None, full_turn: bool = True) -> Strength:
    """Measures the pattern that all views of line integrals (F, v, u) share and no object can cause.

    Its variance is the robust covariance of two sets of views in second differences along rows, taken of the difference
    between mirrored columns. The sets are the even and the odd views; on an arc (``full_turn`` False) its halves, which see
    the object differently. ``axis_column``: the column of the axis, about which columns are mirrored; None: the middle."""
    return _strength(_means(frames, full_turn), axis_column)


def _strength(means: np.ndarray, axis_column: float | None) -> Strength:
    one, other = (_rough(_antisymmetric(mean, axis_column)) for mean in means)
    # the mean of half of the views has twice the variance, and the difference of two such means four times
    noise, rows = robust_deviation(one - other) ** 2 / 4, len(one) // 2
    least = noise * max(_LEAST_SHARE, _SURE / np.sqrt(one.size))
    pattern = _covariance(one, other)
    column = _covariance(one[:rows], other[rows : 2 * rows]) if rows else 0.0
    return Strength(pattern, float(np.clip(column, 0, max(pattern, 0))), noise, max(least, _NEGLIGIBLE**2))


def ring_pattern(
    frames: np.ndarray, *, window: int = 10, axis_column: float | None = None, full_turn: bool = True
) -> np.ndarray:
    """Returns the error (v, u) float32 that the pixels' gains add to line integrals (F, v, u); 0 without a certain pattern.
    window: side of the blocks in pixels. The other arguments are those of ``ring_strength``."""
    strength = ring_strength(frames, axis_column=axis_column, full_turn=full_turn)
    return _pattern(frames, strength, window, axis_column if full_turn else np.inf)


def remove_rings(scan: Scan, options: RingOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan without rings and single wrong gains, unchanged where nothing is certain; and the step's numbers."""
    frames = unmasked_frames(scan)
    if options.window > frames.shape[2]:
        expected = f"no more than the panel's {frames.shape[2]} columns"
        raise InputError("rings.window", str(options.window), expected, "state fewer pixels")
    column, full_turn = axis_column(scan), surround_evenly(scan)
    means, mirrored = _means(frames, full_turn), mirror_columns(frames.shape[2], column)
    usable = np.full(frames.shape[1:], scan.frames >= _LEAST_FRAMES) & (scan.valid.mean(axis=0) > 0.5)
    single = find_single_gains(means, mirrored, usable, full_turn)
    facts: Facts = {"result": "nothing to do"}
    if single.any:
        frames, means = frames - single.offset, means - single.offset
        scan = replace(scan, projections=scan.projections - single.offset)
        facts = {"result": "removed", "single": single.words}
    strength = _strength(means, column)
    facts |= {"spread": float(np.sqrt(max(strength.pattern, 0))), "noise_of_mean": float(np.sqrt(strength.noise))}
    if scan.frames < _LEAST_FRAMES or not strength.is_certain:
        return scan, facts
    pattern = _pattern(frames, strength, options.window, column if full_turn else np.inf)
    facts |= {"result": "removed", "rms_change": float(np.sqrt(np.mean(pattern.astype(np.float64) ** 2)))}
    remaining = find_single_gains(means - pattern, mirrored, usable, full_turn)
    if remaining.any:
        facts["left"] = remaining.words
    return replace(scan, projections=frames - pattern), facts


def surround_evenly(scan: Scan) -> bool:
    """Returns whether the sources of all views lie evenly around a circle, that is equally far from their mean."""
    sources = middle_poses(scan)[:, :3]
    distance = np.linalg.norm(sources - sources.mean(axis=0), axis=1)
    return bool(distance.max() < _EQUALLY_FAR * distance.min())


def _means(frames: np.ndarray, full_turn: bool) -> np.ndarray:
    """Returns the means (2, v, u) of two independent sets of views."""
    half = (len(frames) + 1) // 2
    sets = (frames[::2], frames[1::2]) if full_turn else (frames[:half], frames[half:])
    return np.stack([part.mean(axis=0, dtype=np.float64) for part in sets])


def _pattern(frames: np.ndarray, strength: Strength, window: int, axis_column: float | None) -> np.ndarray:
    """Returns the pattern (v, u) float32 of a given strength. The symmetric and the antisymmetric part of the mean are
    denoised separately; each has half of the pattern's variance."""
    mean = frames.mean(axis=0, dtype=np.float64)
    if not strength.is_certain:
        return np.zeros(mean.shape, np.float32)
    mirrored = mirror_columns(mean.shape[1], axis_column)
    whole = len(mirrored) == mean.shape[1]
    parts = [(mean + mean[:, mirrored]) / 2, (mean - mean[:, mirrored]) / 2] if whole else [mean]
    variances = np.array([strength.pattern - strength.column, strength.column]) / len(parts)
    rough = sum(part - _denoised(part, variances, window) for part in parts)
    # this fraction of what the denoising removed is the pattern, and the rest the noise of the mean
    return np.asarray(rough * strength.pattern / (strength.pattern + strength.noise), np.float32)


def _denoised(image: np.ndarray, variances: np.ndarray, window: int) -> np.ndarray:
    """Removes noise with two ``variances``, of each pixel and common to a column, from an image (v, u). Coefficients of
    overlapping cosine blocks are thresholded first; that result guides a Wiener filter."""
    sigma = np.full((window, window), variances[0])
    # an error common to a column is constant along it: only the first row of coefficients has it
    sigma[0] += window * variances[1]
    sigma = np.sqrt(np.maximum(sigma, 1e-30))
    first = _blockwise(image, image, lambda c: (np.abs(c) > _THRESHOLD * sigma).astype(np.float64), window)
    return _blockwise(image, first, lambda c: c**2 / (c**2 + sigma**2), window)


def _blockwise(
    image: np.ndarray, guide: np.ndarray, share_of: Callable[[np.ndarray], np.ndarray], window: int
) -> np.ndarray:
    """Multiplies the cosine coefficients of overlapping blocks by ``share_of`` the guide's, and averages the blocks. The
    mean value of a block stays. Blocks with fewer coefficients have more weight."""
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
    """Returns coefficients (block v, block u, window, window) of an image (v, u) that whole blocks fill."""
    rows, columns = (n // window for n in image.shape)
    blocks = image.reshape(rows, window, columns, window).swapaxes(1, 2)
    return np.asarray(scipy.fft.dctn(blocks, axes=(2, 3), norm="ortho"))


def _joined(blocks: np.ndarray) -> np.ndarray:
    rows, columns, window, _ = blocks.shape
    return blocks.swapaxes(1, 2).reshape(rows * window, columns * window)


def mirror_columns(columns: int, axis_column: float | None) -> np.ndarray:
    """Returns the columns' mirror images about the axis, where they are on the panel, in descending order."""
    twice = columns - 1 if axis_column is None else 2 * axis_column
    if not abs(twice) < 2 * columns:
        return np.zeros(0, int)
    mirrored = round(twice) - np.arange(columns)
    return mirrored[(mirrored >= 0) & (mirrored < columns)]


def _antisymmetric(mean: np.ndarray, axis_column: float | None) -> np.ndarray:
    """Returns the difference of a mean over views (v, u) from its mirror image, over √2: white noise keeps its variance.
    Where few columns have a mirror image it returns the mean itself."""
    mirrored = mirror_columns(mean.shape[1], axis_column)
    if len(mirrored) < _LEAST_PAIRS * mean.shape[1]:
        return mean
    return (mean[:, mirrored[::-1]] - mean[:, mirrored]) / np.sqrt(2)


def _rough(image: np.ndarray) -> np.ndarray:
    """Returns the second difference along rows, scaled so that white noise keeps its variance."""
    return (2 * image[:, 1:-1] - image[:, :-2] - image[:, 2:]) / np.sqrt(6)


def _covariance(one: np.ndarray, other: np.ndarray) -> float:
    """Returns a covariance that ignores the few pixels at edges (Gnanadesikan and Kettenring, Biometrics 28 (1972) 81)."""
    return (robust_deviation(one + other) ** 2 - robust_deviation(one - other) ** 2) / 4
