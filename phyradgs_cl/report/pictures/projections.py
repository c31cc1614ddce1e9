"""Which frames a page shows beside those of its volume."""

from phyradgs_cl.reconstructors.frames.pairs import FramePair, frame_pairs
from phyradgs_cl.reconstructors.frames.preprocess import prepared
from phyradgs_cl.report.run import Run
from phyradgs_cl.runtime import Runtime


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
    return frame_pairs(rt, scan, run.stored.volume, run.stored.grid, chosen_frames(scan.frames, count))
