"""Total variation of the attenuation field on a small sub-volume (paper, Eq. 4, L_TV; after R2-Gaussian).

Anisotropic: the mean absolute difference between neighbouring voxels along z, y and x, added up.
"""

import math

import numpy as np

from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD


class TotalVariation:
    """Value and gradient for volumes of a fixed ``shape`` (z, y, x) in the padded layout."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int], pitch: int) -> None:
        self.rt, self.shape, self.pitch = rt, shape, pitch
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._weight4 = np.array([*_axis_weights(shape)[::-1], 0], np.float32)
        self._kernel = rt.kernel("total_variation", "total_variation", IMAGE_GUARD=GUARD)
        self._sums = rt.zeros(rt.shape_of_lines(pitch, ny, nz)[2])
        self.gradient = rt.zeros(2 * GUARD + nz * ny * pitch)

    def evaluate(self, volume: DeviceArray) -> DeviceArray:
        """Returns dTV/dvolume, valid until the next call."""
        nz, ny, _ = self.shape
        items, tile, _ = self.rt.shape_of_lines(self.pitch, ny, nz)
        self.rt.launch(
            self._kernel,
            items,
            volume,
            self._shape4,
            np.int32(self.pitch),
            self._weight4,
            self.gradient,
            self.rt.local(4 * math.prod(tile)),
            self._sums,
            group=tile,
        )
        return self.gradient

    def value(self) -> float:
        """Returns TV at the last ``evaluate``; waits for the device."""
        return float(self.rt.download(self._sums).astype(np.float64).sum())


def total_variation(volume: np.ndarray) -> tuple[float, np.ndarray]:
    """Float64 twin: returns TV of a volume (z, y, x) and its gradient."""
    volume = np.asarray(volume, np.float64)
    gradient = np.zeros_like(volume)
    value = 0.0
    for axis, weight in enumerate(_axis_weights(volume.shape)):
        difference = np.diff(volume, axis=axis)
        value += weight * np.abs(difference).sum()
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        gradient -= weight * np.diff(np.pad(np.sign(difference), pad), axis=axis)
    return float(value), gradient


def _axis_weights(shape: tuple[int, ...]) -> list[float]:
    """Returns one over the number of differences along each axis (z, y, x); 0 along an axis of one voxel."""
    total = int(np.prod(shape))
    return [1.0 / (total // n * (n - 1)) if n > 1 else 0.0 for n in shape]
