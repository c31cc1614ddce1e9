"""The linear system A x = p of a scan under a motion model, as the iterative methods see it.

Its arrays lie on the device from the first iteration to the last where everything fits there (``resident``), else on the
host; a method does the same with both, through the system's ``space``.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.detector import noise_level, transmission_weights
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.operator import LinearOperator, RayOperator
from phyradgs_cl.reconstructors.voxels.ranks import Intensity, SharedIntensity, SharedOperator
from phyradgs_cl.runtime import DeviceSpace, HostSpace, MemoryShortage, Runtime, Space

log = logging.getLogger(__name__)

_SHORTEST_PATH = 0.1  # of the longest
_FAINTEST = 1e-6  # of the largest sum over a voxel's rays


@dataclass(frozen=True, eq=False)
class System:
    """Operator A and measurement p (F, rows, columns) float32; ``valid`` (F, rows, columns) or (rows, columns), 1 or 0;
    None: all pixels. Volumes (nz, ny, nx) and frames are arrays of ``space``.

    Pixels that are not valid are 0 in ``measured`` and in every residual, as if their rows were not in A.
    ``intensity`` is there where the detector adds photons: the measurement is then compared with I(x) instead of A x,
    and what comes back goes through Jᵀ, the derivative of I at the volume of the last comparison, instead of Aᵀ.
    ``transmission`` (F, rows, columns) weighs pixels by their transmission, mean 1; None: all alike.
    """

    operator: LinearOperator
    measured: Any
    valid: Any = None
    intensity: Intensity | None = None
    transmission: Any = None
    space: Space[Any] = HostSpace()

    @classmethod
    def of_scan(cls, rt: Runtime, scan: Scan, motion: Motion, detector_model: str = "log") -> "System":
        """The scan's frames with the cells of ``motion``; ``detector_model``: log, intensity, or the scan's own."""
        tables = [motion.cells(scan, f).still() for f in range(scan.frames)]
        operator: LinearOperator = RayOperator(rt, scan.grid, scan.geometry.detector_shape, tables)
        measured = np.asarray(scan.projections, np.float32)
        model = scan.detector_model if detector_model == "scan" else detector_model
        intensity: Intensity | None = None
        if model == "intensity" and any(table.averages for table in tables):  # of one value both are the mean
            every = IntensityOperator(rt, scan.grid, scan.geometry.detector_shape, tables)
            intensity = SharedIntensity(rt.ranks, every) if rt.ranks.size > 1 else every
        if rt.ranks.size > 1:
            operator = SharedOperator(rt.ranks, operator)
        if scan.pixel_mask is None:
            return cls(operator, measured, None, intensity)
        valid = np.asarray(scan.pixel_mask == 0)
        return cls(operator, np.where(valid, measured, np.float32(0)), valid, intensity)

    def resident(self, rt: Runtime, volumes: int, frames: int) -> "System":
        """The same on the device, where there is room for the operators and for so many volumes and stacks of all frames.

        Else the system itself, on the host: in bricks, and on ranks, which sum there.
        """
        operators = [o for o in (self.operator, self.intensity) if isinstance(o, (RayOperator, IntensityOperator))]
        if len(operators) < 1 + (self.intensity is not None):
            return self
        if isinstance(self.intensity, IntensityOperator):
            more_volumes, more_frames = self.intensity.holds
            volumes, frames = volumes + more_volumes, frames + more_frames
        volume_bytes, frames_bytes = 4 * math.prod(self.operator.volume_shape), self.measured.nbytes
        sizes_bytes = [volume_bytes] * volumes + [frames_bytes] * frames
        try:
            whole = all(o.memory.holds_all(self.frames) for o in operators)
        except MemoryShortage:
            whole = False
        if not (whole and rt.room().holds(*sizes_bytes)):
            log.info("the device has no room for all arrays of the method: they stay on the host")
            return self
        space = DeviceSpace(rt)
        valid, transmission = (None if a is None else space.array(a) for a in (self.valid, self.transmission))
        return replace(self, measured=space.array(self.measured), valid=valid, transmission=transmission, space=space)

    @property
    def frames(self) -> int:
        return int(self.measured.shape[0])

    @property
    def volume_shape(self) -> tuple[int, ...]:
        return self.operator.volume_shape

    def masked(self, frames: Any) -> Any:
        """Frames with 0 at the pixels that do not count."""
        return frames if self.valid is None else self.space.multiply(frames, self.valid)

    def forward(self, volume: Any) -> Any:
        """A x at the pixels that count."""
        return self._projected(self.operator.forward, volume)

    def adjoint(self, frames: Any) -> Any:
        """Aᵀ y of frames that are 0 where pixels do not count."""
        return self.space.apply(self.operator.adjoint, frames, self.volume_shape)

    def expected(self, volume: Any) -> Any:
        """What the detector would measure of x, at the pixels that count: A x, or I(x) in the intensity model."""
        return self._projected(self.operator.forward if self.intensity is None else self.intensity.expected, volume)

    def derivative(self, change: Any) -> Any:
        """What a change of the volume of the last ``expected`` or ``residual`` would change in it: A d, or J d."""
        return self._projected((self.operator if self.intensity is None else self.intensity).forward, change)

    def back(self, frames: Any) -> Any:
        """The transpose of ``derivative``: frames (0 where pixels do not count) to a volume by Aᵀ, or Jᵀ."""
        operator = self.operator if self.intensity is None else self.intensity
        return self.space.apply(operator.adjoint, frames, self.volume_shape)

    def residual(self, volume: Any) -> Any:
        """Measured less expected, dimensionless: p − A x, or p − I(x)."""
        return self.difference(self.measured, self.expected(volume))

    def difference(self, x: Any, y: Any) -> Any:
        """x − y."""
        return self.space.add(x, y, -1.0)

    def linearise_at(self, volume: Any) -> None:
        """Puts J where an interrupted run had it; A is the same everywhere."""
        if self.intensity is not None:
            self.expected(volume)

    def noise_norm(self) -> float:
        """The norm of the measurement's noise, estimated from it."""
        measured = self.space.numpy(self.measured)
        valid = None if self.valid is None else np.broadcast_to(self.space.numpy(self.valid) != 0, measured.shape)
        pixels = measured.size if valid is None else np.count_nonzero(valid)
        return float(noise_level(measured, valid) * np.sqrt(pixels))

    def row_sums(self) -> Any:
        """A 1 in mm: the length of every ray in the volume."""
        return self.forward(self.space.full(self.volume_shape, 1.0))

    def column_sums(self) -> Any:
        """Aᵀ 1 in mm over the pixels that count, or Aᵀ t with transmission weights."""
        return self.adjoint(self.masked(self.apply_weights(self.space.full(self.measured.shape, 1.0))))

    def apply_weights(self, frames: Any) -> Any:
        """Frames times their transmission weights, where there are any."""
        return frames if self.transmission is None else self.space.multiply(frames, self.transmission)

    def transmission_weighted(self) -> "System":
        """The same system, on the host, its pixels weighted by their transmission (PWLS)."""
        return replace(self, transmission=transmission_weights(self.measured, self.valid))

    def subset(self, frames: Sequence[int]) -> "System":
        """The system of some frames."""
        chosen = list(frames)
        valid = self.valid
        if valid is not None and len(valid.shape) == 3:
            valid = self.space.take(valid, chosen)
        return replace(
            self,
            operator=self.operator.subset(chosen),
            measured=self.space.take(self.measured, chosen),
            valid=valid,
            intensity=None if self.intensity is None else self.intensity.subset(chosen),
            transmission=None if self.transmission is None else self.space.take(self.transmission, chosen),
        )

    def _projected(self, function: Callable[..., Any], volume: Any) -> Any:
        return self.masked(self.space.apply(function, volume, self.operator.frames_shape))


def row_weights(system: System) -> Any:
    """1/(A 1) of every ray, 1/mm, at most that of a ray through a tenth of the longest path; times its transmission weight.

    A ray that only grazes an edge of the volume would else put its whole noise on a voxel or two, and bright corners
    are what one sees of it. TIGRE measures the paths in a box that is a tenth larger, to the same end.
    """
    return system.apply_weights(system.space.reciprocal(system.row_sums(), _SHORTEST_PATH))


def column_weights(system: System) -> Any:
    """1/(Aᵀ 1) of every voxel, 1/mm; 0 where no ray goes."""
    return system.space.reciprocal(system.column_sums(), _FAINTEST)
