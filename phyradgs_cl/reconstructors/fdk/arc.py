"""The arcs that views cover, and each view's share of them."""

from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.reconstructors.fdk import weights

# A scan with one gap that stands out is short. It is compared with the second largest and not with the median, so
# that uneven views (four times as dense over one half, say) stay a full turn; 2.5 lets one view of many be lost.
SHORT_SCAN_GAP = 2.5
_SAME_VIEW = 1e-3  # of the mean gap: views closer than this share one cell (a second turn over the first)
# Filled gaps up to the first cost less than 1 % of the density of balls a quarter of the field wide; larger than the
# second they part the arc. Between the two more parts would cost more than filled gaps.
_NAMED_RAD, _WIDE_RAD = np.deg2rad(5), np.deg2rad(10)
# A misaligned panel's rays come again half a turn later, but for a strip that is measured once. Its small gaps are filled,
# so that the strip counts fully; with a larger one it is a short scan.
_FILLED_RAD = np.deg2rad(15)
_FILL_REACH = 0.5  # of a gap: how far from it views stand for it; larger smears, smaller draws streaks where it is wide


@dataclass(frozen=True, eq=False)
class Arc:
    """The views' angular cells.

    gap_rad (F,) is each view's share of the arc; progress_rad (F,) its angle from the start of the arc, which
    begins half a step before the first view and ends half a step behind the last. A full turn has no start.
    parts_rad (P, 2): where the parts between gaps begin and end, as progress. filled_rad: what the gaps take for which
    the views beside them stand."""

    gap_rad: np.ndarray
    progress_rad: np.ndarray
    coverage_rad: float
    is_full: bool
    parts_rad: np.ndarray
    filled_rad: float = 0.0

    def unseen_rad(self, fan_rad: float = 0.0) -> float:
        """Returns the angle, of half a turn, from which rays up to this fan angle are measured from neither side."""
        at_rad = np.linspace(0, 2 * np.pi, 1440, endpoint=False)
        shares = [
            (self.covers(at_rad) | self.covers(at_rad + np.pi + 2 * fan)).mean() for fan in (-fan_rad, 0.0, fan_rad)
        ]
        return float(np.pi * (1 - min(shares)))

    def covers(self, at_rad: np.ndarray) -> np.ndarray:
        """Whether a part holds each angle (...), given as progress."""
        turned = np.mod(at_rad, 2 * np.pi)[..., None]
        held: np.ndarray = ((turned >= self.parts_rad[:, 0]) & (turned <= self.parts_rad[:, 1])).any(-1)
        return held


def filled_gap_rad(fan: weights.Fan) -> float:
    """Returns the widest gap that the views beside it stand for, because they alone see some of its rays."""
    if fan.is_put_aside:
        return 2 * np.pi
    return _FILLED_RAD if fan.is_displaced else 0.0


def view_arc(angle_rad: np.ndarray, filled_rad: float = 0.0) -> Arc:
    """Returns the arc that views at angles (F,) cover, in any order and over any number of turns.

    Gaps that stand out part it, unless all are at most ``filled_rad`` wide: then the views beside them stand for them."""
    cell, centre = _distinct(angle_rad)
    count = np.bincount(cell)
    ahead = np.diff(centre, append=centre[0] + 2 * np.pi)
    wide = _stand_out(ahead)
    wide &= ~_only_here(centre, ahead, wide)
    if not wide.any() or ahead[wide].max() <= filled_rad:
        gap = _filled_cells(ahead, wide)
        whole = np.array([[0.0, 2 * np.pi]])
        return Arc((gap / count)[cell], (centre - centre[0])[cell], 2 * np.pi, True, whole, _filled_rad(ahead))
    first = (int(np.argmax(np.where(wide, ahead, 0))) + 1) % ahead.size
    ahead, wide = np.roll(ahead, -first), np.roll(wide, -first)  # the widest gap that stands out is now the last
    forward, back = _steps(ahead, wide)
    progress = np.concatenate([[0.0], np.cumsum(ahead[:-1])]) + back[0] / 2
    parts = np.stack([(progress - back / 2)[np.roll(wide, 1)], (progress + forward / 2)[wide]], -1)
    gap, filled = (forward + back) / 2, _filled_rad(ahead[~wide])
    place = (cell - first) % ahead.size
    arc = Arc((gap / np.roll(count, -first))[place], progress[place], float(gap.sum()), False, parts, filled)
    return arc if len(parts) == 1 else replace(arc, gap_rad=arc.gap_rad * np.pi / (np.pi - arc.unseen_rad()))


def _stand_out(ahead: np.ndarray) -> np.ndarray:
    """Returns which gaps (K,) to the next view are no steps between views: the largest of all, and those beside steps."""
    wide = np.zeros(ahead.size, bool)
    if ahead.size < 2:
        return wide
    second, largest = np.sort(ahead)[-2:]
    wide[np.argmax(ahead)] = largest > SHORT_SCAN_GAP * second
    beside = np.maximum(np.roll(ahead, 1), np.roll(ahead, -1))
    return wide | (ahead > np.maximum(SHORT_SCAN_GAP * beside, _WIDE_RAD))


def _only_here(centre: np.ndarray, ahead: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Returns which narrow gaps (K,) no views opposite to them cover, so that those beside them have to; not the widest."""
    narrow = wide & (ahead <= _FILLED_RAD) & (np.arange(ahead.size) != np.argmax(ahead))
    opposite = centre + ahead / 2 + np.pi
    before = np.searchsorted(centre, np.mod(opposite - centre[0], 2 * np.pi) + centre[0], side="right") - 1
    return narrow & wide[before]


def _steps(ahead: np.ndarray, wide: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the step (K,) from each view to the next and from the one before; at a gap it is that on the other side."""
    forward = np.where(wide, np.roll(ahead, 1), ahead)
    return forward, np.roll(np.where(wide, np.roll(ahead, -1), ahead), 1)


def _filled_rad(ahead: np.ndarray) -> float:
    """Returns what gaps (K,) take that are much wider than the usual step."""
    usual = np.median(ahead) if ahead.size else 0.0
    return float((ahead - usual)[ahead > max(SHORT_SCAN_GAP * usual, _NAMED_RAD)].sum())


def _filled_cells(ahead: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Returns the cells (K,) of views of a full turn. Those near a wide gap share it, the nearer the more."""
    forward, back = _steps(ahead, wide)
    known = (forward + back) / 2
    cells = known.copy()
    for gap in np.flatnonzero(wide):
        turned = np.cumsum(np.roll(ahead, -gap))  # from the view before the gap to all others, the next one first
        away_rad = np.minimum(turned - ahead[gap], 2 * np.pi - turned)
        near = np.roll(np.maximum(1 - away_rad / (_FILL_REACH * ahead[gap]), 0), gap + 1) * known
        cells += (ahead[gap] - (forward[gap] + np.roll(back, -1)[gap]) / 2) * near / near.sum()
    return cells


def _distinct(angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns each view's cell (F,), and the cells' ascending angles (K,) on the turn."""
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


