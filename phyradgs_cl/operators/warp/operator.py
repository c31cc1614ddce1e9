"""The system matrix of a moving object: A x = Σ_k P_k W_k x, summed over its states k, and its exact transpose.

W_k warps the volume x to state k. For an object that changes, x is a stack of volumes, and W_k takes volume k. P_k projects
the result to the time cells for which the state stands (``states.py``). A time cell (a pose with its lines) may also be a
blend of two states.

``FieldDerivative`` differentiates the frames A v by the displacement field w = Σ_r φ_r U_r. J is the derivative by the
coefficients d_r of the fields U_r. B maps coefficients to voxels. w_k is the field in state k, and ∇v the gradient of the
cubic spline through the volume:

    J d = Σ_k P_k (∇v(y + w_k) · Σ_r φ_r,k B d_r),    (Jᵀ p)_r = Bᵀ Σ_k φ_r,k ∇v(y + w_k) P_kᵀ p

y: the voxel centres. p: frames."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import scipy

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.fields.deformation import cubic, cubic_slope
from phyradgs_cl.operators.rays.layout import some_cells
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.operators.rays.subrays import SINGLE
from phyradgs_cl.operators.warp.states import MOST_STATES, MotionStates
from phyradgs_cl.operators.warp.volume import StateStack, TimeStates, VolumeWarp
from phyradgs_cl.runtime import DeviceArray, Runtime, SameArray

# One state more than MOST_STATES is allowed for every 12 frames: with many frames, warps take little of the time.
_FRAMES_PER_STATE = 12
_REACH = 2  # a cubic spline's coefficient acts up to this far, in voxels, as in cl/warp.cl
_BORDER = 4  # width in voxels around the volume in which coefficients are kept, as in cl/warp.cl
_SETTLES = 8  # width in voxels of the zero padding around ``_BORDER``, over which coefficients decay by a factor of 3e-5


class WarpedOperator:
    """Projects an object that moves, with the states of ``warp``: a ``LinearOperator``.

    Other arguments and arrays are those of ``RayOperator``. If ``warp`` is a ``StateStack``, volumes are stacks (K, nz, ny,
    nx). ``forward`` warps the volume once to each state that the operator's frames use. Operators with the same ``warp`` or
    ``memory`` share buffers: use them one at a time. Calls raise OutOfMemoryError if the whole volume does not fit on the
    device."""

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells], *,
        warp: VolumeWarp | StateStack, memory: RayMemory | None = None, subrays: tuple[int, int] = SINGLE,
    ) -> None:  # fmt: skip
        self.rt, self.grid, self.warp = rt, grid, warp
        self.volume_shape: tuple[int, ...] = warp.shape
        self.detector_shape = detector_shape
        self.memory = memory or RayOperator(rt, grid, detector_shape, tables, subrays=subrays).memory
        self._parts = [
            _Part(rt, state, frames, RayOperator(rt, grid, detector_shape, shared, memory=self.memory))
            for state, (frames, shared) in enumerate(_tables_by_state(tables, warp))
            if shared
        ]
        self.frames_shape = (len(tables), *detector_shape)

    def forward(self, volume: SameArray, out: DeviceArray | None = None) -> SameArray:
        """Projects a volume x (nz, ny, nx) in 1/mm to frames A x, (F, rows, columns) float32."""
        return self._on_device(self._forward, volume, self.frames_shape, out)

    def _forward(self, volume: DeviceArray, frames: DeviceArray) -> None:
        source = self.warp.source(volume)
        self.project(lambda k: volume if self.warp.is_still(k) else self.warp.forward(k, source), frames)

    def project(self, volume_of: Callable[[int], DeviceArray], frames: DeviceArray) -> None:
        """Projects all states to frames (F, rows, columns): Σ_k P_k v_k. volume_of(k): state k's volume v_k (nz, ny, nx)."""
        self.rt.fill(frames, 0)
        for part in self._parts:
            part.operator.forward(volume_of(part.state), out=self.warp.stack.of(len(part.frames), self.detector_shape))
            self.warp.stack.add(part.places, frames)

    def backprojections(self, frames: DeviceArray) -> Iterator[tuple[int, DeviceArray]]:
        """Yields (k, P_kᵀ y): each state k that frames y (F, rows, columns) use, and their backprojection to it. Each volume
        (nz, ny, nx) is valid until the next one."""
        for part in self._parts:
            taken = self.warp.stack.take(frames, part.frames)
            yield part.state, part.operator.adjoint(taken, out=self.warp.moved())

    @property
    def states(self) -> list[int]:
        """The numbers of the states that this operator's frames need."""
        return [part.state for part in self._parts]

    def adjoint(self, frames: SameArray, out: DeviceArray | None = None) -> SameArray:
        """Backprojects frames y (F, rows, columns) to a volume Aᵀ y, (nz, ny, nx) float32."""
        return self._on_device(self._adjoint, frames, self.volume_shape, out)

    def _adjoint(self, frames: DeviceArray, volume: DeviceArray) -> None:
        total = self.warp.zeros()
        for state, moved in self.backprojections(frames):
            self.warp.adjoint(state, moved, total)
        self.warp.read(total, volume)

    def _on_device(
        self, function: Callable[[DeviceArray, DeviceArray], None], values: SameArray, shape: tuple[int, ...],
        out: DeviceArray | None,
    ) -> SameArray:  # fmt: skip
        """Calls ``function(values, result)`` with device arrays. Returns the result on the side where ``values`` are. Raises
        OutOfMemoryError if the whole volume does not fit on the device."""
        if (bricks := len(self.memory.plan())) > 1:
            found = f"room for the volume in {bricks} bricks"
            expected = "room for the whole volume, which an object that moves needs"
            raise OutOfMemoryError("device memory", found, expected, "allow more with --memory")
        is_there = isinstance(values, DeviceArray)
        result = self.rt.empty(shape) if out is None else out
        function(values if isinstance(values, DeviceArray) else self.rt.upload(values, np.float32), result)
        return cast(SameArray, result if is_there else self.rt.download(result))

    def subset(self, frames: Sequence[int]) -> "WarpedOperator":
        """Returns the operator to the frames with the numbers ``frames``, in that order. Keep it for further use, because
        its tables take time to upload."""
        chosen = np.asarray(frames, np.int64)
        part = copy(self)
        part._parts = [piece for each in self._parts if (piece := each.subset(self.rt, chosen)) is not None]
        part.frames_shape = (len(chosen), *self.detector_shape)
        return part

    @property
    def holds(self) -> tuple[int, int]:
        """The numbers of volumes and of stacks of frames on the device, besides ``memory`` and the displacement fields."""
        return self.warp.volumes, 1


class _Part:
    """The projector P_k of one state, and the numbers ``frames`` (n,) of the operator's frames that need it."""

    def __init__(self, rt: Runtime, state: int, frames: np.ndarray, operator: RayOperator) -> None:
        self.state, self.frames, self.operator = state, frames, operator
        self.places = rt.upload(frames, np.int32)

    def subset(self, rt: Runtime, chosen: np.ndarray) -> "_Part | None":
        """Returns this state's part of the frames with the numbers ``chosen``, or None if none of them needs the state."""
        position = np.full(max(int(chosen.max()), int(self.frames.max())) + 1, -1)
        position[self.frames] = np.arange(len(self.frames))
        own = position[chosen]
        uses = np.flatnonzero(own >= 0)
        return _Part(rt, self.state, uses, self.operator.subset(own[uses])) if uses.size else None


def projector_of(
    rt: Runtime, grid: Grid, tables: Sequence[TimeCells], deformation: Deformation | None,
    state_times_s: np.ndarray | None = None,
) -> Callable[..., RayOperator | WarpedOperator]:
    """Returns a function that makes projectors from the arguments of ``RayOperator``: at rest ``RayOperator`` itself.

    deformation: how the object moves. state_times_s (K,): for an object that changes instead, the times in s of its volumes.
    Each time cell of ``tables`` takes the nearest state. A blend of two states would blur and project most cells twice."""
    if state_times_s is not None:
        return partial(WarpedOperator, warp=StateStack(rt, grid.shape, TimeStates(state_times_s)))
    if deformation is None:
        return RayOperator
    times_s = np.concatenate([table.time_s for table in tables])
    most = MOST_STATES + len(tables) // _FRAMES_PER_STATE
    states = MotionStates.of_times(deformation, grid, times_s, blends=False, most=most)
    return RayOperator if states.is_at_rest else partial(WarpedOperator, warp=VolumeWarp(rt, states))


def _tables_by_state(
    tables: Sequence[TimeCells], warp: VolumeWarp | StateStack
) -> list[tuple[np.ndarray, list[TimeCells]]]:
    """Returns for each state the numbers of the frames that need it, and their tables with only the cells of this state."""
    ends = np.cumsum([table.count for table in tables])[:-1]
    shares = np.split(warp.states.shares(np.concatenate([table.time_s for table in tables])), ends)
    by_state = []
    for state in range(warp.states.count):
        shared = [_with_share(table, share[:, state]) for table, share in zip(tables, shares, strict=True)]
        frames = np.flatnonzero([table is not None for table in shared])
        by_state.append((frames, [table for table in shared if table is not None]))
    return by_state


def _with_share(table: TimeCells, share: np.ndarray) -> TimeCells | None:
    cells = np.flatnonzero((share > 0) & (table.weight != 0) & (table.line_stop > table.line_start))
    if cells.size == 0:
        return None
    return replace(some_cells(table, cells), weight=table.weight[cells] * share[cells])


class FieldDerivative:
    """The derivative J of the frames by the displacement field of ``operator``, at a volume (nz, ny, nx) in 1/mm. Which
    state stands for which time is taken as fixed.

    Coefficients (R, cz, cy, cx, 3) are in mm, as in ``Deformation``. Keeps three volumes per state on the host."""

    def __init__(self, operator: WarpedOperator, volume: np.ndarray) -> None:
        assert isinstance(operator.warp, VolumeWarp)
        self.operator, states = operator, operator.warp.states
        self.weights = states.weights
        self._bases = [matrix.astype(np.float32) for matrix in states.deformation.bases(operator.grid)]
        voxel_mm = np.array(operator.grid.voxel_size_mm[::-1])
        self._fields_mm = states.fields_mm
        displacements = {k: np.tensordot(self.weights[k], states.fields_mm, 1) / voxel_mm for k in operator.states}
        per_mm = (1 / voxel_mm).astype(np.float32)
        self.slopes = {k: warp_slopes(volume, displacement) * per_mm for k, displacement in displacements.items()}

    def forward(self, change_mm: np.ndarray) -> np.ndarray:
        """Returns the frames' change J d (F, rows, columns) float32 for a change d (R, cz, cy, cx, 3) of coefficients."""
        fields_mm = np.stack([self._on_grid(one) for one in change_mm])
        return self._projected(lambda k: np.tensordot(self.weights[k].astype(np.float32), fields_mm, 1))

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        """Returns the transpose of ``forward``, Jᵀ y (R, cz, cy, cx, 3) float64, for frames y (F, rows, columns)."""
        rt = self.operator.rt
        by_field = np.zeros_like(self._fields_mm)
        for k, volume in self.operator.backprojections(rt.upload(frames, np.float32)):
            pulled = self.slopes[k] * rt.download(volume)[..., None]
            for r, weight in enumerate(self.weights[k].astype(np.float32)):
                by_field[r] += weight * pulled
        along_z, along_y, along_x = self._bases
        return np.stack([
            np.einsum("zk,yl,xm,zyxi->klmi", along_z, along_y, along_x, one, optimize=True) for one in by_field
        ]).astype(np.float64)  # fmt: skip

    def by_weights(self) -> np.ndarray:
        """Returns d(frames)/d(φ_r), (R, F, rows, columns) float32, for a weight φ_r that changes equally at all times."""
        return np.stack([self._projected(dict.fromkeys(self.slopes, field).__getitem__) for field in self._fields_mm])

    def _projected(self, field_of: Callable[[int], np.ndarray]) -> np.ndarray:
        rt = self.operator.rt
        frames = rt.empty(self.operator.frames_shape)

        def volume_of(k: int) -> DeviceArray:
            return rt.upload(np.einsum("zyxi,zyxi->zyx", self.slopes[k], field_of(k)), np.float32)

        self.operator.project(volume_of, frames)
        return rt.download(frames)

    def _on_grid(self, control_mm: np.ndarray) -> np.ndarray:
        along_z, along_y, along_x = self._bases
        values = np.einsum("zk,yl,xm,klmi->zyxi", along_z, along_y, along_x, control_mm.astype(np.float32), optimize=True)
        return np.asarray(values)


def warp_slopes(volume: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Returns the gradients ∇v(y + w(y)), (nz, ny, nx, 3) float32, along x, y, z per voxel, at voxel centres y. v is the
    cubic spline through a volume (nz, ny, nx), and 0 outside. displacement: w (nz, ny, nx, 3) in voxels, x, y, z."""
    wide = scipy.ndimage.spline_filter(np.pad(volume, _BORDER + _SETTLES), output=np.float32)
    padded = np.ascontiguousarray(wide[(slice(_SETTLES, -_SETTLES),) * 3])
    strides = (padded.shape[1] * padded.shape[2], padded.shape[2], 1)
    corner, weights, slopes, is_inside = np.int64(0), [], [], np.bool_(True)
    for axis, (side, stride) in enumerate(zip(volume.shape, strides, strict=True)):
        index = np.arange(side, dtype=np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
        wanted = index + displacement[..., 2 - axis].astype(np.float32)
        place = np.clip(wanted, -_REACH, side - 1 + _REACH)
        first = np.floor(place) + 1 - _REACH
        corner = corner + (first.astype(np.int64) + _BORDER) * stride
        distances = [place - first - tap for tap in range(2 * _REACH)]
        weights.append([cubic(distance) for distance in distances])
        slopes.append([cubic_slope(distance) for distance in distances])
        is_inside = is_inside & (place == wanted)
    flat, (wz, wy, wx), (dz, dy, dx) = padded.ravel(), weights, slopes
    total = np.zeros((3, *volume.shape), np.float32)
    for k, j in np.ndindex(2 * _REACH, 2 * _REACH):
        row = [flat[corner + np.dot((k, j, i), strides)] for i in range(2 * _REACH)]
        value = sum(weight * sample for weight, sample in zip(wx, row, strict=True))
        total[0] += wz[k] * wy[j] * sum(slope * sample for slope, sample in zip(dx, row, strict=True))
        total[1] += wz[k] * dy[j] * value
        total[2] += dz[k] * wy[j] * value
    return np.moveaxis(total * is_inside, 0, -1)
