"""Voxeliser: Gaussians to a voxel grid, and its adjoint."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.binning import TileLists
from phyradgs_cl.operators.layout import (
    GUARD,
    DeviceGaussians,
    pad_rows,
    padded_zeros,
    pitch_of,
    split_coefficients,
    unpad_rows,
)
from phyradgs_cl.operators.splat import DEFAULT_CUTOFF_SIGMA
from phyradgs_cl.runtime import DeviceArray, Runtime

RECORD_FLOATS = 20
SUM_FLOATS = 16
_TILE_ROWS = 8
_DEFAULT_BRICK_BYTES = 1 << 28


class Voxeliser:
    """Evaluates the field of Gaussians at the voxel centres of a grid of fixed ``shape`` (z, y, x)."""

    def __init__(
        self, rt: Runtime, shape: tuple[int, int, int], *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA
    ) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self.pitch = pitch_of(nx)
        self.cutoff2 = np.float32(cutoff_sigma**2)
        self.by_pixel = rt.pixel_items
        tile_x = 16 if self.by_pixel else self.pitch
        tile = (tile_x, _TILE_ROWS, _TILE_ROWS)
        self.tile = np.array([*tile, 0], np.int32)
        self.lists = TileLists(rt, tile, (-(-nx // tile_x), -(-ny // _TILE_ROWS), -(-nz // _TILE_ROWS)))
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self.volume = padded_zeros(rt, nz * ny, nx)
        self._records = rt.empty(1)
        self._sums = rt.empty(1)
        self._extents = rt.empty(1, np.int32)
        self._defines = {"IMAGE_GUARD": GUARD}

    def forward(
        self, gaussians: DeviceGaussians, grid: Grid, start: tuple[int, int, int] = (0, 0, 0)
    ) -> DeviceArray:
        """The field on the voxels [start, start + shape) of ``grid``, in the padded layout, until the next call.

        Lengths in the Gaussians' unit; ``start`` runs z, y, x. A part has the same bits as the whole.
        """
        rt = self.rt
        self._prepare(gaussians, grid, start)
        self.lists.build(self._extents, gaussians.count, gaussians.stride)
        kernel = rt.kernel("voxel_forward", "voxel_forward", BLOCK_PIXEL=int(self.by_pixel), **self._defines)
        nz, ny, _ = self.shape
        rt.launch(
            kernel,
            (self.pitch, ny, nz) if self.by_pixel else self.lists.total,
            self._records,
            self.lists.starts,
            self.lists.entries,
            self._shape4,
            np.int32(self.pitch),
            self.tile,
            self.lists.tiles,
            self.cutoff2,
            self.volume,
            group=16 if self.by_pixel else 1,
        )
        return self.volume

    def backward(
        self,
        gaussians: DeviceGaussians,
        grid: Grid,
        by_volume: DeviceArray,
        gradients: DeviceArray,
        *,
        add: bool,
        weight: float = 1.0,
    ) -> None:
        """``weight`` × dL/dparameters into (or, with ``add``, onto) ``gradients`` (13, stride); after ``forward``."""
        rt = self.rt
        rt.launch(
            rt.kernel("voxel_backward", "voxel_backward", **self._defines),
            gaussians.count,
            self._records,
            by_volume,
            self._shape4,
            np.int32(self.pitch),
            np.int32(gaussians.count),
            self.cutoff2,
            self._sums,
            group=rt.group(on_cpu=16),
        )
        rt.launch(
            rt.kernel("voxel_backward", "voxel_chain", **self._defines),
            gaussians.stride // rt.lanes,
            gaussians.rows,
            self._sums,
            _pitch4(grid),
            np.int32(gaussians.stride),
            np.int32(add),
            np.float32(weight),
            gradients,
            group=rt.group(),
        )

    def _prepare(self, gaussians: DeviceGaussians, grid: Grid, start: tuple[int, int, int]) -> None:
        rt, stride = self.rt, gaussians.stride
        if self._records.size < stride * RECORD_FLOATS:
            self._records = rt.empty(stride * RECORD_FLOATS)
            self._sums = rt.zeros(stride * SUM_FLOATS)
            self._extents = rt.empty(6 * stride, np.int32)
        rt.launch(
            rt.kernel("voxel_prepare", "voxel_prepare", **self._defines),
            stride // rt.lanes,
            gaussians.rows,
            split_coefficients(rt, index_matrix(grid)),
            _pitch4(grid),
            np.array([*start[::-1], 0], np.int32),
            self._shape4,
            np.int32(gaussians.count),
            np.int32(stride),
            self.cutoff2,
            self._records,
            self._extents,
            group=rt.group(),
        )

    def voxelise(self, rows: np.ndarray, grid: Grid) -> np.ndarray:
        """Parameter rows (11, G) to the volume (z, y, x) float32."""
        volume = self.forward(DeviceGaussians.upload(self.rt, rows), grid)
        return unpad_rows(self.rt.download(volume), self.shape)

    def voxelise_adjoint(self, rows: np.ndarray, grid: Grid, by_volume: np.ndarray) -> np.ndarray:
        """dL/drows (11, G) for dL/dvolume (z, y, x)."""
        gaussians = DeviceGaussians.upload(self.rt, rows)
        self.forward(gaussians, grid)
        gradients = self.rt.zeros((13, gaussians.stride))
        self.backward(gaussians, grid, self.rt.upload(pad_rows(by_volume)), gradients, add=False)
        return self.rt.download(gradients)[:11, : gaussians.count]


def voxelise(
    rt: Runtime,
    rows: np.ndarray,
    grid: Grid,
    *,
    cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA,
    brick_bytes: int = _DEFAULT_BRICK_BYTES,
) -> np.ndarray:
    """The whole grid (z, y, x) float32, slab by slab, so that the device holds ``brick_bytes`` of voxels at most."""
    nz, ny, nx = grid.shape
    slab = max(1, min(nz, brick_bytes // (4 * ny * pitch_of(nx))))
    volume = np.empty(grid.shape, np.float32)
    gaussians = DeviceGaussians.upload(rt, rows)
    voxelisers: dict[int, Voxeliser] = {}
    for start in range(0, nz, slab):
        shape = (min(slab, nz - start), ny, nx)
        if shape[0] not in voxelisers:
            voxelisers[shape[0]] = Voxeliser(rt, shape, cutoff_sigma=cutoff_sigma)
        part = voxelisers[shape[0]].forward(gaussians, grid, (start, 0, 0))
        volume[start : start + shape[0]] = unpad_rows(rt.download(part), shape)
    return volume


def index_matrix(grid: Grid) -> np.ndarray:
    """Rows (12,) that turn a world point (x, y, z) into voxel indices along x, y, z."""
    matrix = np.zeros((3, 4))
    for row, (first, d) in enumerate(zip(grid.first_centre_mm[::-1], grid.voxel_size_mm[::-1], strict=True)):
        matrix[row, row], matrix[row, 3] = 1 / d, -first / d
    return matrix.ravel()


def _pitch4(grid: Grid) -> np.ndarray:
    dz, dy, dx = grid.voxel_size_mm
    return np.array([dx, dy, dz, 0], np.float32)
