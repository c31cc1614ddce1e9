"""How the views of a scan share the turn: angular cells, full turns and short scans."""

from dataclasses import dataclass

import numpy as np

# A short scan has one gap that stands out. It is compared with the second largest and not with the median, so
# that uneven views (four times as dense over one half, say) stay a full turn; 2.5 lets one view of many be lost.
SHORT_SCAN_GAP = 2.5
_SAME_VIEW = 1e-3  # of the mean gap: views closer than this share one cell (a second turn over the first)


@dataclass(frozen=True, eq=False)
class Arc:
    """The views' angular cells.

    gap_rad (F,) is each view's share of the arc; progress_rad (F,) its angle from the start of the arc, which
    begins half a step before the first view and ends half a step behind the last. A full turn has no start.
    """

    gap_rad: np.ndarray
    progress_rad: np.ndarray
    coverage_rad: float
    is_full: bool


def view_arc(angle_rad: np.ndarray) -> Arc:
    """The arc that views at angles (F,) cover, in any order and over any number of turns."""
    cell, centre = _distinct(angle_rad)
    count = np.bincount(cell)
    ahead = np.diff(centre, append=centre[0] + 2 * np.pi)
    if not _is_short(ahead):
        gap = (ahead + np.roll(ahead, 1)) / 2
        return Arc((gap / count)[cell], (centre - centre[0])[cell], 2 * np.pi, True)
    first = (int(np.argmax(ahead)) + 1) % ahead.size
    ahead, centre = np.roll(ahead, -first), np.roll(centre, -first)  # the gap is now the last
    ahead[-1] = ahead[-2]
    behind = np.concatenate([ahead[:1], ahead[:-1]])
    gap = (ahead + behind) / 2
    progress = np.concatenate([[0.0], np.cumsum(ahead[:-1])]) + behind[0] / 2
    place = (cell - first) % ahead.size
    return Arc((gap / np.roll(count, -first))[place], progress[place], float(gap.sum()), False)


def _is_short(ahead: np.ndarray) -> bool:
    if ahead.size < 2:
        return False
    second, largest = np.sort(ahead)[-2:]
    return bool(largest > SHORT_SCAN_GAP * second)


def _distinct(angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each view its cell's index (F,), and the cells' ascending angles (K,), from angles on the turn."""
    turned = np.mod(np.asarray(angle_rad, np.float64), 2 * np.pi)
    order = np.argsort(turned, kind="stable")
    tolerance = _SAME_VIEW * 2 * np.pi / turned.size
    is_new = np.diff(turned[order], prepend=-np.inf) > tolerance
    index = np.cumsum(is_new) - 1
    centre = turned[order][is_new]
    if centre.size > 1 and centre[0] + 2 * np.pi - turned[order[-1]] <= tolerance:  # 0° and 360° are one
        index[index == centre.size - 1] = 0
        centre = centre[:-1]
    cell = np.empty(turned.size, np.int64)
    cell[order] = index
    return cell, centre
