"""Finds single columns and pixels with a wrong gain: outliers of the mean over views on one side of the axis only.

The mean over a full turn is symmetric about the axis for every object, on an arc for a round one. A wrong gain therefore
shows as a deviation that neither its neighbours nor their mirror images have, in two independent sets of views."""

from dataclasses import dataclass

import numpy as np
import scipy

from phyradgs_cl.detector.noise_level import NORMAL_MAD

_DEVIATIONS = 8.0  # least deviation in robust standard deviations, in both sets of views
_LEAST = 2e-3  # least deviation in line integrals: a gain that is 0.2 % off
_NEIGHBOURS = 7  # width in columns of the median from which deviations are measured
_NEAR = 21  # width in columns of the neighbourhood that gives the usual deviation
_AXIS = 3  # columns at each side of the axis that are never changed, because an object's edges stand still there
_UNEQUAL = 0.25  # largest difference between the two sets, relative to their mean, plus two standard deviations
_OBJECT = 0.5  # largest deviation of the mirrored pixel, relative to the pixel's own: above it either may be wrong


@dataclass(frozen=True)
class SingleGains:
    """offset: the error (v, u) float32 that wrong gains add to line integrals, 0 elsewhere. columns, pixels: the numbers of
    columns and of single pixels with one."""

    offset: np.ndarray
    columns: int = 0
    pixels: int = 0

    @property
    def any(self) -> bool:
        return bool(self.columns or self.pixels)

    @property
    def words(self) -> str:
        """The numbers in words, as "1 column, gain off by 3.0 %"."""
        counted = [(self.columns, "column"), (self.pixels, "pixel")]
        names = " and ".join(f"{n} {name}{'s' if n > 1 else ''}" for n, name in counted if n)
        return f"{names}, gain off by {100 * float(np.abs(np.expm1(-self.offset)).max()):.1f} %"


def find_single_gains(
    means: np.ndarray, mirrored: np.ndarray, usable: np.ndarray, full_turn: bool
) -> SingleGains:
    """Finds single wrong gains in the means (2, v, u) of two sets of views. mirrored: the columns' mirror images, as of
    ``mirror_columns``; columns without one stay. usable: bool (v, u), False for masked pixels."""
    offset = np.zeros(usable.shape, np.float32)
    if len(mirrored) < _NEAR:
        return SingleGains(offset)
    paired = np.s_[:, mirrored[::-1]]
    usable = usable[paired] & usable[:, mirrored]
    means = means[..., mirrored[::-1]]
    medians = [np.median(_deviation(m), axis=1, keepdims=True) for m in (means, means - means[..., ::-1])]
    lines = _outliers(medians[0], medians[1], usable.mean(axis=0, keepdims=True) > 0.5)
    means = means - lines
    pixels = np.zeros(usable.shape)
    if full_turn:  # single pixels on an arc cannot be told from edges of the object
        along, across = _deviation(means), _deviation(means.swapaxes(1, 2)).swapaxes(1, 2)
        deviation = np.where(np.abs(along) < np.abs(across), along, across)
        pixels = _outliers(deviation, _deviation(means - means[..., ::-1]), usable)
    offset[paired] = lines + pixels
    return SingleGains(offset, int(np.count_nonzero(lines)), int(np.count_nonzero(pixels)))


def _deviation(means: np.ndarray) -> np.ndarray:
    """Returns means (set, v, u) minus the median of their neighbours along the row."""
    return means - scipy.ndimage.median_filter(means, (1, 1, _NEIGHBOURS))


def _outliers(deviation: np.ndarray, unlike: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Returns the errors (v, u) of outliers, 0 elsewhere. deviation: ``_deviation`` (set, v, u) of the means. unlike: that
    of the means minus their mirror images."""
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
