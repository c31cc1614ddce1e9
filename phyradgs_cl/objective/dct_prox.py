"""Shrinkage of all 4³ block cosine transforms: a prior for textures and edges, which total variation flattens.

Shrinkage of an overcomplete transform: B_sᵀ T(B_s v), averaged over the shifts s of the blocks (Coifman and Donoho,
"Translation-invariant de-noising", 1995; block DCT: Guleryuz, IEEE Trans. Image Process. 16 (2007) 3020). A block's mean is
not shrunk. Near faces the average is over the blocks inside the volume. T is a soft threshold, or a curve for each class of
frequencies (Hel-Or and Shaked, IEEE Trans. Image Process. 17 (2008) 443).

A map takes a quarter of the shifts, the next map the next quarter: over iterations the average is the same (cycle spinning;
Kamilov, Bostan and Unser, IEEE Signal Process. Lett. 21 (2014) 1326)."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import scipy

from phyradgs_cl import resource
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.runtime import DeviceArray, Runtime, SameArray
from phyradgs_cl.runtime.layout import GUARD, on_device, padded_zeros, pitch_of

EDGE = 4
_SAMPLES = 8  # as long as so many samples of a ray takes a voxel of a block
# By turn, the shift along y for every shift along z: a turn has each of both once, four turns have all pairs
TURNS = ((0, 1, 2, 3), (1, 3, 0, 2), (2, 0, 3, 1), (3, 2, 1, 0))
# Frequencies (z, y, x) that differ in the order of their axes alone are of one class. Class 0 is the mean alone
_SORTED = [tuple(sorted(frequency)) for frequency in itertools.product(range(EDGE), repeat=3)]
CLASSES = np.unique(_SORTED, axis=0, return_inverse=True)[1].reshape((EDGE,) * 3)
FREQUENCY_CLASSES = int(CLASSES.max())  # without the mean


@dataclass(frozen=True, eq=False)
class Curves:
    """What a coefficient c of class k loses: Σ_m weights[k − 1, m] clip(c, ±unit knots[m]).

    knots (M,), weights (19, M): dimensionless, float32; the unit is an argument of the map."""

    knots: np.ndarray
    weights: np.ndarray

    def scaled(self, share: float) -> "Curves":
        """Returns the curves with all losses multiplied by ``share``."""
        return Curves(self.knots, (share * self.weights).astype(np.float32))

    def table(self) -> np.ndarray:
        """Returns the kernel's table: knots, then the weights class by class, float32."""
        return np.concatenate([self.knots, self.weights.ravel()]).astype(np.float32)

    def losses(self, coefficients: np.ndarray, unit: float) -> np.ndarray:
        """Returns the losses of block transforms (..., 4, 4, 4)."""
        weights = np.concatenate([np.zeros((1, len(self.knots))), self.weights])[CLASSES]
        losses = np.zeros_like(coefficients)
        for m, knot in enumerate(unit * self.knots.astype(np.float64)):
            losses += weights[..., m] * np.clip(coefficients, -knot, knot)
        return losses


@cache
def learned_curves() -> Curves:
    """Returns the curves of ``data/curves.json``, whose unit is the deviation of noise (benchmarks/train_curves.py)."""
    stored = json.loads((resource("data") / "curves.json").read_text(encoding="utf-8"))
    return Curves(np.array(stored["knots"], np.float32), np.array(stored["weights"], np.float32))


SOFT = Curves(np.ones(1, np.float32), np.ones((FREQUENCY_CLASSES, 1), np.float32))
"""The soft threshold, whose unit is the threshold."""

class DctProx:
    """The map for volumes of a fixed ``shape`` (z, y, x); it does not change a volume thinner than a block."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int], curves: Curves = SOFT) -> None:
        self.rt, self.shape = rt, shape
        self._curves = rt.upload(curves.table())
        nz, ny, nx = shape
        self._shape4, self._pitch = np.array([nx, ny, nz, 0], np.int32), np.int32(pitch_of(nx))
        defines = {
            "IMAGE_GUARD": GUARD, "BLOCK_PIXEL": rt.pixel_items, "KNOTS": len(curves.knots), "TURNS": len(TURNS),
        }
        self._start = rt.kernel("dct_threshold", "dct_start", **defines)
        self._excess_of = rt.kernel("dct_threshold", "dct_excess", **defines)
        self._end = rt.kernel("dct_threshold", "dct_end", **defines)
        self._padded = padded_zeros(rt, nz * ny, nx)
        self._excess = padded_zeros(rt, nz * ny, nx)

    def __call__(
        self, volume: SameArray, unit: float, turn: int, *, nonnegative: bool, out: DeviceArray | None = None
    ) -> SameArray:
        """Maps a volume (z, y, x), float32; ``unit`` of the knots, in that of coefficients of the orthonormal transform.

        ``turn``, 0 to 3, chooses a quarter of the shifts. A device array gives a device array (``out``, if given)."""

        return on_device(self.rt, partial(self._map, unit, TURNS[turn], nonnegative), volume, out)

    def _map(
        self, unit: float, turn: Sequence[int], nonnegative: bool, volume: DeviceArray, result: DeviceArray
    ) -> None:
        rt, (nz, ny, nx) = self.rt, self.shape
        voxels, by_voxel = (nx, ny, nz), rt.group(on_cpu=16)
        layout = self._shape4, self._pitch
        rt.launch(self._start, voxels, volume, *layout, self._padded, self._excess, group=by_voxel)
        # Blocks of one launch do not overlap. On a GPU they are work-items, also along x; on a CPU a vector runs along x
        along_x = EDGE if rt.pixel_items else 1
        blocks = ceil_div(nx, EDGE) if rt.pixel_items else 1, ceil_div(ny, EDGE), ceil_div(nz, EDGE)
        for (z, y), x in itertools.product(enumerate(turn), range(along_x)):
            shift = np.array([x, y, z, 0], np.int32)
            arguments = self._padded, *layout, shift, self._curves, np.float32(unit), self._excess
            rt.launch(self._excess_of, blocks, *arguments, group=rt.group(), samples=_SAMPLES * nx * ny * nz)
        clip = np.int32(nonnegative)
        items = (ceil_div(nx, rt.lanes), ny, nz)
        rt.launch(self._end, items, volume, self._excess, *layout, clip, result, group=rt.group(on_cpu=min(items[0], 8)))


def dct_prox(
    volume: np.ndarray, unit: float, turn: int, *, nonnegative: bool, curves: Curves = SOFT
) -> np.ndarray:
    """Float64 twin of ``DctProx``."""
    volume = np.asarray(volume, np.float64)
    if min(volume.shape) < EDGE:
        return np.asarray(np.maximum(volume, 0) if nonnegative else volume)
    blocks = np.lib.stride_tricks.sliding_window_view(volume, (EDGE,) * 3)
    losses = curves.losses(scipy.fft.dctn(blocks, axes=(3, 4, 5), norm="ortho"), unit)
    back = scipy.fft.idctn(losses, axes=(3, 4, 5), norm="ortho")
    z, y = (np.arange(count) % EDGE for count in blocks.shape[:2])
    taken = np.array(TURNS[turn])[z][:, None] == y
    excess, count = np.zeros_like(volume), np.zeros_like(volume)
    for k, j, i in itertools.product(range(EDGE), repeat=3):
        at = tuple(slice(o, o + n) for o, n in zip((k, j, i), blocks.shape[:3], strict=True))
        excess[at] += taken[:, :, None] * back[..., k, j, i]
        count[at] += 1
    shrunk: np.ndarray = volume - len(TURNS) * excess / count
    return np.maximum(shrunk, 0) if nonnegative else shrunk
