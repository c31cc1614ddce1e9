"""Nonlocal smoothing: moves voxels towards near ones with similar surroundings.

A gradient step of the quadratic nonlocal functional ½ Σ w_ij (x_i − x_j)² over pairs in 5³ neighbourhoods (Gilboa and Osher,
Multiscale Model. Simul. 6 (2007) 595). w_ij = l_ij min(1/S_i, 1/S_j), S_i = Σ_j l_ij, with the likeness l_ij = exp(−d_ij/h²)
of nonlocal means (Buades, Coll and Morel, Multiscale Model. Simul. 4 (2005) 490), d_ij the mean square between 3³ patches
about i and j of a guide, which is continued by its outermost voxels. The weights are symmetric and no row of them sums to
more than 1: a step of at most 1 gives weighted means, one of at most ½ is the proximal map of a convex function."""

import itertools

import numpy as np

from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime, SameArray
from phyradgs_cl.runtime.layout import GUARD, on_device, padded_zeros, pitch_of

REACH = 2
HALO = REACH + 1
OFFSETS = tuple(o for o in itertools.product(range(-REACH, REACH + 1), repeat=3) if o > (0, 0, 0))
"""One of each pair of neighbours o and −o, z y x."""
LARGEST = 255  # a likeness of 1


class NonlocalStep:
    """The step for volumes of a fixed ``shape`` (z, y, x). Before ``learn`` it does not change them."""

    VOLUMES = 24
    """Volumes of floats that it holds in memory, with 64 voxels in a row or more."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int]) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._layout = np.array([nx, ny, nz, 0], np.int32), np.int32(pitch_of(nx))
        shapes = {"IMAGE_GUARD": GUARD, "BLOCK_PIXEL": rt.pixel_items}
        self._start, self._likeness_of, self._share_of, self._step = (
            rt.kernel("nonlocal_step", f"nonlocal_{name}", **shapes) for name in ("start", "likeness", "share", "step")
        )
        rows = (nz + 2 * HALO) * (ny + 2 * HALO)
        self._padded, self._share = padded_zeros(rt, rows, nx), padded_zeros(rt, rows, nx)
        self._likeness = rt.zeros(2 * GUARD + len(OFFSETS) * nz * ny * pitch_of(nx), np.uint8)

    @property
    def likeness(self) -> np.ndarray:
        """(62, nz, ny, nx) of ``OFFSETS``, float64 in steps of 1/255; 0 where the neighbour is outside."""
        nz, ny, nx = self.shape
        rows = self.rt.download(self._likeness)[GUARD:-GUARD].reshape(len(OFFSETS), nz, ny, -1)
        return rows[..., :nx] / LARGEST

    def learn(self, guide: DeviceArray | np.ndarray, width: float) -> None:
        """Computes the weights from a volume (z, y, x), float32; ``width`` is h, in its unit."""
        self._pad(guide)
        slope = np.float32(-1 / (27 * width**2))
        self._launch(self._likeness_of, self._padded, *self._layout, slope, self._likeness)
        self._launch(self._share_of, self._likeness, *self._layout, self._share)

    def __call__(self, volume: SameArray, step: float, *, out: DeviceArray | None = None) -> SameArray:
        """Moves a volume (z, y, x), float32, by ``step`` down the gradient; a device array gives one (``out``, if given)."""

        def descend(observed: DeviceArray, result: DeviceArray) -> None:
            self._pad(observed)
            arguments = self._padded, self._share, self._likeness, *self._layout, np.float32(step)
            self._launch(self._step, *arguments, result)

        return on_device(self.rt, descend, volume, out)

    def _pad(self, volume: DeviceArray | np.ndarray) -> None:
        there = volume if isinstance(volume, DeviceArray) else self.rt.upload(volume, np.float32)
        nz, ny, nx = (count + 2 * HALO for count in self.shape)
        group = self.rt.group(on_cpu=16)
        self.rt.launch(self._start, (nx, ny, nz), there, *self._layout, self._padded, group=group)

    def _launch(self, kernel: Kernel, *arguments: object) -> None:
        nz, ny, nx = self.shape
        items = nx if self.rt.pixel_items else 1, ny, nz
        self.rt.launch(kernel, items, *arguments, group=self.rt.group())


def likeness_of(guide: np.ndarray, width: float) -> np.ndarray:
    """Float64 twin of ``NonlocalStep.learn``: what ``likeness`` is rounded from."""
    padded = np.pad(np.asarray(guide, np.float64), HALO, mode="edge")
    inside = np.pad(np.ones(guide.shape), REACH)
    found = []
    for offset in OFFSETS:
        squares = (padded - np.roll(padded, [-o for o in offset], (0, 1, 2))) ** 2
        patches = np.lib.stride_tricks.sliding_window_view(squares, (3, 3, 3)).mean((3, 4, 5))
        at = tuple(slice(REACH, REACH + count) for count in guide.shape)
        there = tuple(slice(REACH + o, REACH + o + count) for o, count in zip(offset, guide.shape, strict=True))
        found.append(np.exp(-patches[at] / width**2) * inside[there])
    return np.array(found)


def nonlocal_step(volume: np.ndarray, likeness: np.ndarray, step: float) -> np.ndarray:
    """Float64 twin of ``NonlocalStep``, from ``likeness`` (62, nz, ny, nx)."""
    volume = np.asarray(volume, np.float64)
    pairs = [(*_ends(offset, volume.shape), alike) for offset, alike in zip(OFFSETS, likeness, strict=True)]
    sums = np.zeros_like(volume)
    for here, there, alike in pairs:
        sums[here] += alike[here]
        sums[there] += alike[here]
    pull = np.zeros_like(volume)
    for here, there, alike in pairs:
        weight = alike[here] / np.maximum(np.maximum(sums[here], sums[there]), 1e-300)
        pull[here] += weight * (volume[there] - volume[here])
        pull[there] += weight * (volume[here] - volume[there])
    return np.asarray(volume + step * pull)


def _ends(offset: tuple[int, ...], shape: tuple[int, ...]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The voxels that have a neighbour at ``offset``, and those neighbours."""
    here = tuple(slice(max(0, -o), max(0, n - max(0, o))) for o, n in zip(offset, shape, strict=True))
    there = tuple(slice(max(0, o), max(0, n - max(0, -o))) for o, n in zip(offset, shape, strict=True))
    return here, there
