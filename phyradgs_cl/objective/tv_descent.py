"""Steepest descent of the isotropic total variation in steps of a fixed length, for ASD-POCS.

Sidky and Pan, Phys. Med. Biol. 53 (2008) 4777; backward differences and their floor as in TIGRE. With a prior image i it
descends (1 − share) TV(x) + share TV(x − i) (Chen, Tang and Leng, Med. Phys. 35 (2008) 660).
"""

from collections.abc import Callable
from typing import cast

import numpy as np

from phyradgs_cl.runtime import DeviceArray, DeviceSpace, Runtime, SameArray

_SMALLEST = 1e-8


class TvDescent:
    """Steps of TV descent for volumes of a fixed ``shape`` (z, y, x). image: a prior image of that shape, with its share."""

    def __init__(
        self, rt: Runtime, shape: tuple[int, int, int], image: np.ndarray | None = None, share: float = 0.0
    ) -> None:
        self.rt, self.shape, self.share = rt, shape, share
        self._image = None if image is None or share == 0 else rt.upload(image, np.float32)
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._kernel = rt.kernel("tv_descent", "tv_gradient")
        self._space = DeviceSpace(rt)

    def gradient(self, volume: SameArray) -> SameArray:
        """Returns dTV/dvolume (z, y, x) float32; a device array gives a device array."""
        return self._where_it_is(self._gradient, volume)

    def __call__(self, volume: SameArray, step: float, count: int) -> SameArray:
        """Takes ``count`` steps of Euclidean length ``step`` (1/mm) downhill; a device array gives a device array."""

        def descended(x: DeviceArray) -> DeviceArray:
            for _ in range(count):
                x = self._space.descend(x, self._slope(x), step)
            return x

        return self._where_it_is(descended, volume)

    def _slope(self, volume: DeviceArray) -> DeviceArray:
        slope, space = self._gradient(volume), self._space
        if self._image is None:
            return slope
        of_change = self._gradient(space.add(volume, self._image, -1.0))
        return space.add(slope, space.add(of_change, slope, -1.0), self.share)

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


def tv_descent(
    volume: np.ndarray, step: float, count: int, image: np.ndarray | None = None, share: float = 0.0
) -> np.ndarray:
    """Float64 twin of ``TvDescent``."""
    result = np.array(volume, np.float64)
    for _ in range(count):
        gradient = tv_gradient(result)
        if image is not None:
            gradient = (1 - share) * gradient + share * tv_gradient(result - image)
        length = np.linalg.norm(gradient)
        if length == 0:
            break
        result -= step / length * gradient
    return result
