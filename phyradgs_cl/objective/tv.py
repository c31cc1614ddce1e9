"""Lowers the isotropic total variation (TV) of a volume in two ways: by a proximal map, and by steepest descent.

``TvProx`` maps a volume b to argmin_x ½‖x − b‖² + weight · TV(x), with x ≥ 0 if asked, by fast gradient projection on the
dual (Beck and Teboulle, IEEE Trans. Image Process. 18 (2009) 2419). Axis weights scale the differences where voxels are not
cubes. For an object that changes, the sum of |differences| between successive states is added.

``TvDescent`` takes steps of a fixed length, as ASD-POCS does (Sidky and Pan, Phys. Med. Biol. 53 (2008) 4777), with TIGRE's
backward differences. TV's gradient divides by the lengths of voxels' difference vectors, which may be 0. So a number far
below the volume's values is added to the lengths."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np

from phyradgs_cl.runtime import DeviceArray, DeviceSpace, Runtime, SameArray
from phyradgs_cl.runtime.layout import beside, brought_to


class TvProx:
    """The proximal map of TV for volumes of a fixed ``shape``: (nz, ny, nx), or (K, nz, ny, nx) for K states.

    Each call starts from the dual field with which the call before ended. axis_weights: factors of the differences along z,
    y, x; for states, the factor of the differences in time comes first."""

    def __init__(
        self, rt: Runtime, shape: tuple[int, ...], axis_weights: tuple[float, ...] = (1.0, 1.0, 1.0)
    ) -> None:
        self.rt, self.shape = rt, shape
        self.axis_weights = axis_weights
        *slices, ny, nx = shape
        self._items = nx, ny, math.prod(slices)
        self._shape4 = np.array([*shape[::-1], 1][:4], np.int32)
        self._weights4 = np.array([*axis_weights[::-1], 0][:4], np.float32)
        self._primal_step, self._dual_step = (
            rt.kernel("tv_prox", name, STATES=len(shape) == 4) for name in ("tv_primal", "tv_dual")
        )
        self._dual = rt.zeros((len(shape), *shape))
        self._moved = rt.zeros((len(shape), *shape))

    @property
    def dual(self) -> np.ndarray:
        """The dual field: vectors of length ≤ 1, (3, nz, ny, nx) along x, y, z; for states (4, K, nz, ny, nx), time last."""
        return self.rt.download(self._dual)

    @dual.setter
    def dual(self, values: np.ndarray) -> None:
        self.rt.write(self._dual, values)

    def __call__(
        self, volume: SameArray, weight: float, iterations: int, *, nonnegative: bool, out: DeviceArray | None = None
    ) -> SameArray:
        """Returns the proximal map of a volume of ``shape``, float32, after ``iterations`` steps from the last dual field.
        weight: in the volume's unit.

        nonnegative: maps to x ≥ 0. If ``volume`` is a device array, the result is one too (``out``, if given)."""
        observed, result = beside(self.rt, volume, out)
        weight = max(weight, 0.0)
        steps = np.float32(np.array(_steps(self.axis_weights)) / (weight or 1.0))
        t, start = 1.0, self._dual
        for _ in range(iterations if weight else 0):
            self._primal(observed, start, weight, nonnegative, result)
            t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
            self.rt.launch(
                self._dual_step, self._items, result, self._shape4, self._weights4, *steps, np.float32((t - 1) / t_next),
                start, self._dual, self._moved, group=self.rt.group(on_cpu=32),
            )  # fmt: skip
            t, start = t_next, self._moved
        self._primal(observed, self._dual, weight, nonnegative, result)
        return brought_to(self.rt, volume, result)

    def _primal(
        self, observed: DeviceArray, dual: DeviceArray, weight: float, nonnegative: bool, result: DeviceArray
    ) -> None:
        self.rt.launch(
            self._primal_step, self._items, observed, dual, self._shape4, self._weights4, np.float32(weight),
            np.int32(nonnegative), result, group=self.rt.group(on_cpu=32),
        )  # fmt: skip


def tv_prox(
    volume: np.ndarray, weight: float, iterations: int, *, nonnegative: bool,
    axis_weights: tuple[float, ...] = (1.0, 1.0, 1.0),
) -> np.ndarray:
    """Returns the proximal map of TV of a volume, float64: the NumPy twin of ``TvProx``, with a dual that starts from 0."""
    b = np.asarray(volume, np.float64)
    dual = np.zeros((b.ndim, *b.shape))
    moved = dual.copy()
    t = 1.0
    for _ in range(iterations):
        x = _primal_of(b, moved, weight, nonnegative, axis_weights)
        step, time_step = _steps(axis_weights)
        changes = differences(x, axis_weights) / weight
        q = moved + np.concatenate([time_step * changes[:-3], step * changes[-3:]])
        new = q / np.maximum(1, np.linalg.norm(q[-3:], axis=0))
        new[:-3] = np.clip(q[:-3], -1, 1)  # differences in time are scalars, not vectors: each is clipped by itself
        t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
        moved = new + (t - 1) / t_next * (new - dual)
        dual, t = new, t_next
    return _primal_of(b, dual, weight, nonnegative, axis_weights)


def differences(volume: np.ndarray, axis_weights: tuple[float, ...]) -> np.ndarray:
    """Returns weighted forward differences (3, z, y, x) along z, y, x; 0 at the last voxel. For states (K, z, y, x) returns
    (4, K, z, y, x), with the differences between successive states first."""
    result = np.zeros((volume.ndim, *volume.shape))
    for axis, weight in enumerate(axis_weights):
        inner = tuple(slice(0, -1) if a == axis else slice(None) for a in range(volume.ndim))
        result[axis][inner] = weight * np.diff(volume, axis=axis)
    return result


def _primal_of(
    b: np.ndarray, dual: np.ndarray, weight: float, nonnegative: bool, axis_weights: tuple[float, ...]
) -> np.ndarray:
    adjoint = np.zeros_like(b)
    for axis, axis_weight in enumerate(axis_weights):
        pad = [(1, 0) if a == axis else (0, 0) for a in range(b.ndim)]
        adjoint -= axis_weight * np.diff(np.pad(dual[axis], pad), axis=axis)
    x = b - weight * adjoint
    return np.maximum(x, 0) if nonnegative else x


def _steps(axis_weights: tuple[float, ...]) -> tuple[float, float]:
    """Returns the dual's steps in space and in time: 1/(upper bound of the squared norm of the difference operator in space,
    or in time). For states both steps are halved. If the weight in time is large, a common step would be too short in
    space."""
    *time, z, y, x = axis_weights
    in_space = 1 / (4 * (z * z + y * y + x * x))
    return (in_space / 2, 1 / (8 * time[0] ** 2)) if any(time) else (in_space, 0.0)


# TV's gradient divides by (length of differences, which may be 0) + max(_SMALLEST · RMS of the volume, _NOTHING).
_SMALLEST = 1e-6  # (added length)/(RMS of the volume): a quotient, so that units do not matter
_NOTHING = 1e-30  # least added length in 1/mm, for a volume of zeros, whose RMS is 0


class TvDescent:
    """Steps down the total variation of volumes of a fixed ``shape`` (nz, ny, nx)."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int]) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._kernel = rt.kernel("tv_descent", "tv_gradient")
        self._space = DeviceSpace(rt)

    def gradient(self, volume: SameArray) -> SameArray:
        """Returns dTV/d(volume), (nz, ny, nx) float32; on the device if ``volume`` is a device array."""
        return self._where_it_is(lambda x: self._gradient(x, self._least(x)), volume)

    def __call__(self, volume: SameArray, step: float, count: int) -> SameArray:
        """Returns a volume (nz, ny, nx) after ``count`` steps downhill, each of Euclidean length ``step`` in the volume's
        unit. If ``volume`` is a device array, the result is one too."""

        def descended(x: DeviceArray) -> DeviceArray:
            least = self._least(x)
            for _ in range(count):
                x = self._space.descend(x, self._gradient(x, least), step)
            return x

        return self._where_it_is(descended, volume)

    def _least(self, volume: DeviceArray) -> float:
        return max(_SMALLEST * self._space.norm(volume) / math.sqrt(volume.size), _NOTHING)

    def _gradient(self, volume: DeviceArray, least: float) -> DeviceArray:
        nz, ny, nx = self.shape
        gradient = self._space.empty(self.shape)
        items, group = (nx, ny, nz), self.rt.group(on_cpu=32)
        self.rt.launch(self._kernel, items, volume, self._shape4, np.float32(least), gradient, group=group)
        return gradient

    def _where_it_is(self, function: Callable[[DeviceArray], DeviceArray], volume: SameArray) -> SameArray:
        if isinstance(volume, DeviceArray):
            return cast(SameArray, function(volume))
        return cast(SameArray, self.rt.download(function(self.rt.upload(volume, np.float32))))


def tv_gradient(volume: np.ndarray, least: float | None = None) -> np.ndarray:
    """Returns the gradient (nz, ny, nx) of Σ |vector of backward differences|: the float64 twin of ``TvDescent.gradient``.
    least: a small number that is added to the vectors' lengths; None: chosen from the volume."""
    volume = np.asarray(volume, np.float64)
    least = _least_of(volume) if least is None else least
    difference = np.stack([np.diff(volume, axis=a, prepend=volume.take([0], axis=a)) for a in range(3)])
    unit = difference / (np.linalg.norm(difference, axis=0) + least)
    gradient: np.ndarray = unit.sum(axis=0)
    for axis in range(3):
        ahead = np.diff(unit[axis], axis=axis, append=np.zeros_like(unit[axis].take([0], axis=axis)))
        gradient -= ahead + unit[axis]
    return gradient


def _least_of(volume: np.ndarray) -> float:
    return max(_SMALLEST * float(np.linalg.norm(volume)) / math.sqrt(volume.size), _NOTHING)


def tv_descent(volume: np.ndarray, step: float, count: int) -> np.ndarray:
    """Returns a volume after ``count`` steps down its TV, each of length ``step``: the float64 twin of ``TvDescent``."""
    result = np.array(volume, np.float64)
    least = _least_of(result)
    for _ in range(count):
        gradient = tv_gradient(result, least)
        length = np.linalg.norm(gradient)
        if length == 0:
            break
        result -= step / length * gradient
    return result
