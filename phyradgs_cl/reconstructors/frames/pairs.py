"""Frames of a scan against the same frames computed from a volume, each line at its own times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.runtime import Runtime

TIMES_PER_LINE = 16  # a line's exposure is sampled so often; what that leaves is far below noise
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FramePair:
    """One frame: measured and computed (rows, columns) line integrals, 0 where ``valid`` is not."""

    frame: int
    measured: Image
    computed: Image
    valid: NDArray[np.bool_]

    @property
    def residual(self) -> Image:
        """Measured less computed."""
        return self.measured - self.computed

    @property
    def rms(self) -> float:
        """Root mean square of the residual over the pixels that count."""
        return _rms(self.residual[self.valid])

    @property
    def relative(self) -> float:
        """``rms`` as a share of that of the measurement."""
        return self.rms / (_rms(self.measured[self.valid]) or 1.0)


def frame_pairs(
    rt: Runtime, scan: Scan, volume: np.ndarray, grid: Grid, frames: Sequence[int]
) -> list[FramePair]:
    """Some frames of a scan beside those of a volume (nz, ny, nx) in 1/mm, under the scan's true motion.

    A panel that averages intensity is compared with intensities that are averaged.
    """
    motion = PerRow(sub_intervals=TIMES_PER_LINE)
    tables = [motion.cells(scan, frame) for frame in frames]
    operator = RayOperator(rt, grid, scan.geometry.detector_shape, tables)
    computed = operator.forward(volume)
    if scan.detector_model == "intensity":
        computed = computed - operator.intensity_correction(volume)
    pairs = []
    for frame, image in zip(frames, computed, strict=True):
        valid = scan.valid[frame]
        measured = np.where(valid, scan.projections[frame], 0).astype(np.float32)
        pairs.append(FramePair(frame, measured, np.where(valid, image, 0).astype(np.float32), valid))
    return pairs


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2))) if values.size else 0.0
