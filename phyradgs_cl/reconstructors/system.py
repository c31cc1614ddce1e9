"""The linear system A x = p of a scan under a motion model, as the iterative methods see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.operators.ray_operator import LinearOperator, RayOperator
from phyradgs_cl.runtime import Runtime

_SHORTEST_PATH = 0.1  # of the longest


@dataclass(frozen=True, eq=False)
class System:
    """Operator A and measurement p (F, rows, columns) float32; ``valid`` (F, rows, columns) bool, None: all pixels.

    Pixels that are not valid are 0 in ``measured`` and in every residual, as if their rows were not in A.
    """

    operator: LinearOperator
    measured: np.ndarray
    valid: np.ndarray | None = None

    @classmethod
    def of_scan(cls, rt: Runtime, scan: Scan, motion: Motion) -> System:
        """The scan's frames with the cells of ``motion``."""
        tables = [motion.cells(scan, f) for f in range(scan.frames)]
        operator = RayOperator(rt, scan.grid, scan.geometry.detector_shape, tables)
        measured = np.asarray(scan.projections, np.float32)
        if scan.pixel_mask is None:
            return cls(operator, measured)
        valid = np.broadcast_to(scan.pixel_mask == 0, measured.shape)
        return cls(operator, np.where(valid, measured, np.float32(0)), valid)

    @property
    def frames(self) -> int:
        return len(self.measured)

    def masked(self, frames: np.ndarray) -> np.ndarray:
        """Frames with 0 at the pixels that do not count."""
        return frames if self.valid is None else np.where(self.valid, frames, np.float32(0))

    def forward(self, volume: np.ndarray) -> np.ndarray:
        """A x at the pixels that count."""
        return self.masked(self.operator.forward(volume))

    def residual(self, volume: np.ndarray) -> np.ndarray:
        """p − A x, dimensionless."""
        return self.measured - self.forward(volume)

    def row_sums(self) -> np.ndarray:
        """A 1 in mm: the length of every ray in the volume."""
        return self.forward(np.ones(self.operator.volume_shape, np.float32))

    def column_sums(self) -> np.ndarray:
        """Aᵀ 1 in mm, over the pixels that count."""
        return self.operator.adjoint(self.masked(np.ones(self.measured.shape, np.float32)))

    def subset(self, frames: Sequence[int]) -> System:
        """The system of some frames."""
        chosen = list(frames)
        valid = None if self.valid is None else self.valid[chosen]
        return System(self.operator.subset(chosen), self.measured[chosen], valid)


def norm(values: np.ndarray) -> float:
    """Euclidean norm of an array of any shape, summed in float64."""
    flat = values.ravel().astype(np.float64, copy=False)
    return float(np.sqrt(np.dot(flat, flat)))


def inner(a: np.ndarray, b: np.ndarray) -> float:
    """Inner product of two arrays of one shape, summed in float64."""
    return float(np.dot(a.ravel().astype(np.float64, copy=False), b.ravel().astype(np.float64, copy=False)))


def reciprocal(sums: np.ndarray, share: float = 1e-6) -> np.ndarray:
    """1/sums; below ``share`` of the largest sum as at that share, and 0 where nothing is seen."""
    floor = share * float(sums.max(initial=0.0))
    return np.where(sums > 0, 1 / np.maximum(sums, floor or 1.0), 0).astype(np.float32)


def row_weights(system: System) -> np.ndarray:
    """1/(A 1) of every ray, 1/mm, no more than that of a ray through a tenth of the longest path.

    A ray that only grazes an edge of the volume would else put its whole noise on a voxel or two, and bright corners
    are what one sees of it. TIGRE measures the paths in a box that is a tenth larger, to the same end.
    """
    return reciprocal(system.row_sums(), _SHORTEST_PATH)
