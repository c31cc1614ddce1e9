"""Builds the ``TimeCells`` of a frame, by one function for each motion model.

A time cell is one pose, or one segment of time, with the detector lines that are projected from it. The "lit span" is the
time from a frame's first light on the panel to its last. A line's "window" is the time in which it receives light."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.acquisition.trajectory import Trajectory, body_frames, is_parallel

_SAME_TIME = 1e-6  # two times that differ by less than this fraction of a cell's duration count as equal
_NOTHING = 1e-9  # if a cell has a smaller fraction of a line's exposure, this is a rounding error and becomes 0
_INSTANT = 1e-9  # an exposure up to this fraction of the time from a frame's first light to its last counts as a moment
_OVERHANG = 0.1  # a line leaves out its first or last segment if the exposure covers at most this fraction of the segment
_TURN_SAMPLES = 32  # intervals of a frame's exposure whose largest mean speed counts as the gantry's highest speed
_TURN_FACTOR = 0.32  # measured (relative RMS error of a frame) / (gantry's turn in a segment, in rad)²
_HARMLESS_PEAK = 4.0  # up to this line integral, averaging intensities needs no more segments than averaging line integrals
_MOST_SEGMENTS = 1000  # most segments that ``segments_for`` chooses for a frame


def static_cells(trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int) -> TimeCells:
    """Returns one cell for all lines, with the pose midway between first and last light: the best time for a single pose."""
    return single_cell(trajectory, shutter, frame, start_s + shutter.middle_s, lines)


def micro_view_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, strips: int,
    sub_intervals: int
) -> TimeCells:
    """Divides the lines into M ``strips`` and the exposure into N ``sub_intervals``, and returns a cell for each pair.

    Strip j in sub-interval k of a frame that starts at t_f has the time t_f + (j+½)/M·T_ro + (k+½)/N·T_exp, with readout
    time T_ro and exposure T_exp (paper, Eq. 2). With a pulsed beam the sub-intervals divide the lit part of the exposure.
    Strips without a line have no cells."""
    share = (np.arange(sub_intervals) + 0.5) / sub_intervals
    ranges = np.array(shutter.strip_ranges(lines, strips))
    strip = np.flatnonzero(ranges[:, 1] > ranges[:, 0])
    opens_s = (strip + 0.5) / strips * shutter.readout_s
    first_s, last_s = shutter.in_pulse(np.stack([opens_s, opens_s + shutter.exposure_s]))[..., None]
    time_s = (start_s + first_s + share * (last_s - first_s)).ravel()
    line_start, line_stop = np.repeat(ranges[strip], sub_intervals, axis=0).T
    weight = np.full(time_s.size, 1.0 / sub_intervals)
    return cell_table(trajectory, shutter, frame, time_s, line_start, line_stop, weight, lines)


def centre_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, strips: int,
    sub_intervals: int
) -> TimeCells:
    """Returns the cells of ``micro_view_cells`` with a ``conic_pose``, at which the shapes of Gaussians on the panel are
    computed: the pose of ``static_cells``."""
    table = micro_view_cells(trajectory, shutter, frame, start_s, lines, strips, sub_intervals)
    return replace(table, conic_pose=static_cells(trajectory, shutter, frame, start_s, lines).pose[0])


def per_line_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, samples: int
) -> TimeCells:
    """Returns ``samples`` cells for every line, at the middles of equal parts of its exposure.

    The error falls with samples⁻² if the object is smooth over the motion from one sample to the next."""
    opens_s, closes_s = shutter.line_windows_s(lines).T
    share = (np.arange(samples) + 0.5) / samples
    times = (start_s + opens_s[:, None] + share * (closes_s - opens_s)[:, None]).ravel()
    line = np.repeat(np.arange(lines), samples)
    weight = np.full(times.size, 1.0 / samples)
    return cell_table(trajectory, shutter, frame, times, line, line + 1, weight, lines)


def common_time_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, frame_start_s: np.ndarray, lines: int, samples: int
) -> TimeCells:
    """Divides the time from first to last light into cells of length exposure / ``samples``, which all lines share.

    A line weights each cell by the fraction of its window in the cell: P(v) = Σ_k w_k(v) P(θ(t_k), v), where t_k is the
    cell's middle and w_k(v) = |window(v) ∩ cell k| / |window(v)|. So one projection from a pose serves many lines. This is
    the paper's strip concatenation with fractional strips.

    frame_start_s (F,): the starts of all frames in s. In a scan without gaps, frames overlap in time because of the
    readout. Overlapping frames share poses if they start a whole number of cells after frame 0. With an exposure of 0 s,
    or cells shorter than the readout of a line, sharing is useless: the result is ``per_line_cells``. With a pulsed beam,
    the longest time for which a line receives light counts as the exposure."""
    start_s = float(frame_start_s[frame])
    windows_s = shutter.line_windows_s(lines)
    length_s = float(np.ptp(windows_s, axis=1).max())
    first_s, last_s = float(windows_s.min()), float(windows_s.max())
    step_s = length_s / samples
    if length_s <= 0 or last_s - first_s > lines * step_s:
        return per_line_cells(trajectory, shutter, frame, start_s, lines, samples if length_s > 0 else 1)
    edges_s = first_s + step_s * np.arange(np.ceil((last_s - first_s) / step_s - _SAME_TIME) + 1)
    share = shares_of_windows(windows_s, edges_s)
    used, line_start, line_stop, order = _served_lines(share > 0)
    latest_s = float(np.max(frame_start_s)) + last_s - step_s / 2  # the trajectory may have no poses after the last light
    middle_s = np.minimum(_middles_s(frame_start_s, frame, edges_s), latest_s)[used]
    table = cell_table(trajectory, shutter, frame, middle_s, line_start, line_stop, np.ones(used.size), lines)
    return replace(table, line_share=share[used][order])


def _served_lines(served: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the indices of the cells that serve any line, these cells' first lines, the lines after their last lines, and
    the order that sorts them by first line. served: whether each of K cells serves each line, bool (K, lines)."""
    used = np.flatnonzero(served.any(axis=1))
    line_start = served[used].argmax(axis=1)
    line_stop = served.shape[1] - served[used, ::-1].argmax(axis=1)
    return used, line_start, line_stop, np.argsort(line_start, kind="stable")


def _middles_s(frame_start_s: np.ndarray, frame: int, edges_s: np.ndarray) -> np.ndarray:
    """Returns the middles (K,) of a frame's cells in s on the scan's clock. edges_s (K + 1,): the cells' edges in s after
    the frame's start."""
    step_s = edges_s[1] - edges_s[0]
    start_s, origin_s = float(frame_start_s[frame]), float(frame_start_s[0])
    cells = (start_s - origin_s) / step_s
    number = np.arange(len(edges_s) - 1) + 0.5
    if abs(cells - round(cells)) < _SAME_TIME:
        # Times count from frame 0: cells of different frames at the same time then have bit-identical times and poses, and
        # a pose is projected once for all of them.
        start_s, number = origin_s, round(cells) + number
    return np.asarray(start_s + edges_s[0] + number * step_s)


def shares_of_windows(windows_s: np.ndarray, edges_s: np.ndarray) -> np.ndarray:
    """Returns the fraction (K, lines) of each line's window (lines, 2) in each cell, whose edges are ``edges_s`` (K + 1,).
    The fractions of a line sum to 1."""
    opens, closes = windows_s.T
    length_s = closes - opens
    overlap = np.minimum(closes, edges_s[1:, None]) - np.maximum(opens, edges_s[:-1, None])
    share = np.maximum(overlap, 0) / np.where(length_s > 0, length_s, 1)
    # A window of length 0 overlaps no cell. It belongs wholly to the cell that contains it.
    moment = np.clip(np.searchsorted(edges_s, opens, side="right") - 1, 0, len(edges_s) - 2)
    share[:, length_s <= 0] = 0
    share[moment[length_s <= 0], np.flatnonzero(length_s <= 0)] = 1
    share[share < _NOTHING] = 0
    return np.asarray(share / share.sum(axis=0))


def exact_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, lines: int, segments: int
) -> TimeCells:
    """Divides the time from a frame's first light to its last into equal ``segments``, in which Gaussians move on the panel.

    Every line integrates over its own window (docs/mathematics.md). For a gantry at rest, or a lit span of 0 s, returns
    ``static_cells``."""
    first_s, last_s = shutter.lit_span_s
    if last_s <= first_s:
        return static_cells(trajectory, shutter, frame, start_s, lines)
    edges_s = np.linspace(first_s, last_s, segments + 1)
    times = _line_times(shutter.line_windows_s(lines), edges_s)
    # Cells that serve no line are left out: their projections would have no effect.
    used, line_start, line_stop, order = _served_lines(times[:, 2] > 0)
    middle_s = start_s + (edges_s[:-1] + edges_s[1:])[used] / 2
    ends_s = start_s + np.stack([edges_s[:-1], edges_s[1:]], -1)[used][order]
    table = cell_table(trajectory, shutter, frame, middle_s, line_start, line_stop, np.ones(used.size), lines)
    end_poses = trajectory.pose(frame, ends_s)
    if np.all(end_poses == table.pose[0]) and np.all(table.pose == table.pose[0]):
        return static_cells(trajectory, shutter, frame, start_s, lines)
    return replace(table, end_poses=end_poses, end_times_s=ends_s, line_times=times[used][order])


def _line_times(windows_s: np.ndarray, edges_s: np.ndarray) -> np.ndarray:
    """Returns three numbers for each segment and line (``TimeCells.line_times``), (K, 3, lines), from the lines' windows
    (lines, 2) in s and the edges (K + 1,) in s of K equal segments.

    A window leaves out its first or last segment if it covers at most ``_OVERHANG`` of that segment, so that fewer Gaussians
    are projected."""
    length_s = edges_s[1] - edges_s[0]
    count = len(edges_s) - 1
    opens, closes = ((windows_s - edges_s[0]) / length_s).T  # times after first light / length of a segment
    first = np.clip(np.floor(opens), 0, count - 1)
    last = np.clip(np.ceil(closes) - 1, first, count - 1)
    first = np.where((first < last) & (first + 1 - opens <= _OVERHANG), first + 1, first)
    last = np.where((first < last) & (closes - last <= _OVERHANG), last - 1, last)
    index = np.arange(count)[:, None]
    start = np.where(index == first, opens, index)
    stop = np.where(index == last, closes, index + 1)
    served = (index >= first) & (index <= last)
    instant = closes - opens <= _INSTANT * count
    share = np.where(instant, 1.0, (stop - start) / np.where(instant, 1.0, closes - opens))
    rows = ((start + stop) / 2 - index - 0.5, (stop - start) / 2, share)
    return np.stack([np.where(served, row, 0.0) for row in rows], 1)


def segments_for(
    trajectory: Trajectory, shutter: Shutter, frame: int, start_s: float, time_error: float,
    intensity_peak: float = 0.0
) -> int:
    """Returns how many segments of time, at most 1000, keep a frame's relative RMS error below ``time_error``.

    In a segment, Gaussians move along straight lines and keep their shape. The error is ``_TURN_FACTOR`` times the square of
    the gantry's turn in a segment, as benchmarks/time_exact.py measured for Gaussians of 0.5 to 4 % of the grid's
    half-width. intensity_peak: the largest line integral if the detector averages intensities, else 0. Averaging intensities
    adds an error of half the variance of the line integrals in a segment. Up to a peak of 4 this added error is the smaller
    one. Larger peaks need more segments."""
    first_s, last_s = shutter.lit_span_s
    pose = trajectory.pose(frame, start_s + np.linspace(first_s, last_s, _TURN_SAMPLES + 1))
    fastest_rad = float(np.max(_turns_rad(pose))) * _TURN_SAMPLES
    contrast = np.sqrt(max(1.0, intensity_peak / _HARMLESS_PEAK))
    count = np.ceil(contrast * fastest_rad * np.sqrt(_TURN_FACTOR / time_error))
    return int(np.clip(count, 1, _MOST_SEGMENTS))


def _turns_rad(pose: np.ndarray) -> np.ndarray:
    """Returns the larger angle (T − 1,) in rad by which source or panel turns from each pose (T, 12) to the next."""
    u_hat, _, normal = np.moveaxis(body_frames(pose), -1, 0)
    source = pose[:, :3] / np.maximum(np.linalg.norm(pose[:, :3], axis=1, keepdims=True), 1e-300)
    chords = [np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (u_hat, normal, source)]
    return np.asarray(np.max([2 * np.arcsin(chord.clip(0, 2) / 2) for chord in chords], axis=0))


def single_cell(trajectory: Trajectory, shutter: Shutter, frame: int, time_s: float, lines: int) -> TimeCells:
    """Returns one cell for all lines, with the pose at a time in s."""
    one = np.ones(1)
    return cell_table(trajectory, shutter, frame, time_s * one, 0 * one, lines * one, one, lines)


def cell_table(
    trajectory: Trajectory, shutter: Shutter, frame: int, time_s: np.ndarray, line_start: np.ndarray,
    line_stop: np.ndarray, weight: np.ndarray, lines: int
) -> TimeCells:
    """Returns still cells at times (C,) in s with the trajectory's poses at these times, sorted by ``line_start``. Other
    arrays (C,): as in ``TimeCells``."""
    order = np.argsort(line_start, kind="stable")
    return TimeCells(
        pose=trajectory.pose(frame, time_s[order]), time_s=time_s[order],
        line_start=line_start[order].astype(np.int32), line_stop=line_stop[order].astype(np.int32),
        weight=weight[order].astype(np.float64), lines=lines, axis=shutter.axis,
        is_parallel=is_parallel(trajectory),
    )
