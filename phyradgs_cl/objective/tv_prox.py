"""Proximal map of the isotropic total variation: argmin_x ½‖x − b‖² + weight · TV(x), optionally over x ≥ 0.

Fast gradient projection on the dual (Beck and Teboulle, IEEE Trans. Image Process. 18 (2009) 2419). Differences along
an axis may be weighted, for voxels that are not cubes.
"""

import numpy as np

from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime, SameArray
from phyradgs_cl.runtime.layout import on_device


class TvProx:
    """The map for volumes of a fixed ``shape`` (z, y, x). The next call starts from the dual of the last one."""

    def __init__(
        self,
        rt: Runtime,
        shape: tuple[int, int, int],
        axis_weights: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        self.rt, self.shape = rt, shape
        self.axis_weights = axis_weights  # z, y, x
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._weights4 = np.array([*axis_weights[::-1], 0], np.float32)
        self._primal_step, self._dual_step = rt.kernel("tv_prox", "tv_primal"), rt.kernel("tv_prox", "tv_dual")
        self._dual = rt.zeros((3, *shape))
        self._moved = rt.zeros((3, *shape))

    @property
    def dual(self) -> np.ndarray:
        """The dual field (3, nz, ny, nx) along x, y, z, of length at most 1."""
        return self.rt.download(self._dual)

    @dual.setter
    def dual(self, values: np.ndarray) -> None:
        self.rt.write(self._dual, values)

    def __call__(
        self, volume: SameArray, weight: float, iterations: int, *, nonnegative: bool, out: DeviceArray | None = None
    ) -> SameArray:
        """Maps a volume (z, y, x), float32, by ``iterations`` from the last dual.

        A device array gives a device array (``out``, if given).
        """

        def denoise(observed: DeviceArray, result: DeviceArray) -> None:
            self._map(observed, weight, iterations, nonnegative, result)

        return on_device(self.rt, denoise, volume, out)

    def _map(
        self, observed: DeviceArray, weight: float, iterations: int, nonnegative: bool, result: DeviceArray
    ) -> None:
        if weight <= 0:
            self._primal(observed, self._dual, 0.0, nonnegative, result)
            return
        step = np.float32(1 / (_lipschitz(self.axis_weights) * weight))
        t, start = 1.0, self._dual
        for _ in range(iterations):
            self._primal(observed, start, weight, nonnegative, result)
            t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
            self._launch(
                self._dual_step, result, self._shape4, self._weights4, step, np.float32((t - 1) / t_next),
                start, self._dual, self._moved,
            )  # fmt: skip
            t, start = t_next, self._moved
        self._primal(observed, self._dual, weight, nonnegative, result)

    def _primal(
        self, observed: DeviceArray, dual: DeviceArray, weight: float, nonnegative: bool, result: DeviceArray
    ) -> None:
        self._launch(
            self._primal_step, observed, dual, self._shape4, self._weights4, np.float32(weight),
            np.int32(nonnegative), result,
        )  # fmt: skip

    def _launch(self, kernel: Kernel, *arguments: object) -> None:
        nz, ny, nx = self.shape
        self.rt.launch(kernel, (nx, ny, nz), *arguments, group=self.rt.group(on_cpu=16))


def tv_prox(
    volume: np.ndarray,
    weight: float,
    iterations: int,
    *,
    nonnegative: bool,
    axis_weights: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> np.ndarray:
    """Float64 twin of ``TvProx`` from a dual of zeros."""
    b = np.asarray(volume, np.float64)
    dual = np.zeros((3, *b.shape))
    moved = dual.copy()
    t = 1.0
    for _ in range(iterations):
        x = _primal_of(b, moved, weight, nonnegative, axis_weights)
        q = moved + differences(x, axis_weights) / (_lipschitz(axis_weights) * weight)
        new = q / np.maximum(1, np.linalg.norm(q, axis=0))
        t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
        moved = new + (t - 1) / t_next * (new - dual)
        dual, t = new, t_next
    return _primal_of(b, dual, weight, nonnegative, axis_weights)


def isotropic_tv(volume: np.ndarray, axis_weights: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> float:
    """Σ over voxels of the length of the forward difference of a volume (z, y, x)."""
    return float(np.linalg.norm(differences(np.asarray(volume, np.float64), axis_weights), axis=0).sum())


def differences(volume: np.ndarray, axis_weights: tuple[float, float, float]) -> np.ndarray:
    """Weighted forward differences (3, z, y, x) along z, y, x; 0 behind the last voxel."""
    result = np.zeros((3, *volume.shape))
    for axis, weight in enumerate(axis_weights):
        inner = tuple(slice(0, -1) if a == axis else slice(None) for a in range(3))
        result[axis][inner] = weight * np.diff(volume, axis=axis)
    return result


def _primal_of(
    b: np.ndarray,
    dual: np.ndarray,
    weight: float,
    nonnegative: bool,
    axis_weights: tuple[float, float, float],
) -> np.ndarray:
    adjoint = np.zeros_like(b)
    for axis, axis_weight in enumerate(axis_weights):
        pad = [(1, 0) if a == axis else (0, 0) for a in range(3)]
        adjoint -= axis_weight * np.diff(np.pad(dual[axis], pad), axis=axis)
    x = b - weight * adjoint
    return np.maximum(x, 0) if nonnegative else x


def _lipschitz(axis_weights: tuple[float, float, float]) -> float:
    return 4 * sum(w * w for w in axis_weights)
