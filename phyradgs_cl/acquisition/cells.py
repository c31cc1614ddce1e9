"""Time cells: one table of (pose, lines, weight) that drives every operator.

A frame is a sum over cells: pixel lines [line_start, line_stop) of the merged frame receive ``weight``
times the projection from the cell's pose. Weights of a line sum to 1. The builders are the motion models.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import Trajectory
from phyradgs_cl.errors import InputError


@dataclass(frozen=True, eq=False)
class TimeCells:
    """The cells of one frame.

    pose (C, 12) mm, in the detector's own rows and columns whatever the readout axis; time_s (C,);
    line_start, line_stop (C,) along the readout ``axis`` of ``lines`` lines; weight (C,).
    Cells are sorted by line_start, so that the cells that serve a line are neighbours.
    """

    pose: np.ndarray
    time_s: np.ndarray
    line_start: np.ndarray
    line_stop: np.ndarray
    weight: np.ndarray
    lines: int
    axis: str = "rows"

    @property
    def count(self) -> int:
        return len(self.weight)

    def line_weights(self) -> np.ndarray:
        """Sum of weights (lines,) that each line receives; 1 for a complete table."""
        total = np.zeros(self.lines)
        for start, stop, weight in zip(self.line_start, self.line_stop, self.weight, strict=True):
            total[start:stop] += weight
        return total


def static_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int
) -> TimeCells:
    """One cell at the middle of the frame's whole window: the best a frozen gantry can do."""
    return _single_cell(trajectory, shutter, frame, start_s + shutter.span_s / 2, lines)


def static_start_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int
) -> TimeCells:
    """One cell at the frame's first pose; the volume comes out rotated by half the span."""
    return _single_cell(trajectory, shutter, frame, start_s, lines)


def micro_view_cells(
    trajectory: Trajectory,
    shutter: Shutter,
    frame: int,
    start_s: float,
    lines: int,
    strips: int,
    sub_intervals: int,
) -> TimeCells:
    """M strips × N sub-intervals, t = t_f + (j+½)/M·T_ro + (k+½)/N·T_exp (paper, Eq. 2).

    Strips without a line (M larger than the number of lines) are left out.
    """
    if strips < 1 or sub_intervals < 1:
        raise InputError("strips × sub-intervals", f"{strips} × {sub_intervals}", "two counts of at least 1")
    exposure_s = (np.arange(sub_intervals) + 0.5) / sub_intervals * shutter.exposure_s
    time_s, first, last = [], [], []
    for strip, (line_start, line_stop) in enumerate(shutter.strip_ranges(lines, strips)):
        if line_stop > line_start:
            time_s.append(start_s + (strip + 0.5) / strips * shutter.readout_s + exposure_s)
            first.append(np.full(sub_intervals, line_start))
            last.append(np.full(sub_intervals, line_stop))
    times = np.concatenate(time_s)
    weight = np.full(times.size, 1.0 / sub_intervals)
    return _table(
        trajectory, shutter, frame, times, np.concatenate(first), np.concatenate(last), weight, lines
    )


def per_line_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, samples: int
) -> TimeCells:
    """Every line at ``samples`` times of its own exposure, by the midpoint rule.

    The rule's error falls with samples⁻² for fields that are smooth along the motion of one step.
    """
    if samples < 1:
        raise InputError("time samples", str(samples), "at least 1")
    opens_s, closes_s = shutter.line_windows_s(lines).T
    share = (np.arange(samples) + 0.5) / samples
    times = (start_s + opens_s[:, None] + share * (closes_s - opens_s)[:, None]).ravel()
    line = np.repeat(np.arange(lines), samples)
    weight = np.full(times.size, 1.0 / samples)
    return _table(trajectory, shutter, frame, times, line, line + 1, weight, lines)


def _single_cell(
    trajectory: Trajectory, shutter: Shutter, frame: int, time_s: float, lines: int
) -> TimeCells:
    one = np.ones(1)
    return _table(trajectory, shutter, frame, time_s * one, 0 * one, lines * one, one, lines)


def _table(
    trajectory: Trajectory,
    shutter: Shutter,
    frame: int,
    time_s: np.ndarray,
    line_start: np.ndarray,
    line_stop: np.ndarray,
    weight: np.ndarray,
    lines: int,
) -> TimeCells:
    order = np.argsort(line_start, kind="stable")
    return TimeCells(
        pose=trajectory.pose(frame, time_s[order]),
        time_s=time_s[order],
        line_start=line_start[order].astype(np.int32),
        line_stop=line_stop[order].astype(np.int32),
        weight=weight[order].astype(np.float64),
        lines=lines,
        axis=shutter.axis,
    )
