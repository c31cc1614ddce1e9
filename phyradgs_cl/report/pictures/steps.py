"""A frame of the scan before and after each step of ``prepare``, and how often each line integral was there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.prepare.step import Facts
from phyradgs_cl.reconstructors.preprocess import stages
from phyradgs_cl.report.run import Run
from phyradgs_cl.runtime import Runtime

_BINS = 80
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Change:
    """What a step did: its numbers; the frame that changed most, before and after (rows, columns); the scan's line integrals
    as ``counts`` (2, n), before and after, between ``edges`` (n + 1,)."""

    step: str
    numbers: Facts
    frame: int
    before: Image
    after: Image
    edges: NDArray[np.float64]
    counts: NDArray[np.int64]


def step_changes(run: Run, rt: Runtime) -> list[Change]:
    """The steps of the run, done again on its scan."""
    if run.scan is None or not run.before.chosen:
        return []
    found, former = [], None
    for name, scan, numbers in stages(run.scan, run.before, rt):
        if former is not None:
            found.append(_change(name, numbers, former, scan.projections))
        former = scan.projections
    return found


def _change(name: str, numbers: Facts, before: np.ndarray, after: np.ndarray) -> Change:
    moved = [float(np.mean(np.abs(b - a))) for b, a in zip(before, after, strict=True)]
    frame = int(np.argmax(moved))
    low, high = np.percentile(np.stack([before, after]), [0.01, 99.99])
    edges = np.linspace(low, high if high > low else low + 1, _BINS + 1)
    counts = np.stack([np.histogram(frames, edges)[0] for frames in (before, after)])
    return Change(name, numbers, frame, before[frame], after[frame], edges, counts)
