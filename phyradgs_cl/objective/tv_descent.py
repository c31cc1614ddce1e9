"""Steepest descent of the isotropic total variation in steps of a fixed length, as ASD-POCS takes them.

Sidky and Pan, Phys. Med. Biol. 53 (2008) 4777; backward differences and their floor as in TIGRE.
"""

from __future__ import annotations

import numpy as np

from phyradgs_cl.runtime import Runtime

_SMALLEST = 1e-8


class TvDescent:
    """Steps of TV descent for volumes of a fixed ``shape`` (z, y, x)."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int]) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._kernel = rt.kernel("tv_descent", "tv_gradient")
        self._volume, self._gradient = rt.empty(shape), rt.empty(shape)

    def gradient(self, volume: np.ndarray) -> np.ndarray:
        """dTV/dvolume (z, y, x) float32."""
        nz, ny, nx = self.shape
        self.rt.write(self._volume, volume)
        self.rt.launch(
            self._kernel,
            (nx, ny, nz),
            self._volume,
            self._shape4,
            self._gradient,
            group=self.rt.group(on_cpu=16),
        )
        return self.rt.download(self._gradient)

    def __call__(self, volume: np.ndarray, step: float, count: int) -> np.ndarray:
        """``count`` steps of Euclidean length ``step`` (1/mm) downhill."""
        result = volume.astype(np.float32, copy=True)
        for _ in range(count):
            gradient = self.gradient(result)
            length = float(np.linalg.norm(gradient.ravel().astype(np.float64)))
            if length == 0:
                break
            result -= np.float32(step / length) * gradient
        return result


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
