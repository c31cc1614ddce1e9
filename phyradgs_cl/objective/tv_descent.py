"""Steepest descent of the isotropic total variation in steps of a fixed length, as ASD-POCS takes them.

Sidky and Pan, Phys. Med. Biol. 53 (2008) 4777; backward differences and their floor as in TIGRE.
"""

from collections.abc import Callable
from typing import cast

import numpy as np

from phyradgs_cl.runtime import DeviceArray, DeviceSpace, Runtime, SameArray

_SMALLEST = 1e-8


class TvDescent:
    """Steps of TV descent for volumes of a fixed ``shape`` (z, y, x)."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int]) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._kernel = rt.kernel("tv_descent", "tv_gradient")
        self._space = DeviceSpace(rt)

    def gradient(self, volume: SameArray) -> SameArray:
        """dTV/dvolume (z, y, x) float32, on the device where the volume is."""
        return self._where_it_is(self._gradient, volume)

    def __call__(self, volume: SameArray, step: float, count: int) -> SameArray:
        """``count`` steps of Euclidean length ``step`` (1/mm) downhill; of a device array on the device alone."""

        def descended(x: DeviceArray) -> DeviceArray:
            for _ in range(count):
                x = self._space.descend(x, self._gradient(x), step)
            return x

        return self._where_it_is(descended, volume)

    def _gradient(self, volume: DeviceArray) -> DeviceArray:
        nz, ny, nx = self.shape
        gradient = self._space.empty(self.shape)
        items, group = (nx, ny, nz), self.rt.group(on_cpu=16)
        self.rt.launch(self._kernel, items, volume, self._shape4, gradient, group=group)
        return gradient

    def _where_it_is(self, function: Callable[[DeviceArray], DeviceArray], volume: SameArray) -> SameArray:
        if isinstance(volume, DeviceArray):
            return cast(SameArray, function(volume))
        return cast(SameArray, self.rt.download(function(self.rt.upload(volume, np.float32))))


def tv_gradient(volume: np.ndarray) -> np.ndarray:
    """Float64 twin: gradient (z, y, x) of Σ |backward difference|."""
    volume = np.asarray(volume, np.float64)
    difference = np.stack([np.diff(volume, axis=a, prepend=volume.take([0], axis=a)) for a in range(3)])
    unit = difference / (np.linalg.norm(difference, axis=0) + _SMALLEST)
    gradient: np.ndarray = unit.sum(axis=0)
    for axis in range(3):
        ahead = np.diff(unit[axis], axis=axis, append=np.zeros_like(unit[axis].take([0], axis=axis)))
        gradient -= ahead + unit[axis]
    return gradient


def tv_descent(volume: np.ndarray, step: float, count: int) -> np.ndarray:
    """Float64 twin of ``TvDescent``."""
    result = np.array(volume, np.float64)
    for _ in range(count):
        gradient = tv_gradient(result)
        length = np.linalg.norm(gradient)
        if length == 0:
            break
        result -= step / length * gradient
    return result
