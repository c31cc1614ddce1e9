"""Evaluates Gaussians at the voxel centres of a grid, and differentiates the result by their parameters."""

import numpy as np

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.bricks import Shape, cut
from phyradgs_cl.operators.splats.binning import TileLists
from phyradgs_cl.operators.splats.layout import DeviceGaussians, split_coefficients
from phyradgs_cl.operators.splats.projector import DEFAULT_CUTOFF_SIGMA, GROUP_DEFINES, items_by_gaussian
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime, attempts
from phyradgs_cl.runtime.layout import GUARD, pad_rows, padded_zeros, pitch_of, unpad_rows

RECORD_FLOATS = 20  # number of floats that ``voxel_prepare`` writes for each Gaussian
SUM_FLOATS = 16  # number of floats for a Gaussian's sums over its voxels
_TILE = 8  # side of a tile in voxels; a CPU's tile spans whole rows along x
_DEPTH = 2  # number of voxels along z that a GPU's work-item computes; DEPTH in cl/voxel_forward.cl
_DEFAULT_BRICK_BYTES = 1 << 28  # most bytes of voxels that are computed at a time, by default


class Voxeliser:
    """Evaluates Gaussians at the voxel centres of grids with ``shape`` (nz, ny, nx), and differentiates the result."""

    def __init__(
        self, rt: Runtime, shape: tuple[int, int, int], *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA
    ) -> None:
        self.rt, self.shape = rt, shape
        nz, ny, nx = shape
        self.pitch = pitch_of(nx)
        self.cutoff2 = np.float32(cutoff_sigma**2)
        self.by_pixel = rt.pixel_items
        self.lists = TileLists(rt, *_tiles(rt, shape))
        self.tile = self.lists.tile
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self.volume = padded_zeros(rt, nz * ny, nx)
        self._index: tuple[Grid, DeviceArray] | None = None
        self._records = rt.empty(1)
        self._sums = rt.empty(1)
        self._extents = rt.empty(1, np.int32)
        self._prepare = rt.kernel("voxel_prepare", "voxel_prepare", IMAGE_GUARD=GUARD)
        self._forward = _forward(rt)
        backward = {"IMAGE_GUARD": GUARD, **GROUP_DEFINES[self.by_pixel]}
        self._backward = rt.kernel("voxel_backward", "voxel_backward", **backward)
        self._chain = rt.kernel("voxel_backward", "voxel_chain", **backward)

    def forward(
        self, gaussians: DeviceGaussians, grid: Grid, start: tuple[int, int, int] = (0, 0, 0)
    ) -> DeviceArray:
        """Evaluates the Gaussians on the voxels [start, start + shape) of ``grid``. Returns them with padded rows, in memory
        that is valid until the next call.

        The grid has the Gaussians' unit of length; ``start`` is (z, y, x). A part of a grid gets the same bits as the whole
        grid."""
        rt = self.rt
        self.prepare(gaussians, grid, start)
        self.lists.build(self._extents, gaussians.count, gaussians.stride)
        nz, ny, nx = self.shape
        x, y, z, _ = self.tile.tolist()
        rt.launch(
            self._forward, (nx, ny, ceil_div(nz, _DEPTH)) if self.by_pixel else self.lists.total,
            self._records, self.lists.tile_offsets, self.lists.splat_ids, self.lists.splat_ids.size,
            gaussians.count, self._shape4, self.pitch, self.tile, self.lists.tiles, self.cutoff2, self.volume,
            group=(x, y, z // _DEPTH) if self.by_pixel else 1, samples=self.lists.samples,
        )  # fmt: skip
        return self.volume

    def backward(
        self, gaussians: DeviceGaussians, grid: Grid, by_volume: DeviceArray, gradients: DeviceArray, *,
        add: bool, weight: float = 1.0,
    ) -> None:
        """Writes ``weight`` × dL/d(parameters) to ``gradients`` (13, stride), or adds it, from dL/d(volume) with padded
        rows. Call ``forward`` or ``prepare`` with the same Gaussians before."""
        rt = self.rt
        if self._sums.size < gaussians.stride * SUM_FLOATS:
            self._sums = rt.zeros(gaussians.stride * SUM_FLOATS)
        items, group = items_by_gaussian(rt, gaussians.count)
        rt.launch(
            self._backward, items, self._records, by_volume, self._shape4, self.pitch, gaussians.count,
            self.cutoff2, self._sums, group=group, samples=self.lists.samples,
        )  # fmt: skip
        rt.launch(
            self._chain, gaussians.stride // rt.lanes, gaussians.rows, self._sums, _pitch4(grid),
            gaussians.stride, add, np.float32(weight), gradients, group=rt.group(),
        )  # fmt: skip

    def prepare(self, gaussians: DeviceGaussians, grid: Grid, start: tuple[int, int, int]) -> None:
        """Finds the voxels that each Gaussian touches. ``forward`` begins with this; ``backward`` needs its results."""
        rt, stride = self.rt, gaussians.stride
        if self._records.size < stride * RECORD_FLOATS:
            self._records = rt.empty(stride * RECORD_FLOATS)
            self._extents = rt.empty(6 * stride, np.int32)
        rt.launch(
            self._prepare, stride // rt.lanes, gaussians.rows, self._index_of(grid), _pitch4(grid),
            np.array([*start[::-1], 0], np.int32), self._shape4, gaussians.count, stride, self.cutoff2,
            self._records, self._extents, group=rt.group(),
        )  # fmt: skip

    def _index_of(self, grid: Grid) -> DeviceArray:
        if self._index is None or self._index[0] != grid:
            self._index = grid, split_coefficients(self.rt, index_matrix(grid))
        return self._index[1]

    def voxelise(self, rows: np.ndarray, grid: Grid) -> np.ndarray:
        """Returns the volume (nz, ny, nx) float32 of parameter rows (11, G)."""
        volume = self.forward(DeviceGaussians.upload(self.rt, rows), grid)
        return unpad_rows(self.rt.download(volume), self.shape)

    def voxelise_adjoint(self, rows: np.ndarray, grid: Grid, by_volume: np.ndarray) -> np.ndarray:
        """Returns dL/d(rows), (11, G), for dL/d(volume), (nz, ny, nx)."""
        gaussians = DeviceGaussians.upload(self.rt, rows)
        self.forward(gaussians, grid)
        gradients = self.rt.zeros((13, gaussians.stride))
        self.backward(gaussians, grid, self.rt.upload(pad_rows(by_volume)), gradients, add=False)
        return self.rt.download(gradients)[:11, : gaussians.count]


def voxelise(
    rt: Runtime, rows: np.ndarray, grid: Grid, *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA,
    brick_bytes: int = _DEFAULT_BRICK_BYTES,
) -> np.ndarray:
    """Evaluates parameter rows (11, G) on a grid of any size, one part (brick) after the other. Returns the volume (nz, ny,
    nx) float32.

    brick_bytes: the bytes of voxels on the device at a time, or fewer if memory is short. The bits do not depend on it."""
    for attempt in attempts("voxeliser"):
        with attempt as share:
            volume = _in_bricks(rt, DeviceGaussians.upload(rt, rows), grid, cutoff_sigma, brick_bytes, share)
    return volume


def _in_bricks(
    rt: Runtime, gaussians: DeviceGaussians, grid: Grid, cutoff_sigma: float, brick_bytes: int, share: float
) -> np.ndarray:
    nx, records_bytes = grid.shape[2], 4 * gaussians.stride * (RECORD_FLOATS + 6)

    def needs(shape: Shape) -> tuple[int, ...]:
        nz, ny, _ = shape
        voxels_bytes = 4 * (2 * GUARD + nz * ny * pitch_of(nx))
        if voxels_bytes > brick_bytes and nz * ny > 1:
            return (room.free_bytes + 1,)  # rejects the shape: no buffer is larger than the free memory
        lists_bytes = TileLists.bytes(rt, int(np.prod(_tiles(rt, shape)[1])), gaussians.count)
        entries_bytes = lists_bytes  # a guess, since the number of list entries is known only after counting
        return voxels_bytes, lists_bytes, entries_bytes, records_bytes

    room = rt.room()
    volume = np.empty(grid.shape, np.float32)
    made: Voxeliser | None = None
    for brick in cut(grid.shape, (1, 1), needs, room, share):
        if made is None or made.shape != brick.shape:
            made = None  # frees the last Voxeliser's memory before the next one is made
            made = Voxeliser(rt, brick.shape, cutoff_sigma=cutoff_sigma)
            made.lists.waits = True  # lists differ between bricks, and the host waits for each brick anyway
        part = made.forward(gaussians, grid, brick.start)
        volume[brick.box] = unpad_rows(rt.download(part), brick.shape)
    return volume


def _tiles(rt: Runtime, shape: Shape) -> tuple[Shape, Shape]:
    """Returns the size and the number of the tiles of a volume with ``shape`` (nz, ny, nx), both along x, y, z."""
    nz, ny, nx = shape
    size = (pitch_of(nx), _TILE, _TILE)
    if rt.pixel_items:  # smaller tiles where a work-group must be small
        items = rt.group(1, _TILE**3 // _DEPTH, _forward(rt))
        size = _TILE, min(_TILE, items // _TILE), _DEPTH * max(items // _TILE**2, 1)
    x, y, z = size
    return size, (ceil_div(nx, x), ceil_div(ny, y), ceil_div(nz, z))


def _forward(rt: Runtime) -> Kernel:
    return rt.kernel("voxel_forward", "voxel_forward", BLOCK_PIXEL=rt.pixel_items, IMAGE_GUARD=GUARD)


def index_matrix(grid: Grid) -> np.ndarray:
    """Returns the matrix (3 · 4,) that maps a world point (x, y, z) in mm to voxel indices along x, y, z."""
    matrix = np.zeros((3, 4))
    for row, (first, d) in enumerate(zip(grid.first_centre_mm[::-1], grid.voxel_size_mm[::-1], strict=True)):
        matrix[row, row], matrix[row, 3] = 1 / d, -first / d
    return matrix.ravel()


def _pitch4(grid: Grid) -> np.ndarray:
    dz, dy, dx = grid.voxel_size_mm
    return np.array([dx, dy, dz, 0], np.float32)
