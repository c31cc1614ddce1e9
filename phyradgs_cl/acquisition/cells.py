"""Time cells: one table of (pose, lines, weight) that drives every operator, built by the motion models.

A frame is a sum over cells: pixel lines [line_start, line_stop) of the merged frame receive ``weight`` times the
projection from the cell's pose. Weights of a line sum to 1.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import Trajectory
from phyradgs_cl.errors import InputError

_INSTANT = 1e-9  # of the frame's span: shorter windows are moments
_OVERHANG = 0.1  # of a segment: how far a line may stay in a segment beyond its end
_TURN_SAMPLES = 32
_TURN_FACTOR = 0.32  # relative error per squared radian
_HARMLESS_PEAK = 4.0  # line integral
_MOST_SEGMENTS = 1000


@dataclass(frozen=True, eq=False)
class TimeCells:
    """The cells of one frame, sorted by line_start, so that those that serve a line are neighbours.

    pose (C, 12) mm, in the detector's own rows and columns whatever the readout axis; time_s (C,); line_start, line_stop
    (C,) along the readout ``axis`` of ``lines`` lines; weight (C,). ``line_share`` (C, lines) multiplies the weight of a
    still cell by the share of each line's window that lies in it; None: 1 for every line that the cell serves.

    Cells with motion are segments of the frame: ``end_poses`` (C, 2, 12), and ``line_times`` (C, 3, lines): middle and
    half length of every line's window in the segment, in units of the segment's length from its mid-time, and the share
    of its window that this is. ``weight`` is 1 then. A method raises InputError for cells of one's own that do not fit.
    """

    pose: np.ndarray
    time_s: np.ndarray
    line_start: np.ndarray
    line_stop: np.ndarray
    weight: "NDArray[np.float64]"
    lines: int
    axis: str = "rows"
    end_poses: np.ndarray | None = None
    line_times: "NDArray[np.float64] | None" = None
    line_share: "NDArray[np.float64] | None" = None

    @property
    def count(self) -> int:
        """How many cells C there are."""
        return len(self.weight)

    def line_weights(self) -> np.ndarray:
        """Sum of weights (lines,) that each line receives; 1 for a complete table."""
        total = np.zeros(self.lines)
        for cell, lines in enumerate(self.ranges):
            total[lines] += self.weights_of(cell)
        return total

    @property
    def ranges(self) -> list[slice]:
        """The lines of every cell."""
        return [slice(int(a), int(b)) for a, b in zip(self.line_start, self.line_stop, strict=True)]

    def weights_of(self, cell: int) -> np.ndarray:
        """The weight (line_stop − line_start,) of a cell on each of its lines."""
        lines = slice(int(self.line_start[cell]), int(self.line_stop[cell]))
        share = self.line_share[cell, lines] if self.line_share is not None else np.ones(lines.stop - lines.start)
        if self.line_times is not None:
            share = self.line_times[cell, 2, lines]
        weights: np.ndarray = self.weight[cell] * share
        return weights

    @property
    def readout(self) -> Readout:
        """How frames and poses turn to lines first."""
        return Readout(self.axis)

    @property
    def is_moving(self) -> bool:
        """Whether poses change within a cell, as splats can follow."""
        return self.end_poses is not None

    @property
    def averages(self) -> bool:
        """Whether a line has more than one cell."""
        return bool(self.layer_numbers.any())

    def scaled(self, factor: float) -> "TimeCells":
        """The same cells with all lengths multiplied by ``factor``."""
        ends = None if self.end_poses is None else self.end_poses * factor
        return replace(self, pose=self.pose * factor, end_poses=ends)

    def finer(self, factor: int) -> "TimeCells":
        """The same still cells for a panel with pixels cut into ``factor`` by ``factor``; cut lines share their times."""
        pose = self.pose.copy()
        pose[:, 6:] /= factor
        pose[:, 3:6] -= (factor - 1) / 2 * (pose[:, 6:9] + pose[:, 9:12])
        lines = {name: getattr(self, name) * factor for name in ("line_start", "line_stop", "lines")}
        share = None if self.line_share is None else self.line_share.repeat(factor, 1)
        return replace(self, pose=pose, line_share=share, **lines)

    def still(self) -> "TimeCells":
        """These cells, for operators without motion within a cell; InputError where there is some."""
        if self.is_moving:
            remedy = "take --motion per-row"
            raise InputError("--motion", "cells with motion", "still cells: only splats move", remedy)
        return self

    def line_poses(self) -> np.ndarray:
        """Poses (lines, 12) in mid-exposure of each line, of the nearest cell; (1, 12) of one cell. InputError
        for a line without a cell."""
        if self.count == 1:
            return self.pose
        lengths = self.line_stop - self.line_start
        cell = np.repeat(np.arange(self.count), lengths)
        line = np.arange(cell.size) + np.repeat(self.line_start - (np.cumsum(lengths) - lengths), lengths)
        order = np.lexsort((self.time_s[cell], line))
        cell, line = cell[order], line[order]
        weight = self.weight[cell] * (1 if self.line_share is None else self.line_share[cell, line])
        total = np.bincount(line, weight, self.lines)
        past = np.cumsum(weight) - weight / 2 - (np.cumsum(total) - total)[line]
        nearest = np.lexsort((np.abs(past - total[line] / 2), line))
        served, first = np.unique(line[nearest], return_index=True)
        if served.size < self.lines:
            raise InputError("--motion", "a line without a time cell", "weights of every line that sum to 1")
        return self.pose[cell[nearest[first]]]

    def line_cells(self) -> np.ndarray:
        """Per line the range (lines, 2) [first, stop) of cells outside of which none serves it; inside some may not."""
        line = np.arange(self.lines)
        first = np.searchsorted(np.maximum.accumulate(self.line_stop), line, side="right")
        stop = np.searchsorted(self.line_start, line, side="right")
        return np.stack([first, stop], -1)

    @cached_property
    def layer_numbers(self) -> np.ndarray:
        """A number (C,) for every cell, so that no line has two of one number; as few as its busiest line has cells."""
        numbers = np.zeros(self.count, np.int64)
        free_from: list[int] = []
        for cell, (start, stop) in enumerate(zip(self.line_start, self.line_stop, strict=True)):
            layer = next((k for k, line in enumerate(free_from) if line <= start), len(free_from))
            if layer == len(free_from):
                free_from.append(0)
            numbers[cell] = layer
            free_from[layer] = int(stop)
        return numbers

    @cached_property
    def layer_weights(self) -> np.ndarray:
        """Weights (layers, lines) of each line's cell in each layer of ``layer_numbers``, 0 where it has none."""
        weights = np.zeros((int(self.layer_numbers.max(initial=-1)) + 1, self.lines))
        for cell, lines in enumerate(self.ranges):
            weights[self.layer_numbers[cell], lines] = self.weights_of(cell)
        return weights


def static_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int
) -> TimeCells:
    """One cell at the middle of the frame's lit span: the best a frozen gantry can do."""
    return _single_cell(trajectory, shutter, frame, start_s + shutter.middle_s, lines)


def static_start_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int
) -> TimeCells:
    """One cell at the frame's first pose; the volume comes out rotated by half the span."""
    return _single_cell(trajectory, shutter, frame, start_s + shutter.lit_span_s[0], lines)


def micro_view_cells(
    trajectory: Trajectory,
    shutter: Shutter,
    frame: int,
    start_s: float,
    lines: int,
    strips: int,
    sub_intervals: int,
) -> TimeCells:
    """M strips × N sub-intervals, t = t_f + (j+½)/M·T_ro + (k+½)/N·T_exp (paper, Eq. 2). With a pulsed beam the N share
    the lit part of the strip's window. Strips without a line (M above the number of lines) are left out."""
    if strips < 1 or sub_intervals < 1:
        raise InputError("strips × sub-intervals", f"{strips} × {sub_intervals}", "two counts of at least 1")
    share = (np.arange(sub_intervals) + 0.5) / sub_intervals
    time_s, first, last = [], [], []
    for strip, (line_start, line_stop) in enumerate(shutter.strip_ranges(lines, strips)):
        if line_stop > line_start:
            opens_s = (strip + 0.5) / strips * shutter.readout_s
            first_s, last_s = shutter.in_pulse(np.array([opens_s, opens_s + shutter.exposure_s]))
            time_s.append(start_s + first_s + share * (last_s - first_s))
            first.append(np.full(sub_intervals, line_start))
            last.append(np.full(sub_intervals, line_stop))
    times = np.concatenate(time_s)
    weight = np.full(times.size, 1.0 / sub_intervals)
    ranges = np.concatenate(first), np.concatenate(last)
    return cell_table(trajectory, shutter, frame, times, *ranges, weight, lines)


def per_line_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, samples: int
) -> TimeCells:
    """Every line at ``samples`` times of its own exposure, by the midpoint rule: its error falls with samples⁻² for
    fields that are smooth along the motion of one step."""
    if samples < 1:
        raise InputError("time samples", str(samples), "at least 1")
    opens_s, closes_s = shutter.line_windows_s(lines).T
    share = (np.arange(samples) + 0.5) / samples
    times = (start_s + opens_s[:, None] + share * (closes_s - opens_s)[:, None]).ravel()
    line = np.repeat(np.arange(lines), samples)
    weight = np.full(times.size, 1.0 / samples)
    return cell_table(trajectory, shutter, frame, times, line, line + 1, weight, lines)


def exact_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, segments: int
) -> TimeCells:
    """``segments`` equal segments of the frame's lit span, in which splats move (docs/mathematics.md) and every line
    integrates over its own window. A gantry at rest, or no time, gives the cell of ``static_cells``."""
    if segments < 1:
        raise InputError("segments", str(segments), "at least 1")
    first_s, last_s = shutter.lit_span_s
    if last_s <= first_s:
        return static_cells(trajectory, shutter, frame, start_s, lines)
    edges_s = np.linspace(first_s, last_s, segments + 1)
    times = _line_times(shutter.line_windows_s(lines), edges_s)
    served = times[:, 2] > 0
    kept = np.flatnonzero(served.any(axis=1))
    middle_s = start_s + (edges_s[:-1] + edges_s[1:])[kept] / 2
    line_start = served[kept].argmax(axis=1)
    order = np.argsort(line_start, kind="stable")
    ends_s = start_s + np.stack([edges_s[:-1], edges_s[1:]], -1)[kept][order]
    ends = line_start, lines - served[kept, ::-1].argmax(axis=1)
    table = cell_table(trajectory, shutter, frame, middle_s, *ends, np.ones(kept.size), lines)
    end_poses = trajectory.pose(frame, ends_s)
    if np.all(end_poses == table.pose[0]) and np.all(table.pose == table.pose[0]):
        return static_cells(trajectory, shutter, frame, start_s, lines)
    return replace(table, end_poses=end_poses, line_times=times[kept][order])


def _line_times(windows_s: np.ndarray, edges_s: np.ndarray) -> np.ndarray:
    """``TimeCells.line_times`` (K, 3, lines) from the lines' windows (lines, 2) and the segments' edges (K + 1,). A
    line that would reach only a little way into a segment stays in the one beside it, for fewer footprints."""
    length_s = edges_s[1] - edges_s[0]
    count = len(edges_s) - 1
    opens, closes = ((windows_s - edges_s[0]) / length_s).T  # in segments from the first light
    first, last = _kept_segments(opens, closes, count)
    index = np.arange(count)[:, None]
    start = np.where(index == first, opens, index)
    stop = np.where(index == last, closes, index + 1)
    served = (index >= first) & (index <= last)
    instant = closes - opens <= _INSTANT * count
    share = np.where(instant, 1.0, (stop - start) / np.where(instant, 1.0, closes - opens))
    rows = ((start + stop) / 2 - index - 0.5, (stop - start) / 2, share)
    return np.stack([np.where(served, row, 0.0) for row in rows], 1)


def _kept_segments(opens: np.ndarray, closes: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last segment (lines,) of every line, less those that it reaches into by no more than ``_OVERHANG``."""
    first = np.clip(np.floor(opens), 0, count - 1)
    last = np.clip(np.ceil(closes) - 1, first, count - 1)
    first = np.where((first < last) & (first + 1 - opens <= _OVERHANG), first + 1, first)
    last = np.where((first < last) & (closes - last <= _OVERHANG), last - 1, last)
    return first, last


def segments_for(
    trajectory: Trajectory,
    shutter: Shutter,
    frame: int,
    start_s: float,
    time_error: float,
    intensity_peak: float = 0.0,
) -> int:
    """How many segments keep the error of straight paths and constant conics below ``time_error`` (relative, RMS).

    Both grow with the square of the view's turn in a segment; the factor is measured (benchmarks/time_exact.py), for
    Gaussians of 0.5 to 4 % of the half-width. intensity_peak: largest line integral where a detector averages intensities,
    else 0: half their variance in a segment is left, which up to a peak of 4 stays below the rest of the error.
    """
    first_s, last_s = shutter.lit_span_s
    time_s = start_s + np.linspace(first_s, last_s, _TURN_SAMPLES + 1)
    pose = trajectory.pose(frame, time_s)
    fastest_rad = float(np.max(_turns_rad(pose))) * _TURN_SAMPLES
    contrast = np.sqrt(max(1.0, intensity_peak / _HARMLESS_PEAK))
    count = np.ceil(contrast * fastest_rad * np.sqrt(_TURN_FACTOR / time_error))
    return int(np.clip(count, 1, _MOST_SEGMENTS))


def _turns_rad(pose: np.ndarray) -> np.ndarray:
    """Angles (T − 1,) between successive poses (T, 12): of the source about the origin, or of the detector if larger."""
    u_hat = pose[:, 6:9] / np.linalg.norm(pose[:, 6:9], axis=1, keepdims=True)
    normal = np.cross(u_hat, pose[:, 9:12])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    source = pose[:, :3] / np.maximum(np.linalg.norm(pose[:, :3], axis=1, keepdims=True), 1e-300)
    chords = [np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (u_hat, normal, source)]
    largest: np.ndarray = np.max([2 * np.arcsin(chord.clip(0, 2) / 2) for chord in chords], axis=0)
    return largest


def _single_cell(
    trajectory: Trajectory, shutter: Shutter, frame: int, time_s: float, lines: int
) -> TimeCells:
    one = np.ones(1)
    return cell_table(trajectory, shutter, frame, time_s * one, 0 * one, lines * one, one, lines)


def cell_table(
    trajectory: Trajectory,
    shutter: Shutter,
    frame: int,
    time_s: np.ndarray,
    line_start: np.ndarray,
    line_stop: np.ndarray,
    weight: np.ndarray,
    lines: int,
) -> TimeCells:
    """Cells at times (C,) s, in the order of their first lines."""
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
