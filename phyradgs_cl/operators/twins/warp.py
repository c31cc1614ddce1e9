"""The warp of a volume and its transpose in float64: the twin of cl/warp.cl."""

from collections.abc import Iterator

import numpy as np

Volume = np.ndarray


def warp_forward(volume: Volume, displacement: np.ndarray) -> Volume:
    """Returns v(y + w(y)) (nz, ny, nx), trilinear and 0 outside, for w (nz, ny, nx, 3) in voxels, components x, y, z."""
    padded = np.pad(np.asarray(volume, np.float64), 1)
    result = np.zeros(volume.shape)
    for place, weight in _corners(displacement):
        result += weight * padded[place]
    return result


def warp_adjoint(values: Volume, displacement: np.ndarray) -> Volume:
    """Returns the transpose of ``warp_forward`` at ``values`` (nz, ny, nx)."""
    padded = np.zeros([n + 2 for n in values.shape])
    for place, weight in _corners(displacement):
        np.add.at(padded, place, weight * values)
    return padded[1:-1, 1:-1, 1:-1]


def _corners(displacement: np.ndarray) -> Iterator[tuple[tuple[np.ndarray, ...], np.ndarray]]:
    """Yields indices into the volume with a border of one voxel, and weights, for the eight neighbours of each place."""
    shape = displacement.shape[:3]
    places = np.indices(shape) + np.moveaxis(np.asarray(displacement, np.float64), -1, 0)[::-1]
    sides = np.reshape(shape, (3, 1, 1, 1))
    places = np.clip(places, -1, sides)
    below = np.minimum(np.floor(places).astype(int), sides - 1)
    share = places - below
    for corner in np.ndindex(2, 2, 2):
        along = [share[i] if corner[i] else 1 - share[i] for i in range(3)]
        z, y, x = (below[i] + corner[i] + 1 for i in range(3))
        yield (z, y, x), along[0] * along[1] * along[2]
