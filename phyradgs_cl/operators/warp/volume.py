"""Warps W_k of a volume to the states k of a moving object, and their exact transposes (cl/warp.cl). For an object that
changes, each state has its own volume, and W_k takes volume k from their stack."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.checks import ceil_div, few_sizes
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.runtime import DeviceArray, DeviceSpace, Kernel, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, move, pitch_of

# Width in voxels around the volume in which spline coefficients are kept, as in cl/warp.cl. Farther out they would be below
# 3e-3 of the voxels' values.
_BORDER = 4
_MOST_OWNED = 8  # most slices that a CPU's work-item sums; voxels near the border of two work-items are computed by both
_ITEMS_PER_UNIT = 4  # wanted work-items per compute unit, so that none waits long for the last
_HEADROOM = 64  # largest sum of weights that a voxel may receive: 4³, where a field contracts by 4 along each axis
_TOGETHER = 8, 8, 4  # box of voxels (x, y, z) that a GPU's work-group adds up in local memory
_SAMPLES = 16  # number of ray samples that take as long as reading a voxel's 4³ coefficients
_ADDED = 64  # number of ray samples that take as long as adding to a voxel's 4³ coefficients
_ROUNDING = 1e-3  # bounds of displacements along z are widened by this many voxels, to allow for rounding in float32


class VolumeWarp:
    """Warps a volume v to each state k of ``states``: (W_k v)(y) = v(y + w_k(y)), and 0 outside the volume.

    Interpolation by cubic splines hardly blurs. W_k = B_k F E pads the volume with zeros (E), solves for the spline's
    coefficients (F) and samples the spline (B_k). F is symmetric. The R displacement fields take the memory of 3 R volumes
    on the device; kernels sum them with a state's weights where needed. Results repeat bit for bit, because no sum depends
    on the order of work-items."""

    def __init__(self, rt: Runtime, states: MotionStates) -> None:
        self.rt, self.states, self.shape = rt, states, states.grid.shape
        fields = np.stack([states.fields_mm[..., i] / states.grid.voxel_size_mm[2 - i] for i in range(3)], 1)
        self._fields = rt.upload(np.pad(fields.ravel(), (0, GUARD)), np.float32)
        self._shares = [rt.upload(weights, np.float32) for weights in states.weights]
        self._floats, self._strides = self._layout()
        self._source: DeviceArray | None = None
        self._total: DeviceArray | None = None
        self._moved: DeviceArray | None = None
        self._sums: DeviceArray | None = None
        self._space = DeviceSpace(rt)
        self.stack = FrameStack(rt, self.kernel("add_frames"))
        self._reaches: dict[int, tuple[DeviceArray, DeviceArray]] = {}

    volumes = 4  # most volumes that a warp holds on the device, besides the displacement fields

    def is_still(self, state: int) -> bool:
        """Returns whether the warp to state k = ``state`` displaces nothing."""
        return self.states.is_still(state)

    def source(self, volume: DeviceArray) -> DeviceArray:
        """Returns the spline coefficients F E v of a volume v (nz, ny, nx): E pads, F filters. Valid until the next call."""
        if self._source is None:
            self._source = self.rt.empty(self._floats)
        self.rt.fill(self._source, 0)
        move(self.rt, (volume, Strides.plain(self.shape)), (self._source, self._strides), self.shape)
        self._filter(self._source)
        return self._source

    def _filter(self, values: DeviceArray) -> None:
        """Applies the spline filter F in place to a padded volume. Filters whole padded rows, since their zeros stay 0."""
        nz, ny, nx = (n + 2 * _BORDER for n in self.shape)
        slice_, row = self._strides.slice, self._strides.row
        start = np.int64(self._strides.start - _BORDER * (slice_ + row + 1))
        along, across = self.kernel("spline_along_x"), self.kernel("spline_across_x")
        group, lanes = self.rt.group(), self.rt.lanes
        self.rt.launch(along, nz * ny, values, start, np.int64(row), nz * ny, nx, group=group)
        for width, planes, step, length in ((row, nz, row, ny), (slice_, 1, slice_, nz)):
            sides = np.int64(width), np.int64(slice_), np.int64(step), length
            self.rt.launch(across, (width // lanes, planes), values, start, *sides, group=group)

    def forward(self, state: int, source: DeviceArray) -> DeviceArray:
        """Returns a state's warped volume W_k v (nz, ny, nx) from coefficients ``source``. Valid until the next call."""
        nz, ny, nx = self.shape
        result, blocks = self.moved(), ceil_div(nx, self.rt.lanes)
        self.rt.launch(
            self.kernel("warp_forward"), (blocks, ny, nz), source, self._strides.vector(), self._fields,
            self._shares[state], self._size(), result, group=self.rt.group(on_cpu=few_sizes(blocks, 8)),
            samples=_SAMPLES * nz * ny * nx,
        )  # fmt: skip
        return result

    def moved(self) -> DeviceArray:
        """Returns the memory for the volume (nz, ny, nx) of one state, the same in every call. Vectors may read beyond its
        end, where zeros are."""
        if self._moved is None:
            self._moved = self.rt.zeros(int(np.prod(self.shape)) + GUARD)
        return DeviceArray(self._moved.buffer, self.shape, self._moved.dtype)

    def zeros(self) -> DeviceArray:
        """Returns zeros in the layout of the spline coefficients. The memory is valid until the next call."""
        if self._total is None:
            self._total = self.rt.empty(self._floats)
        self.rt.fill(self._total, 0)
        return self._total

    def adjoint(self, state: int, moved: DeviceArray, total: DeviceArray) -> None:
        """Adds a volume v of state k, by the transpose B_kᵀ of sampling the spline, to the coefficients ``total``. v is in
        the memory that ``moved`` returned."""
        if self.rt.pixel_items:
            self._adjoint_fixed(state, moved, total)
            return
        if state not in self._reaches:
            self._reaches[state] = self._reach(state)
        slices, rows = self._reaches[state]
        owned = min(max(self.shape[0] // (_ITEMS_PER_UNIT * self.rt.device.compute_units), 1), _MOST_OWNED)
        self.rt.launch(
            self.kernel("warp_adjoint_rows"), ceil_div(self.shape[0] + 2 * _BORDER, owned), moved, self._fields,
            self._shares[state], self._size(), slices, rows, owned, self._strides.vector(), total,
        )  # fmt: skip

    def read(self, total: DeviceArray, result: DeviceArray) -> None:
        """Filters the coefficients ``total`` that ``adjoint`` has summed (F), removes the padding (Eᵀ), and writes the
        volume (nz, ny, nx) to ``result``. Destroys ``total``."""
        self._filter(total)
        move(self.rt, (total, self._strides), (result, Strides.plain(self.shape)), self.shape)

    def _adjoint_fixed(self, state: int, moved: DeviceArray, total: DeviceArray) -> None:
        """Does in integers what ``adjoint`` does, since sums of integers do not depend on the order. The largest voxel
        becomes 2³¹ / ``_HEADROOM``, so rounding is as fine as float32's."""
        largest = self._space.largest(moved, absolute=True)
        if not largest > 0:
            return
        nz, ny, nx = self.shape
        if self._sums is None:
            self._sums = self.rt.empty(self._floats, np.int32)
        self.rt.fill(self._sums, 0)
        unit = largest * _HEADROOM / 2**31
        kernel = self.kernel("warp_adjoint_fixed")
        self.rt.launch(
            kernel, (nx, ny, nz), moved, self._fields, self._shares[state], self._size(),
            np.float32(1 / unit), self._strides.vector(), self._sums, group=_TOGETHER, samples=_ADDED * nz * ny * nx,
        )  # fmt: skip
        sums = self._sums, np.float32(unit), np.int64(self._floats), total
        self.rt.launch(self.kernel("warp_adjoint_sum"), self._floats, *sums, group=self.rt.group())

    def kernel(self, name: str) -> Kernel:
        return self.rt.kernel("warp", name, RANK=len(self.states.fields_mm))

    def _layout(self) -> tuple[int, Strides]:
        nz, ny, nx = self.shape
        slice_ = (ny + 2 * _BORDER) * pitch_of(nx)
        strides = Strides(GUARD + _BORDER * (slice_ + pitch_of(nx)), slice_, pitch_of(nx))
        return 2 * GUARD + (nz + 2 * _BORDER) * slice_, strides

    def _size(self) -> np.ndarray:
        return np.array([*self.shape[::-1], 0], np.int32)

    def _reach(self, state: int) -> tuple[DeviceArray, DeviceArray]:
        """Returns the smallest and largest displacement along z in voxels, for each slice (nz, 2) and row (nz, ny, 2)."""
        fields = (self.states.fields_mm[..., 2] / self.states.grid.voxel_size_mm[0]).astype(np.float32)
        along_z = np.tensordot(self.states.weights[state].astype(np.float32), fields, 1)
        rows = np.stack([along_z.min(-1) - _ROUNDING, along_z.max(-1) + _ROUNDING], -1)
        slices = np.stack([rows[..., 0].min(1), rows[..., 1].max(1)], -1)
        return self.rt.upload(slices, np.float32), self.rt.upload(rows, np.float32)


@dataclass(frozen=True, eq=False)
class TimeStates:
    """States of an object at times_s (K,), rising. At any other time the object is as in the nearest state."""

    times_s: np.ndarray

    @property
    def count(self) -> int:
        return len(self.times_s)

    def shares(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the fractions of the states (T, K) at times (T,) in s: 1 for the nearest, else 0."""
        borders_s = (self.times_s[1:] + self.times_s[:-1]) / 2
        return np.asarray(np.eye(self.count)[np.searchsorted(borders_s, times_s, "right")])


class StateStack:
    """Takes states from a stack x (K, nz, ny, nx): W_k x = x_k. Stands in for ``VolumeWarp``, for an object that changes."""

    volumes = 2  # most stacks x that the device holds

    def __init__(self, rt: Runtime, volume_shape: tuple[int, int, int], states: TimeStates) -> None:
        self.rt, self.states, self.shape = rt, states, (states.count, *volume_shape)
        self._one_shape, self._voxels = volume_shape, int(np.prod(volume_shape))
        self._one = rt.zeros(self._voxels + GUARD)
        self._total: DeviceArray | None = None
        self.stack = FrameStack(rt, rt.kernel("warp", "add_frames", RANK=1))

    def is_still(self, state: int) -> bool:
        """Returns False, because every state, moved or not, is copied from the stack."""
        return False

    def source(self, stack: DeviceArray) -> DeviceArray:
        return stack

    def forward(self, state: int, source: DeviceArray) -> DeviceArray:
        """Returns volume ``state`` (nz, ny, nx) of the stack ``source``. The memory is valid until the next call."""
        self.rt.copy(source, self._one, nbytes=4 * self._voxels, source_offset=4 * self._voxels * state)
        return self.moved()

    def moved(self) -> DeviceArray:
        """Returns the memory for the volume (nz, ny, nx) of one state, the same in every call. Vectors may read beyond its
        end, where zeros are."""
        return DeviceArray(self._one.buffer, self._one_shape, self._one.dtype)

    def zeros(self) -> DeviceArray:
        """Returns a stack (K, nz, ny, nx) of zeros. The memory is valid until the next call."""
        if self._total is None:
            self._total = self.rt.empty(self.shape)
        self.rt.fill(self._total, 0)
        return self._total

    def adjoint(self, state: int, moved: DeviceArray, total: DeviceArray) -> None:
        """Writes a volume v of state k to volume k = ``state`` of ``total``. Called once per state, it need not add."""
        self.rt.copy(moved, total, nbytes=4 * self._voxels, target_offset=4 * self._voxels * state)

    def read(self, total: DeviceArray, result: DeviceArray) -> None:
        """Copies the stack ``total`` to ``result``."""
        self.rt.copy(total, result)


class FrameStack:
    """Device memory for a stack of frames, used for the frames of one state after the other."""

    def __init__(self, rt: Runtime, add: Kernel) -> None:
        self.rt, self._add = rt, add
        self._memory: DeviceArray | None = None
        self._shape: tuple[int, ...] = ()

    def of(self, count: int, detector_shape: tuple[int, int]) -> DeviceArray:
        """Returns memory for ``count`` frames with ``detector_shape``, valid until the next call."""
        self._shape = (count, *detector_shape)
        if self._memory is None or self._memory.size < np.prod(self._shape):
            self._memory = self.rt.empty(self._shape)
        return DeviceArray(self._memory.buffer, self._shape, self._memory.dtype)

    def take(self, frames: DeviceArray, chosen: np.ndarray) -> DeviceArray:
        """Returns a copy of the frames ``chosen`` of a stack (F, rows, columns), valid until the next call."""
        taken = self.of(len(chosen), (frames.shape[1], frames.shape[2]))
        each = taken.nbytes // len(chosen)
        for k, frame in enumerate(chosen.tolist()):
            self.rt.copy(frames, taken, nbytes=each, source_offset=frame * each, target_offset=k * each)
        return taken

    def add(self, places: DeviceArray, frames: DeviceArray) -> None:
        """Adds the frames that ``of`` or ``take`` returned last to those of ``frames`` with the numbers ``places`` (n,)."""
        assert self._memory is not None
        count, pixels = self._shape[0], int(np.prod(self._shape[1:]))
        group = self.rt.group(on_cpu=few_sizes(pixels, 64))
        self.rt.launch(self._add, (pixels, count), self._memory, places, pixels, frames, group=group)
