"""The warp of a volume and its transpose in float64: the twin of cl/warp.cl."""

from collections.abc import Iterator

import numpy as np

_REACH = 2  # voxels: as far as a sample counts
Volume = np.ndarray


def warp_forward(volume: Volume, displacement: np.ndarray) -> Volume:
    """Returns v(y + w(y)) (nz, ny, nx) by cubic convolution, 0 outside, for w (nz, ny, nx, 3) in voxels, components x, y,
    z."""
    padded = np.pad(np.asarray(volume, np.float64), 2 * _REACH)
    result = np.zeros(volume.shape)
    for place, weight in _taps(displacement):
        result += weight * padded[place]
    return result


def warp_adjoint(values: Volume, displacement: np.ndarray) -> Volume:
    """Returns the transpose of ``warp_forward`` at ``values`` (nz, ny, nx)."""
    border = 2 * _REACH
    padded = np.zeros([n + 2 * border for n in values.shape])
    for place, weight in _taps(displacement):
        np.add.at(padded, place, weight * values)
    return padded[border:-border, border:-border, border:-border]


def _taps(displacement: np.ndarray) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yields indices into the volume with its border, and weights, for the neighbours of each place."""
    shape = displacement.shape[:3]
    places = np.indices(shape) + np.moveaxis(np.asarray(displacement, np.float64), -1, 0)[::-1]
    sides = np.reshape(shape, (3, 1, 1, 1))
    places = np.clip(places, -_REACH, sides - 1 + _REACH)
    first = np.clip(np.floor(places).astype(int) + 1 - _REACH, -_REACH, sides - 1)
    for tap in np.ndindex(*(2 * _REACH,) * 3):
        index = first + np.reshape(tap, (3, 1, 1, 1))
        z, y, x = index + 2 * _REACH
        yield (z, y, x), _weight(np.abs(places - index)).prod(axis=0)


def _weight(distance: np.ndarray) -> np.ndarray:
    near = 1.5 * distance**3 - 2.5 * distance**2 + 1
    far = -0.5 * distance**3 + 2.5 * distance**2 - 4 * distance + 2
    return np.asarray(np.where(distance < 1, near, np.where(distance < 2, far, 0)))
