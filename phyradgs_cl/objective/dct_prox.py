"""Shrinks the cosine transforms of all blocks of 4³ voxels: a prior that keeps textures, which total variation flattens.

B_s v are the cosine transforms of the blocks that divide a volume v, shifted by s voxels. The result is the average of
B_sᵀ T(B_s v) over all s (Coifman and Donoho, "Translation-invariant de-noising", 1995; block DCT: Guleryuz, IEEE Trans.
Image Process. 16 (2007) 3020). T is a soft threshold that keeps each block's mean. Only blocks inside the volume count.

Each call uses a quarter of the shifts. Four successive calls use all of them (cycle spinning; Kamilov, Bostan and Unser,
IEEE Signal Process. Lett. 21 (2014) 1326)."""

import itertools

import numpy as np
import scipy

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.runtime import DeviceArray, Runtime, SameArray
from phyradgs_cl.runtime.layout import GUARD, beside, brought_to, padded_zeros, pitch_of

EDGE = 4  # voxels along each side of a block
_SAMPLES = 8  # a voxel takes as long as this many ray samples; ``launch`` divides launches of too many samples
# TURNS[turn][z]: the blocks' shift along y, in voxels, for their shift z along z. Four turns contain all 16 pairs once.
TURNS = ((0, 1, 2, 3), (1, 3, 0, 2), (2, 0, 3, 1), (3, 2, 1, 0))


class DctProx:
    """Shrinks the block cosine transforms of volumes of one ``shape`` (nz, ny, nx). Volumes thinner than a block (4 voxels)
    are not shrunk."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int]) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._shape4, self._pitch = np.array([nx, ny, nz, 0], np.int32), np.int32(pitch_of(nx))
        defines = {"IMAGE_GUARD": GUARD, "BLOCK_PIXEL": rt.pixel_items, "TURNS": len(TURNS)}
        self._start = rt.kernel("dct_threshold", "dct_start", **defines)
        self._excess_of = rt.kernel("dct_threshold", "dct_excess", **defines)
        self._end = rt.kernel("dct_threshold", "dct_end", **defines)
        self._padded = padded_zeros(rt, nz * ny, nx)
        self._excess = padded_zeros(rt, nz * ny, nx)

    def __call__(
        self, volume: SameArray, threshold: float, turn: int, *, nonnegative: bool, out: DeviceArray | None = None
    ) -> SameArray:
        """Returns the shrunk volume (nz, ny, nx) float32. threshold: by how much T shrinks coefficients of the orthonormal
        transform, in the volume's unit.

        turn: 0 to 3, chooses a quarter of the blocks' shifts. nonnegative: clips the result at 0. If ``volume`` is a device
        array, the result is one too (``out``, if given)."""
        rt, (nz, ny, nx) = self.rt, self.shape
        observed, result = beside(rt, volume, out)
        voxels, by_voxel = (nx, ny, nz), rt.group(on_cpu=16)
        layout = self._shape4, self._pitch
        rt.launch(self._start, voxels, observed, *layout, self._padded, self._excess, group=by_voxel)
        # No two work-items of a launch add to the same voxel, so results repeat bit for bit. A GPU's work-item takes one
        # block. A CPU's takes the blocks at all voxels along x.
        along_x = EDGE if rt.pixel_items else 1
        blocks = ceil_div(nx, EDGE) if rt.pixel_items else 1, ceil_div(ny, EDGE), ceil_div(nz, EDGE)
        for (z, y), x in itertools.product(enumerate(TURNS[turn]), range(along_x)):
            shift = np.array([x, y, z, 0], np.int32)
            arguments = self._padded, *layout, shift, np.float32(threshold), self._excess
            rt.launch(self._excess_of, blocks, *arguments, group=rt.group(), samples=_SAMPLES * nx * ny * nz)
        clip = np.int32(nonnegative)
        items = (ceil_div(nx, rt.lanes), ny, nz)
        rt.launch(self._end, items, observed, self._excess, *layout, clip, result, group=rt.group(on_cpu=min(items[0], 8)))
        return brought_to(rt, volume, result)


def dct_prox(volume: np.ndarray, threshold: float, turn: int, *, nonnegative: bool) -> np.ndarray:
    """Returns the shrunk volume (nz, ny, nx) float64: the NumPy twin of ``DctProx.__call__``, with the same arguments."""
    volume = np.asarray(volume, np.float64)
    if min(volume.shape) < EDGE:
        return np.asarray(np.maximum(volume, 0) if nonnegative else volume)
    blocks = np.lib.stride_tricks.sliding_window_view(volume, (EDGE,) * 3)
    losses = np.clip(scipy.fft.dctn(blocks, axes=(3, 4, 5), norm="ortho"), -threshold, threshold)
    losses[..., 0, 0, 0] = 0
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
