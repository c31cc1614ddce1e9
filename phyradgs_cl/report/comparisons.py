"""Frames of a run: measured ones next to those of the volume, and frames before and after each step of preparation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid
from phyradgs_cl.prepare.step import Facts
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.frames.pairs import FramePair, frame_pairs
from phyradgs_cl.reconstructors.frames.preprocess import prepared, stages
from phyradgs_cl.report.run import Run
from phyradgs_cl.runtime import Runtime

_BINS = 80
Image = NDArray[np.float32]


def chosen_frames(frames: int, count: int) -> list[int]:
    """``count`` frames spread evenly over the scan, the first one among them."""
    return sorted({(k * frames) // count for k in range(min(count, frames))})


def computed_views(run: Run, rt: Runtime, count: int) -> list[FramePair]:
    """``count`` frames of the run's scan beside those of its volume, as the run's method saw them: lag undone and
    filtered.
    """
    if run.scan is None or count < 1:
        return []
    scan = prepared(run.scan, run.before, rt)
    return frame_pairs(rt, scan, run.stored.values, run.stored.required_grid, chosen_frames(scan.frames, count))


@dataclass(frozen=True, eq=False)
class Change:
    """What a step did: its numbers; by name an image (rows, columns) before and after: the frame that changed most, the
    sinogram (frames, columns) of the row that did, the middle slice (y, x) by FDK; the scan's line integrals as ``counts``
    (2, n), before and after, between ``edges`` (n + 1,)."""

    step: str
    numbers: Facts
    pairs: dict[str, tuple[Image, Image]]
    edges: NDArray[np.float64]
    counts: NDArray[np.int64]


def step_changes(run: Run, rt: Runtime) -> list[Change]:
    """The steps of the run, done again on its scan."""
    if run.scan is None or not run.before.chosen:
        return []
    found: list[Change] = []
    former: tuple[np.ndarray, Image] | None = None
    for name, scan, numbers in stages(run.scan, run.before, rt):
        now = scan.projections, static_fdk(rt, scan.on_grid(_middle(scan.grid)))[0]
        if former is not None:
            found.append(_change(name, numbers, former, now))
        former = now
    return found


def _middle(grid: Grid) -> Grid:
    """One slice across the axis, in the middle of a grid."""
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
