"""The linear system A x = p of a scan under a motion model, as the iterative methods see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.detector import transmission_weights
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.operator import LinearOperator, RayOperator
from phyradgs_cl.reconstructors.voxels.ranks import Intensity, SharedIntensity, SharedOperator
from phyradgs_cl.runtime import Runtime

_SHORTEST_PATH = 0.1  # of the longest


@dataclass(frozen=True, eq=False)
class System:
    """Operator A and measurement p (F, rows, columns) float32; ``valid`` (F, rows, columns) bool, None: all pixels.

    Pixels that are not valid are 0 in ``measured`` and in every residual, as if their rows were not in A.
    ``intensity`` is there where the detector adds photons: the measurement is then compared with I(x) instead of A x,
    and what comes back goes through Jᵀ, the derivative of I at the volume of the last comparison, instead of Aᵀ.
    ``transmission`` (F, rows, columns) weighs pixels by their transmission, mean 1; None: all alike.
    """

    operator: LinearOperator
    measured: np.ndarray
    valid: np.ndarray | None = None
    intensity: Intensity | None = None
    transmission: np.ndarray | None = None

    @classmethod
    def of_scan(cls, rt: Runtime, scan: Scan, motion: Motion, detector_model: str = "log") -> System:
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
        valid = np.broadcast_to(scan.pixel_mask == 0, measured.shape)
        return cls(operator, np.where(valid, measured, np.float32(0)), valid, intensity)

    @property
    def frames(self) -> int:
        return len(self.measured)

    def masked(self, frames: np.ndarray) -> np.ndarray:
        """Frames with 0 at the pixels that do not count."""
        return frames if self.valid is None else np.where(self.valid, frames, np.float32(0))

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x at the pixels that count."""
        return self.masked(self.operator.forward(volume))

    def expected(self, volume: np.ndarray) -> np.ndarray:
        """What the detector would measure of x, at the pixels that count: A x, or I(x) in the intensity model."""
        if self.intensity is None:
            return self.forward(volume)
        return self.masked(self.intensity.expected(volume))

    def derivative(self, change: np.ndarray) -> np.ndarray:
        """What a change of the volume of the last ``expected`` or ``residual`` would change in it: A d, or J d."""
        if self.intensity is None:
            return self.forward(change)
        return self.masked(self.intensity.forward(change))

    def back(self, frames: np.ndarray) -> np.ndarray:
        """The transpose of ``derivative``: frames (0 where pixels do not count) to a volume by Aᵀ, or Jᵀ."""
        return (self.operator if self.intensity is None else self.intensity).adjoint(frames)

    def residual(self, volume: np.ndarray) -> np.ndarray:
        """Measured less expected, dimensionless: p − A x, or p − I(x)."""
        return self.measured - self.expected(volume)

    def stand_at(self, volume: np.ndarray) -> None:
        """Puts J where an interrupted run had it; A is the same everywhere."""
        if self.intensity is not None:
            self.intensity.expected(volume)

    def row_sums(self) -> np.ndarray:
        """A 1 in mm: the length of every ray in the volume."""
        return self.forward(np.ones(self.operator.volume_shape, np.float32))

    def column_sums(self) -> np.ndarray:
        """Aᵀ 1 in mm over the pixels that count, or Aᵀ t with transmission weights."""
        return self.operator.adjoint(self.masked(self.weighed(np.ones(self.measured.shape, np.float32))))

    def weighed(self, frames: np.ndarray) -> np.ndarray:
        """Frames times their transmission weights, where there are any."""
        return frames if self.transmission is None else frames * self.transmission

    def transmission_weighted(self) -> System:
        """The same system, its pixels weighted by their transmission (PWLS)."""
        return replace(self, transmission=transmission_weights(self.measured, self.valid))

    def subset(self, frames: Sequence[int]) -> System:
        """The system of some frames."""
        chosen = list(frames)
        valid = None if self.valid is None else self.valid[chosen]
        intensity = None if self.intensity is None else self.intensity.subset(chosen)
        transmission = None if self.transmission is None else self.transmission[chosen]
        return System(self.operator.subset(chosen), self.measured[chosen], valid, intensity, transmission)


def norm(values: np.ndarray) -> float:
    """Euclidean norm of an array of any shape, summed in float64."""
    return inner(values, values) ** 0.5


def inner(a: np.ndarray, b: np.ndarray) -> float:
    """Inner product of two arrays of one shape, summed in float64.

    Not by BLAS, whose threads wait for cores that the device is using: on two busy ones that took most of a small run.
    """
    return float(np.einsum("i,i->", a.ravel(), b.ravel(), dtype=np.float64))


def reciprocal(sums: np.ndarray, share: float = 1e-6) -> np.ndarray:
    """1/sums; below ``share`` of the largest sum as at that share, and 0 where nothing is seen."""
    floor = share * float(sums.max(initial=0.0))
    return np.where(sums > 0, 1 / np.maximum(sums, floor or 1.0), 0).astype(np.float32)


def row_weights(system: System) -> np.ndarray:
    """1/(A 1) of every ray, 1/mm, at most that of a ray through a tenth of the longest path; times its transmission weight.

    A ray that only grazes an edge of the volume would else put its whole noise on a voxel or two, and bright corners
    are what one sees of it. TIGRE measures the paths in a box that is a tenth larger, to the same end.
    """
    return system.weighed(reciprocal(system.row_sums(), _SHORTEST_PATH))
