"""Takes gradient steps of a learned, weakly convex regulariser R(x) = Σ_i Σ_p ψ_i((W_i x)_p): a prior for texture and
anatomy.

Goujon, Neumayer and Unser, "Learning weakly convex regularizers for convergent image-reconstruction algorithms", SIAM J.
Imaging Sci. 17 (2024) 91, in 3D. The sums run over filters i and voxels p. A filter W_i of 5³ voxels is a chain: 4
correlations with 3³ voxels, then 16 with their results. Only windows inside the volume count. ψ_i' is a difference of two
clamps, with knots in units of the noise σ. Beyond a knot ψ_i' may fall, so R is only weakly convex: ½‖x − v‖² + step R(x)
is convex for step ≤ 1."""

import json
from dataclasses import dataclass
from functools import cache

import numpy as np

from phyradgs_cl import resource
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime, SameArray
from phyradgs_cl.runtime.layout import GUARD, Strides, beside, brought_to, move, padded_zeros, pitch_of

EDGE = 5
"""Voxels along each side of a filter."""
_SAMPLES = 200  # a voxel takes at most as long as this many ray samples; ``launch`` divides launches of too many samples
_SLICES = 2  # slices computed at a time: channels and responses of a whole volume would take 24 volumes of memory
_RING = _SLICES + 2  # number of slices kept in memory: correlating two slices needs one more slice on either side


@dataclass(frozen=True, eq=False)
class Ridge:
    """The float32 numbers of a regulariser Σ_i Σ_p ψ_i((W_i x)_p) of a volume x with noise σ. Filter W_i correlates x with
    ``first`` (4, 3, 3, 3), and the 4 results with ``second[i]``; ``second`` is (16, 4, 3, 3, 3). Axes are z, y, x.

    The potential ψ_i has at the filter's response t the slope ψ_i'(t) = slope_up[i] clip(t, ±σ knot_up[i]) − slope_down[i]
    clip(t, ±σ knot_down[i]). Slopes and knots (16,) are at least 0."""

    first: np.ndarray
    second: np.ndarray
    slope_up: np.ndarray
    knot_up: np.ndarray
    slope_down: np.ndarray
    knot_down: np.ndarray

    def table(self) -> np.ndarray:
        """Returns filters, slopes and knots in one float32 array, in the order in which the kernels read them. The array
        contains ``second`` twice, with its axes in two orders."""
        filters = np.moveaxis(self.first, 0, -1), np.moveaxis(self.second, 0, -1), np.moveaxis(self.second, (0, 1), (-2, -1))
        curves = self.slope_up, self.knot_up, self.slope_down, self.knot_down
        return np.concatenate([part.ravel() for part in (*filters, *curves)]).astype(np.float32)

    def bend(self, responses: np.ndarray, sigma: float) -> np.ndarray:
        """Returns the slopes ψ_i' at the filters' responses (16, z, y, x). sigma: the noise σ in the volume's unit."""
        columns = (self.slope_up, self.knot_up, self.slope_down, self.knot_down)
        up, knot_up, down, knot_down = (values.astype(np.float64)[:, None, None, None] for values in columns)
        rising, falling = (np.clip(responses, -sigma * knot, sigma * knot) for knot in (knot_up, knot_down))
        return np.asarray(up * rising - down * falling)


@cache
def learned_ridge() -> Ridge:
    """Returns the regulariser of ``data/ridge.json``, in which benchmarks/train_ridge.py has stored each number times
    1,000."""
    stored = json.loads((resource("data") / "ridge.json").read_text(encoding="utf-8"))
    first, second, *curves = (np.array(stored[name]) / 1000 for name in Ridge.__dataclass_fields__)
    first, second = first.reshape(-1, 3, 3, 3), second.reshape(len(curves[0]), -1, 3, 3, 3)
    # The weights of a chained filter must sum to 0, so that a step leaves flat volumes as they are. The stored numbers are
    # rounded, and their sums are near 0, so the sums are removed.
    sums = first.sum((1, 2, 3))
    second -= np.multiply.outer(second.sum((2, 3, 4)) @ sums, sums / (27 * sums @ sums))[..., None, None, None]
    return Ridge(*(values.astype(np.float32) for values in (first, second, *curves)))


class RidgeStep:
    """Steps down the ridge regulariser for volumes of one ``shape`` (nz, ny, nx). Volumes thinner than a filter (5 voxels)
    get no step."""

    VOLUMES = 4
    """Most memory of a step, counted in float32 volumes; holds for volumes of at least 50 slices and 64 voxels a row."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int], ridge: Ridge) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._layout = np.array([nx, ny, nz, 0], np.int32), np.int32(pitch_of(nx))
        defines = {"IMAGE_GUARD": GUARD, "BLOCK_PIXEL": rt.pixel_items, "RING": _RING}
        names = "ridge_channels", "ridge_responses", "ridge_channels_back", "ridge_step"
        self._channels_of, self._bent, self._back, self._step = (rt.kernel("ridge", name, **defines) for name in names)
        self._table = rt.upload(ridge.table())
        channels, filters = len(ridge.first), len(ridge.second)
        self._padded = padded_zeros(rt, nz * ny, nx)
        self._channels, self._responses, self._channels_back = (
            padded_zeros(rt, _RING * count * ny, nx) for count in (channels, filters, channels)
        )

    def __call__(
        self, volume: SameArray, sigma: float, step: float, *, nonnegative: bool, out: DeviceArray | None = None
    ) -> SameArray:
        """Returns v − ``step`` ∇R(v), float32, for a volume v (nz, ny, nx). sigma: its noise, in v's unit. nonnegative:
        clips the result at 0. out: a device array that receives the result."""
        nz, ny, nx = self.shape
        observed, result = beside(self.rt, volume, out)
        padded = self._padded, Strides(GUARD, ny * pitch_of(nx), pitch_of(nx))
        move(self.rt, (observed, Strides.plain(self.shape)), padded, self.shape)
        is_thin = min(self.shape) < EDGE  # the volume is thinner than a filter, so the gradient stays 0
        end = np.float32(step), np.int32(nonnegative), result
        # A slice of responses needs three slices of channels, so responses are computed two slices after the channels.
        for first in range(0, nz + 2, _SLICES):
            if not is_thin:
                self._launch(self._channels_of, first, 2, self._padded, ends=(self._channels,))
                self._launch(self._bent, first - 2, 4, self._channels, ends=(np.float32(sigma), self._responses))
                self._launch(self._back, first - 2, 2, self._responses, ends=(self._channels_back,))
            self._launch(self._step, first - 2, 0, self._padded, self._channels_back, ends=end)
        return brought_to(self.rt, volume, result)

    def _launch(self, kernel: Kernel, first: int, less: int, *sources: DeviceArray, ends: tuple[object, ...]) -> None:
        """Runs a kernel for the ``_SLICES`` slices from ``first`` on, as far as the result has them. The result has ``less``
        voxels fewer than the volume along each axis. sources, ends: the kernel's first and last arguments."""
        nz, ny, nx = (count - less for count in self.shape)
        start, stop = max(first, 0), min(first + _SLICES, nz)
        if start < stop:
            items = nx if self.rt.pixel_items else 1, ny, stop - start
            arguments = *sources, *self._layout, np.int32(start), self._table, *ends
            samples = _SAMPLES * nx * ny * (stop - start)
            self.rt.launch(kernel, items, *arguments, group=self.rt.group(), samples=samples)


def ridge_gradient(volume: np.ndarray, sigma: float, ridge: Ridge) -> np.ndarray:
    """Returns the regulariser's gradient ∇R at a volume (nz, ny, nx), float64. sigma: the volume's noise, in its unit."""
    volume = np.asarray(volume, np.float64)
    if min(volume.shape) < EDGE:
        return np.zeros_like(volume)
    bent = ridge.bend(correlated(correlated(volume[None], ridge.first[:, None]), ridge.second), sigma)
    return np.asarray(correlated_back(correlated_back(bent, ridge.second), ridge.first[:, None])[0])


def ridge_step(volume: np.ndarray, sigma: float, step: float, *, ridge: Ridge, nonnegative: bool) -> np.ndarray:
    """Returns a volume after a step down the regulariser, v − ``step`` ∇R(v), float64: the twin of ``RidgeStep``."""
    moved: np.ndarray = np.asarray(volume, np.float64) - step * ridge_gradient(volume, sigma, ridge)
    return np.maximum(moved, 0) if nonnegative else moved


def correlated(channels: np.ndarray, filters: np.ndarray) -> np.ndarray:
    """Correlates channels (c, z, y, x) with filters (i, c, 3, 3, 3), without padding: returns (i, z − 2, y − 2, x − 2)."""
    windows = np.lib.stride_tricks.sliding_window_view(channels, (3, 3, 3), axis=(1, 2, 3))
    return np.asarray(np.einsum("czyxkji,fckji->fzyx", windows, filters.astype(np.float64), optimize=True))


def correlated_back(responses: np.ndarray, filters: np.ndarray) -> np.ndarray:
    """Applies the transpose of ``correlated``, from (i, z, y, x) to (c, z + 2, y + 2, x + 2)."""
    padded = np.pad(responses, ((0, 0), (2, 2), (2, 2), (2, 2)))
    return correlated(padded, filters.swapaxes(0, 1)[..., ::-1, ::-1, ::-1])
