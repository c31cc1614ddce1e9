"""The linear system A x = p of a scan under a motion model, for the iterative methods.

Its arrays are on the device if all fit there (``resident``), else on the host. The system's ``space`` computes with arrays
of either kind. Each rank (MPI process) projects its own frames; then all frames are gathered, and volumes summed."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.detector import noise_level, transmission_weights
from phyradgs_cl.fields import Deformation
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.operator import LinearOperator, RayOperator
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.operators.warp.operator import WarpedOperator, projector_of
from phyradgs_cl.parallel import Communicator, exact_sum, span
from phyradgs_cl.runtime import DeviceSpace, HostSpace, MemoryShortage, Runtime, Space

log = logging.getLogger(__name__)

_SHORTEST_PATH = 0.1  # a ray's path counts as at least this fraction of the longest: division by less amplifies noise
_FAINTEST = 1e-6  # the sum of path lengths in a voxel that rays meet counts as at least this fraction of the largest sum
_GROWTH = 1.2  # steps count as diverging if a pass's residual exceeds this many times the least residual of earlier passes


@dataclass(frozen=True, eq=False)
class System:
    """The operator A and the measurement p (F, rows, columns) float32 of a scan. Volumes (nz, ny, nx) and frames are arrays
    of ``space``.

    valid: (F, rows, columns) or (rows, columns), 1 or 0; None: all pixels are valid. Invalid pixels are 0 in ``measured``
    and in every residual, as if A had no rows for them.

    intensity: set if the detector averages intensity. The measurement is then compared with I(x) in place of A x, and
    residuals go back through Jᵀ in place of Aᵀ; J is the derivative of I at the volume of the last comparison.

    transmission: (F, rows, columns) weights of pixels by their transmission, mean 1; None: equal weights."""

    operator: LinearOperator
    measured: Any
    valid: Any = None
    intensity: "IntensityOperator | SharedOperator | None" = None
    transmission: Any = None
    space: Space[Any] = HostSpace()

    @classmethod
    def of_scan(
        cls, rt: Runtime, scan: Scan, motion: Motion, detector_model: str = "log", *, fewest_lines: int | None = None,
        deformation: Deformation | None = None, state_times_s: np.ndarray | None = None, is_dense: bool = False,
    ) -> "System":  # fmt: skip
        """Returns the system of a scan under the motion model ``motion``. deformation: how the object moves. state_times_s
        (K,): times in s of an object that changes; volumes are then stacks (K, nz, ny, nx).

        detector_model: log, intensity, or scan for the scan's own. fewest_lines: how many lines a pose must serve for the
        fast kernels (``upright_of``), for an object at rest. is_dense: the first volume has the object's density already,
        so that a pixel needs fewer rays (``subrays_of``)."""
        tables = [motion.cells(scan, f).still() for f in range(scan.frames)]
        shape = scan.geometry.detector_shape
        projector = projector_of(rt, scan.grid, tables, deformation, state_times_s)
        lines = {} if fewest_lines is None else {"fewest_lines": fewest_lines}
        subrays = subrays_of(scan.grid, tables, is_dense=is_dense)
        operator: LinearOperator = projector(rt, scan.grid, shape, tables, subrays=subrays, **lines)
        measured = np.asarray(scan.projections, np.float32)
        model = scan.detector_model if detector_model == "scan" else detector_model
        intensity: IntensityOperator | SharedOperator | None = None
        # if every line has a single time, the detector models log and intensity are the same
        if model == "intensity" and any(table.averages for table in tables):
            intensity = IntensityOperator(rt, scan.grid, shape, tables, projector, subrays)
        if rt.ranks.size > 1:
            operator = SharedOperator(rt.ranks, operator)
            intensity = None if intensity is None else SharedOperator(rt.ranks, intensity)
        if scan.pixel_mask is None:
            return cls(operator, measured, None, intensity)
        valid = np.asarray(scan.pixel_mask == 0)
        return cls(operator, np.where(valid, measured, np.float32(0)), valid, intensity)

    def resident(self, rt: Runtime, volumes: int, frames: int) -> "System":
        """Returns the system with its arrays on the device, if that has room for the operators, ``volumes`` volumes, and
        ``frames`` arrays of all frames. Otherwise they stay on the host.

        They also stay on the host with several ranks, which sum on the host, and for a volume that is projected in parts."""
        kinds = RayOperator, WarpedOperator, IntensityOperator
        operators = [o for o in (self.operator, self.intensity) if isinstance(o, kinds)]
        if len(operators) < 1 + (self.intensity is not None):
            return self
        for operator in operators:
            # operators of moving objects, and of intensities, need further volumes and frames
            if not isinstance(operator, RayOperator):
                more_volumes, more_frames = operator.holds
                volumes, frames = volumes + more_volumes, frames + more_frames
        volume_bytes, frames_bytes = 4 * math.prod(self.operator.volume_shape), self.measured.nbytes
        sizes_bytes = [volume_bytes] * volumes + [frames_bytes] * frames
        try:
            is_whole = all(o.memory.holds_all(self.frames) for o in operators)
        except MemoryShortage:
            is_whole = False
        if not (is_whole and rt.room().holds(*sizes_bytes)):
            log.info("the device has no room for all arrays of the method: they stay on the host")
            return self
        space = DeviceSpace(rt)
        valid, transmission = (None if a is None else space.array(a) for a in (self.valid, self.transmission))
        return replace(self, measured=space.array(self.measured), valid=valid, transmission=transmission, space=space)

    def leave_room(self, rt: Runtime, nbytes: int) -> bool:
        """Frees the ray operators' buffers if they leave less than ``nbytes`` of the memory limit. Returns whether it freed
        them. The operators plan their buffers again at their next use."""
        operators = [o for o in (self.operator, self.intensity) if isinstance(o, RayOperator | IntensityOperator)]
        planned_bytes = sum(operator.memory.planned_bytes for operator in operators)
        if rt.ledger.limit_bytes - max(planned_bytes, rt.ledger.held_bytes) >= nbytes:
            return False
        for operator in operators:
            operator.memory.release()
        return True

    @property
    def frames(self) -> int:
        return int(self.measured.shape[0])

    @property
    def volume_shape(self) -> tuple[int, ...]:
        return self.operator.volume_shape

    def masked(self, frames: Any) -> Any:
        """Returns frames with 0 at invalid pixels."""
        return frames if self.valid is None else self.space.multiply(frames, self.valid)

    def forward(self, volume: Any) -> Any:
        """Returns the projections A x (F, rows, columns), 0 at invalid pixels."""
        return self._frames(self.operator.forward, volume)

    def _frames(self, function: Callable[..., Any], volume: Any) -> Any:
        # the frames before masking get no name, because a name would keep their memory in use
        return self.masked(function(volume, self.space.place(self.operator.frames_shape)))

    def adjoint(self, frames: Any) -> Any:
        """Returns the backprojection Aᵀ y (nz, ny, nx) of frames y that are 0 at invalid pixels."""
        return self.operator.adjoint(frames, self.space.place(self.volume_shape))

    def expected(self, volume: Any) -> Any:
        """Returns the expected measurement of x: A x or, in the intensity model, I(x); 0 at invalid pixels."""
        return self._frames(self.operator.forward if self.intensity is None else self.intensity.expected, volume)

    def derivative(self, change: Any) -> Any:
        """Returns the linear change of ``expected`` for a change d of its last volume: A d or, in the intensity model, with
        the Jacobian J of I at that volume, J d; 0 at invalid pixels."""
        return self._frames((self.intensity or self.operator).forward, change)

    def back(self, frames: Any) -> Any:
        """Returns the transpose of ``derivative``, Aᵀ y or Jᵀ y (nz, ny, nx), for frames y that are 0 at invalid pixels."""
        return (self.intensity or self.operator).adjoint(frames, self.space.place(self.volume_shape))

    def residual(self, volume: Any) -> Any:
        """Returns the residual p − A x or, in the intensity model, p − I(x), dimensionless; 0 at invalid pixels."""
        return self.space.add(self.measured, self.expected(volume), -1.0)

    def noise_norm(self) -> float:
        """Returns the norm of the measurement's noise over the valid pixels, estimated from the measurement."""
        measured = self.space.numpy(self.measured)
        valid = None if self.valid is None else np.broadcast_to(self.space.numpy(self.valid) != 0, measured.shape)
        pixels = measured.size if valid is None else np.count_nonzero(valid)
        return float(noise_level(measured, valid) * np.sqrt(pixels))

    def row_sums(self) -> Any:
        """Returns the length of every ray in the volume, A 1 (F, rows, columns) in mm; 0 at invalid pixels."""
        return self.forward(self.space.full(self.volume_shape, 1.0))

    def column_sums(self) -> Any:
        """Returns Aᵀ 1 (nz, ny, nx) in mm over the valid pixels; with transmission weights t, Aᵀ t."""
        return self.adjoint(self.masked(self.apply_weights(self.space.full(self.measured.shape, 1.0))))

    def apply_weights(self, frames: Any) -> Any:
        """Returns frames times their transmission weights; the frames themselves if there are none."""
        return frames if self.transmission is None else self.space.multiply(frames, self.transmission)

    def transmission_weighted(self) -> "System":
        """Returns the system, on the host, with pixels weighted by their transmission (PWLS)."""
        return replace(self, transmission=transmission_weights(self.measured, self.valid))

    def subset(self, frames: Sequence[int]) -> "System":
        """Returns the system of the frames with the numbers ``frames``, in the order given."""
        numbers, valid = list(frames), self.valid
        if valid is not None and len(valid.shape) == 3:
            valid = self.space.take(valid, numbers)
        return replace(
            self, operator=self.operator.subset(numbers), measured=self.space.take(self.measured, numbers),
            valid=valid, intensity=None if self.intensity is None else self.intensity.subset(numbers),
            transmission=None if self.transmission is None else self.space.take(self.transmission, numbers),
        )


def row_weights(system: System) -> Any:
    """Returns the inverse length 1/(A 1) of every ray in 1/mm, (F, rows, columns); 0 for rays beside the volume.

    A ray shorter than a tenth of the longest counts as that tenth. A ray that only grazes an edge of the volume would
    otherwise put its noise on one or two voxels, and corners of the volume would become bright. TIGRE measures paths in a
    box that is a tenth wider in x and y, to the same effect."""
    return system.space.reciprocal(system.row_sums(), _SHORTEST_PATH)


def column_weights(system: System) -> Any:
    """Returns 1/(Aᵀ 1) of every voxel, (nz, ny, nx) in 1/mm; 0 where no ray passes."""
    return system.space.reciprocal(system.column_sums(), _FAINTEST)


def spread_order(count: int) -> list[int]:
    """Returns the numbers 0 … count − 1, each far from the few before it: steps of about 0.618 ``count``, mod ``count``."""
    step = next(s for s in range(max(round(0.618 * count), 1), 2 * count + 1) if np.gcd(s, count) == 1)
    return [(i * step) % count for i in range(count)]


class OrderedSubsets:
    """A system divided into ``count`` subsets of every count-th frame, in an order that spreads them over the turn. H. M.
    Hudson and R. S. Larkin, IEEE Trans. Med. Imaging 13 (1994) 601."""

    def __init__(self, system: System, count: int) -> None:
        self.system, self.least_residual = system, float("inf")
        self.split(min(count, system.frames))

    def __iter__(self) -> Iterator[System]:
        return iter(self._systems)

    def __len__(self) -> int:
        return len(self._systems)

    def split(self, count: int) -> None:
        frames = self.system.frames
        self._systems = [self.system.subset(range(first, frames, count)) for first in spread_order(count)]

    def join_if_diverging(self, residual: float) -> bool:
        """Halves the number of subsets if their steps diverge: if the ``residual`` of a pass exceeds ``_GROWTH`` times the
        least residual of earlier passes. Returns whether it did."""
        diverges = residual > _GROWTH * self.least_residual and len(self) > 1
        if diverges:
            self.split(ceil_div(len(self), 2))
        self.least_residual = residual if diverges else min(self.least_residual, residual)
        return diverges


class SharedOperator:
    """A ``LinearOperator`` whose frames the ranks divide among them; ``whole``, another, is that of all frames.

    Volumes and frames are complete on every rank, so that methods do the same on each rank. The bits of a sum of volumes do
    not depend on the order of the ranks, only on which frames each rank projects."""

    def __init__(self, ranks: Communicator, whole: Any) -> None:
        self.ranks, self.whole = ranks, whole
        self.volume_shape, self.frames_shape = whole.volume_shape, whole.frames_shape
        run = span(self.frames_shape[0], ranks.size, ranks.rank)
        self._own = slice(run.start, run.stop)
        self._part = whole.subset(list(run)) if len(run) else None

    def forward(self, volume: np.ndarray, out: None = None) -> np.ndarray:
        """Projects a volume x (nz, ny, nx) in 1/mm to frames A x, (F, rows, columns) float32, in new memory of the host."""
        return self._gathered(None if self._part is None else self._part.forward(volume))

    def adjoint(self, frames: np.ndarray, out: None = None) -> np.ndarray:
        """Backprojects frames y (F, rows, columns) to a volume Aᵀ y, (nz, ny, nx) float32."""
        shape = (self.volume_shape[0], self.volume_shape[1] * self.volume_shape[2])
        parts = [] if self._part is None else [self._part.adjoint(frames[self._own]).reshape(shape)]
        return exact_sum(self.ranks, parts, shape, self.ranks.size).reshape(self.volume_shape)

    def expected(self, volume: np.ndarray, out: None = None) -> np.ndarray:
        """Returns the expected measurement I(x), (F, rows, columns) float32, of a volume x (nz, ny, nx) in 1/mm, if
        ``whole`` is an ``IntensityOperator``. From then on J is the derivative at x."""
        return self._gathered(None if self._part is None else self._part.expected(volume))

    def subset(self, frames: Sequence[int]) -> "SharedOperator":
        """Returns the operator of the frames with the numbers ``frames``, in this order, divided among the ranks again."""
        return SharedOperator(self.ranks, self.whole.subset(frames))

    def _gathered(self, part: np.ndarray | None) -> np.ndarray:
        no_frames = np.zeros((0, *self.frames_shape[1:]), np.float32)
        return self.ranks.allgather(no_frames if part is None else part)
