"""Shrinkage of all 4³ block cosine transforms: a prior for textures and edges that total variation flattens.

argmin of a sparsity term by soft threshold of an overcomplete transform: B_sᵀ T(B_s v), averaged over the shifts s of the
blocks (Coifman and Donoho, "Translation-invariant de-noising", 1995; block DCT: Guleryuz, IEEE Trans. Image Process. 16
(2007) 3020). A block's mean is not shrunk. Near faces the average is over the blocks that lie in the volume.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.fft

from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, padded_zeros, pitch_of

EDGE = 4


class DctProx:
    """The map for volumes of a fixed ``shape`` (z, y, x); a volume thinner than a block is left as it is."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int]) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self._shape4, self._pitch = np.array([nx, ny, nz, 0], np.int32), np.int32(pitch_of(nx))
        self._start = rt.kernel("dct_threshold", "dct_start", IMAGE_GUARD=GUARD)
        self._excess_of = rt.kernel("dct_threshold", "dct_excess", IMAGE_GUARD=GUARD, BLOCK_PIXEL=rt.pixel_items)
        self._end = rt.kernel("dct_threshold", "dct_end", IMAGE_GUARD=GUARD)
        self._padded = padded_zeros(rt, nz * ny, nx)
        self._excess = padded_zeros(rt, nz * ny, nx)

    def __call__(self, volume: DeviceArray, threshold: float, *, nonnegative: bool, result: DeviceArray) -> None:
        """The map of ``volume`` (z, y, x) float32 into ``result``, which may be the same; ``threshold`` in its unit."""
        rt, (nz, ny, nx) = self.rt, self.shape
        voxels, by_voxel = (nx, ny, nz), rt.group(on_cpu=16)
        rt.launch(
            self._start, voxels, volume, self._shape4, self._pitch, self._padded, self._excess, group=by_voxel
        )
        blocks_y, blocks_z = -(-ny // EDGE), -(-nz // EDGE)
        blocks_x = -(-nx // EDGE) if rt.pixel_items else 1
        for shift in itertools.product(range(EDGE), range(EDGE), range(EDGE if rt.pixel_items else 1)):
            rt.launch(
                self._excess_of,
                (blocks_x, blocks_y, blocks_z),
                self._padded,
                self._shape4,
                self._pitch,
                np.array([*shift[::-1], 0], np.int32),
                np.float32(threshold),
                self._excess,
                group=rt.group(),
            )
        rt.launch(
            self._end, voxels, volume, self._excess, self._shape4, self._pitch, np.int32(nonnegative), result,
            group=by_voxel,
        )  # fmt: skip


def dct_prox(volume: np.ndarray, threshold: float, *, nonnegative: bool) -> np.ndarray:
    """Float64 twin of ``DctProx``."""
    volume = np.asarray(volume, np.float64)
    if min(volume.shape) < EDGE:
        return np.maximum(volume, 0) if nonnegative else volume
    blocks = np.lib.stride_tricks.sliding_window_view(volume, (EDGE,) * 3)
    kept = np.clip(scipy.fft.dctn(blocks, axes=(3, 4, 5), norm="ortho"), -threshold, threshold)
    kept[..., 0, 0, 0] = 0
    back = scipy.fft.idctn(kept, axes=(3, 4, 5), norm="ortho")
    excess, count = np.zeros_like(volume), np.zeros_like(volume)
    for k, j, i in itertools.product(range(EDGE), repeat=3):
        at = tuple(slice(o, o + n) for o, n in zip((k, j, i), blocks.shape[:3], strict=True))
        excess[at] += back[..., k, j, i]
        count[at] += 1
    shrunk = volume - excess / count
    return np.maximum(shrunk, 0) if nonnegative else shrunk
