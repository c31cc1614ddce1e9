"""Time cells on one grid of times that all lines of a frame share, with a weight for each line.

A line takes from each cell the share of its own window that lies in the cell:
P(v) = Σ_k w_k(v) P(θ(t_k), v), t_k the cell's middle, w_k(v) = |window(v) ∩ cell k| / |window(v)|.
One pose then serves many lines, which operators project together: the paper's strip concatenation with fractional strips.
"""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells, cell_table, per_line_cells
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import Trajectory

_SAME_TIME = 1e-6  # of a cell: how exactly a frame has to begin on the grid of the first one
_NOTHING = 1e-9  # of a window: smaller shares are rounding


def common_time_cells(
    trajectory: Trajectory, shutter: Shutter, frame: int, frame_start_s: np.ndarray, lines: int, samples: int
) -> TimeCells:
    """Cells of an exposure / ``samples``, from a frame's first light to its last.

    frame_start_s (F,): of all frames. Frames that begin on the grid of the first one, as in a scan without gaps between its
    exposures, share poses where they overlap in time. A shutter that never stays open, or whose cells are shorter than the
    readout of a line, leaves nothing to share: its lines get times of their own.
    """
    start_s = float(frame_start_s[frame])
    windows_s = shutter.line_windows_s(lines)
    length_s = float(np.ptp(windows_s, axis=1).max())
    first_s, last_s = float(windows_s.min()), float(windows_s.max())
    step_s = length_s / samples
    if length_s <= 0 or last_s - first_s > lines * step_s:
        return per_line_cells(trajectory, shutter, frame, start_s, lines, samples if length_s > 0 else 1)
    edges_s = first_s + step_s * np.arange(np.ceil((last_s - first_s) / step_s - _SAME_TIME) + 1)
    share = _shares(windows_s, edges_s)
    served = share > 0
    kept = np.flatnonzero(served.any(axis=1))
    latest_s = float(np.max(frame_start_s)) + last_s - step_s / 2  # trajectories may be known to the end of the scan alone
    middle_s = np.minimum(_middles_s(frame_start_s, frame, edges_s), latest_s)[kept]
    start = served[kept].argmax(axis=1)
    stop = lines - served[kept, ::-1].argmax(axis=1)
    order = np.argsort(start, kind="stable")
    table = cell_table(trajectory, shutter, frame, middle_s, start, stop, np.ones(kept.size), lines)
    return replace(table, line_share=share[kept][order])


def _middles_s(frame_start_s: np.ndarray, frame: int, edges_s: np.ndarray) -> np.ndarray:
    """Middles of cells; of frames on the first one's grid the same numbers, bit for bit, for the same cells."""
    step_s = edges_s[1] - edges_s[0]
    start_s, origin_s = float(frame_start_s[frame]), float(frame_start_s[0])
    cells = (start_s - origin_s) / step_s
    number = np.arange(len(edges_s) - 1) + 0.5
    if abs(cells - round(cells)) < _SAME_TIME:
        start_s, number = origin_s, round(cells) + number
    middles_s: np.ndarray = start_s + edges_s[0] + number * step_s
    return middles_s


def _shares(windows_s: np.ndarray, edges_s: np.ndarray) -> np.ndarray:
    """The share (K, lines) of each line's window (lines, 2) in each cell between edges (K + 1,); columns sum to 1."""
    opens, closes = windows_s.T
    length_s = closes - opens
    overlap = np.minimum(closes, edges_s[1:, None]) - np.maximum(opens, edges_s[:-1, None])
    share = np.maximum(overlap, 0) / np.where(length_s > 0, length_s, 1)
    moment = np.clip(np.searchsorted(edges_s, opens, side="right") - 1, 0, len(edges_s) - 2)
    share[:, length_s <= 0] = 0
    share[moment[length_s <= 0], np.flatnonzero(length_s <= 0)] = 1
    share[share < _NOTHING] = 0
    total: np.ndarray = share / share.sum(axis=0)
    return total
