"""Frames of a scan against the same frames computed from the volume, each line at its own times."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import PerRow
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.report.run import Run
from phyradgs_cl.runtime import Runtime

TIMES_PER_LINE = 16  # a line's exposure is sampled so often; what that leaves is far below noise
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class View:
    """One frame: measured and computed (rows, columns) line integrals, 0 where ``valid`` is not."""

    frame: int
    measured: Image
    computed: Image
    valid: NDArray[np.bool_]

    @property
    def residual(self) -> Image:
        return self.measured - self.computed

    @property
    def rms(self) -> float:
        """Root mean square of the residual over the pixels that count."""
        return _rms(self.residual[self.valid])

    @property
    def relative(self) -> float:
        """``rms`` as a share of that of the measurement."""
        return self.rms / (_rms(self.measured[self.valid]) or 1.0)


def chosen_frames(frames: int, count: int) -> list[int]:
    """``count`` frames spread evenly over the scan, the first one among them."""
    return sorted({(k * frames) // count for k in range(min(count, frames))})


def computed_views(run: Run, rt: Runtime, count: int) -> list[View]:
    """``count`` frames of the run's scan, as its method saw them (lag undone, filtered), beside those of its volume
    under the scan's true motion; intensities where the panel averages them."""
    if run.scan is None or count < 1:
        return []
    scan, chosen = prepared(run.scan, run.before, rt), chosen_frames(run.scan.frames, count)
    motion = PerRow(sub_intervals=TIMES_PER_LINE)
    tables = [motion.cells(scan, frame) for frame in chosen]
    operator = RayOperator(rt, run.stored.grid, scan.geometry.detector_shape, tables)
    computed = operator.forward(run.stored.volume)
    if scan.detector_model == "intensity":
        computed = computed - operator.intensity_gap(run.stored.volume)
    views = []
    for frame, image in zip(chosen, computed, strict=True):
        valid = scan.valid[frame]
        measured = np.where(valid, scan.projections[frame], 0).astype(np.float32)
        views.append(View(frame, measured, np.where(valid, image, 0).astype(np.float32), valid))
    return views


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2))) if values.size else 0.0
