"""Single columns and pixels whose gain is off: what stands out of the mean over views at one side of the axis alone.

The mean over a full turn is the same at both sides of the axis for every object, and for a round one on an arc. Of a column
or pixel is therefore what its neighbours do not have, nor the mirrored ones, in two independent sets of views.
"""

from dataclasses import dataclass

import numpy as np
import scipy

_NORMAL_MAD = 1.4826
_DEVIATIONS = 8.0  # least distance in robust standard deviations, in both sets
_LEAST = 2e-3  # in line integrals: gains that are 0.2 % off
_NEIGHBOURS = 7  # columns, of whose median a pixel is taken
_NEAR = 21  # columns that say what deviations are usual
_AXIS = 3  # columns at each side of the axis, where an object's edges stand still: left alone
_UNEQUAL = 0.25  # largest difference between the two sets, over their mean, beside two standard deviations
_OBJECT = 0.5  # largest deviation of the mirrored pixel, over that which is found: above it, either side may be at fault


@dataclass(frozen=True)
class SingleGains:
    """offset: (v, u) float32, what gains add to line integrals, 0 elsewhere. columns, pixels: how many were found."""

    offset: np.ndarray
    columns: int = 0
    pixels: int = 0

    @property
    def found(self) -> bool:
        return bool(self.columns or self.pixels)

    @property
    def words(self) -> str:
        """As "1 column, gain off by 3.0 %"."""
        counted = [(self.columns, "column"), (self.pixels, "pixel")]
        names = " and ".join(f"{n} {name}{'s' if n > 1 else ''}" for n, name in counted if n)
        return f"{names}, gain off by {100 * float(np.abs(np.expm1(-self.offset)).max()):.1f} %"


def find_single_gains(
    means: np.ndarray, mirrored: np.ndarray, usable: np.ndarray, full_turn: bool
) -> SingleGains:
    """Single gains by the means (2, v, u) of two sets of views. mirrored: mirror images of the columns that have one (others
    are left alone). usable: (v, u) bool, pixels that are not masked."""
    offset = np.zeros(usable.shape, np.float32)
    if len(mirrored) < _NEAR:
        return SingleGains(offset)
    paired = np.s_[:, mirrored[::-1]]
    usable = usable[paired] & usable[:, mirrored]
    means = means[..., mirrored[::-1]]
    unlike = _apart(means - means[..., ::-1])
    medians = [np.median(of, axis=1, keepdims=True) for of in (_apart(means), unlike)]
    lines = _standing_out(medians[0], medians[1], usable.mean(axis=0, keepdims=True) > 0.5)
    means = means - lines
    pixels = np.zeros(usable.shape)
    if full_turn:  # single pixels on an arc cannot be told from edges of the object
        along, across = _apart(means), _apart(means.swapaxes(1, 2)).swapaxes(1, 2)
        apart = np.where(np.abs(along) < np.abs(across), along, across)
        pixels = _standing_out(apart, _apart(means - means[..., ::-1]), usable)
    offset[paired] = lines + pixels
    return SingleGains(offset, int(np.count_nonzero(lines)), int(np.count_nonzero(pixels)))


def _apart(means: np.ndarray) -> np.ndarray:
    """Means (set, v, u) less the median of their neighbours along the row."""
    return means - scipy.ndimage.median_filter(means, (1, 1, _NEIGHBOURS))


def _standing_out(apart: np.ndarray, unlike: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """(v, u), 0 where nothing stands out. apart: means (set, v, u) less their neighbours'; unlike: the same of what differs
    between mirrored columns."""
    around = (1, 3, 3)
    mirrored = apart[..., ::-1]
    low, high = scipy.ndimage.minimum_filter(mirrored, around), scipy.ndimage.maximum_filter(mirrored, around)
    beyond = apart - np.clip(apart, low, high)
    usual = _NORMAL_MAD * scipy.ndimage.median_filter(np.abs(unlike), (1, 1, _NEAR))
    noise = _NORMAL_MAD * scipy.ndimage.median_filter(np.abs(unlike[0] - unlike[1]), (5, 3 if usable.shape[0] > 1 else 5))
    sigma = np.maximum(usual, noise).max(axis=0)
    offset, size = unlike.mean(axis=0), np.abs(unlike).min(axis=0)
    found = usable & (size > np.maximum(_DEVIATIONS * sigma, _LEAST)) & (unlike[0] * unlike[1] > 0)
    found &= np.abs(unlike[0] - unlike[1]) < _UNEQUAL * np.abs(offset) + 2 * sigma
    found &= (beyond * offset > 0).all(axis=0) & (np.abs(beyond).min(axis=0) > _OBJECT * size)
    found &= np.abs(mirrored).max(axis=0) < _OBJECT * size
    columns = usable.shape[1]
    found &= np.abs(np.arange(columns) - (columns - 1) / 2) > _AXIS
    return np.where(found, offset**3 / np.maximum(offset**2 + sigma**2, 1e-30), 0)
