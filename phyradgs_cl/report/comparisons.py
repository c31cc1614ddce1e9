"""Frames of a run: measured ones next to those of the volume, and frames before and after each step of preparation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid
from phyradgs_cl.prepare.step import Facts
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.frames.preprocess import prepared, stages
from phyradgs_cl.reconstructors.frames.projected import FramePair, frame_pairs
from phyradgs_cl.report.run import Run
from phyradgs_cl.runtime import Runtime

_BINS = 80
Image = NDArray[np.float32]


def chosen_frames(frames: int, count: int) -> list[int]:
    """Returns ``count`` frame numbers spread evenly over the scan, with the first."""
    return sorted({(k * frames) // count for k in range(min(count, frames))})


def computed_views(run: Run, rt: Runtime, count: int) -> list[FramePair]:
    """Returns ``count`` frames of the scan after the run's preprocessing, with those computed from its volume."""
    if run.scan is None or count < 1:
        return []
    scan = prepared(run.scan, run.preprocessing, rt)
    return frame_pairs(rt, scan, run.stored.values, run.stored.required_grid, chosen_frames(scan.frames, count))


@dataclass(frozen=True, eq=False)
class Change:
    """The effect of a preprocessing step.

    numbers: the facts that the step reports. pairs: images before and after, by name: the frame (rows, columns) and the
    sinogram (frames, columns) that changed most, and the middle slice (y, x) by FDK. counts (2, n): histograms of all line
    integrals, before and after, between ``edges`` (n + 1,).
    """

    step: str
    numbers: Facts
    pairs: dict[str, tuple[Image, Image]]
    edges: NDArray[np.float64]
    counts: NDArray[np.int64]


def step_changes(run: Run, rt: Runtime) -> list[Change]:
    """Repeats the run's preprocessing on its scan and returns the effect of each step."""
    if run.scan is None or not run.preprocessing.chosen:
        return []
    changes: list[Change] = []
    former: tuple[np.ndarray, Image] | None = None
    for name, scan, numbers in stages(run.scan, run.preprocessing, rt):
        now = scan.projections, static_fdk(rt, scan.on_grid(_middle(scan.grid)))[0]
        if former is not None:
            changes.append(_change(name, numbers, former, now))
        former = now
    return changes


def _middle(grid: Grid) -> Grid:
    """Returns the middle slice of a grid, across the axis."""
    return Grid((1, *grid.shape[1:]), grid.voxel_size_mm, grid.offset_mm)


def _change(name: str, numbers: Facts, former: tuple[np.ndarray, Image], now: tuple[np.ndarray, Image]) -> Change:
    (before, slice_before), (after, slice_after) = former, now
    moved = np.stack([np.abs(b - a).mean(axis=1) for b, a in zip(before, after, strict=True)])
    frame, row = int(np.argmax(moved.mean(axis=1))), int(np.argmax(moved.mean(axis=0)))
    pairs = {
        f"frame {frame}": (before[frame], after[frame]),
        f"sinogram of row {row}": (before[:, row], after[:, row]),
        "middle slice by fdk": (slice_before, slice_after),
    }
    low, high = np.percentile(np.stack([before, after]), [0.01, 99.99])
    edges = np.linspace(low, high if high > low else low + 1, _BINS + 1)
    counts = np.stack([np.histogram(frames, edges)[0] for frames in (before, after)])
    return Change(name, numbers, pairs, edges, counts)
