"""The warp of a volume and its transpose in float64: the twin of cl/warp.cl."""

from collections.abc import Iterator

import numpy as np

Volume = np.ndarray


def warp_forward(volume: Volume, displacement: np.ndarray, reach: int = 1) -> Volume:
    """Returns v(y + w(y)) (nz, ny, nx), 0 outside, for w (nz, ny, nx, 3) in voxels, components x, y, z: trilinear, or by
    cubic convolution for a ``reach`` of 2."""
    padded = np.pad(np.asarray(volume, np.float64), 2 * reach)
    result = np.zeros(volume.shape)
    for place, weight in _taps(displacement, reach):
        result += weight * padded[place]
    return result


def warp_adjoint(values: Volume, displacement: np.ndarray, reach: int = 1) -> Volume:
    """Returns the transpose of ``warp_forward`` at ``values`` (nz, ny, nx)."""
    border = 2 * reach
    padded = np.zeros([n + 2 * border for n in values.shape])
    for place, weight in _taps(displacement, reach):
        np.add.at(padded, place, weight * values)
    return padded[border:-border, border:-border, border:-border]


def _taps(displacement: np.ndarray, reach: int) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yields indices into the volume with its border, and weights, for the neighbours of each place."""
    shape = displacement.shape[:3]
    places = np.indices(shape) + np.moveaxis(np.asarray(displacement, np.float64), -1, 0)[::-1]
    sides = np.reshape(shape, (3, 1, 1, 1))
    places = np.clip(places, -reach, sides - 1 + reach)
    first = np.clip(np.floor(places).astype(int) + 1 - reach, -reach, sides - 1)
    for tap in np.ndindex(*(2 * reach,) * 3):
        index = first + np.reshape(tap, (3, 1, 1, 1))
        z, y, x = index + 2 * reach
        yield (z, y, x), _weight(np.abs(places - index), reach).prod(axis=0)


def _weight(distance: np.ndarray, reach: int) -> np.ndarray:
    if reach == 1:
        return np.asarray(np.maximum(1 - distance, 0))
    near = 1.5 * distance**3 - 2.5 * distance**2 + 1
    far = -0.5 * distance**3 + 2.5 * distance**2 - 4 * distance + 2
    return np.asarray(np.where(distance < 1, near, np.where(distance < 2, far, 0)))
