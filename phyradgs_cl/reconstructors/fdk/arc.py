"""The angles that views cover, in any order and over any number of turns, and the angle for which each view stands."""

from dataclasses import dataclass, replace

import numpy as np

# A gap between views stands out if it is wider than this many times another gap; one lost view makes a gap of 2 steps.
# The widest gap is compared with the second widest: compared with the median, uneven full turns would look like short scans.
# Any gap wider than _WIDE_RAD is compared with both gaps beside it.
SHORT_SCAN_GAP = 2.5
_SAME_VIEW = 0.05  # views nearer to each other than this fraction of the mean gap count as one repeated view
# A warning names filled gaps from this width on: narrower ones changed the density of large balls by less than 1 %.
_NAMED_RAD = np.deg2rad(5)
# All gaps up to this width, except the widest, are filled: dividing the arc there would cost more accuracy.
_WIDE_RAD = np.deg2rad(10)
# A misaligned panel measures a strip of rays once only. Gaps up to this width are filled, so that the strip counts fully.
FILLED_RAD = np.deg2rad(15)
# Views nearer to a filled gap than this fraction of its width stand for the gap: more views smear, fewer draw streaks.
_FILL_REACH = 0.5


@dataclass(frozen=True, eq=False)
class Arc:
    """The angles that the views cover, and how much of them each view stands for.

    - gap_rad (F,): the angle for which each view stands. coverage_rad: the angle that all views cover. is_full: a full turn.
    - progress_rad (F,): each view's angle from the arc's start. The arc is half a step longer than the views at both ends; a
      full turn starts at the view of the least angle.
    - parts_rad (P, 2): progress at which each part between gaps begins and ends.
    - filled_rad: sum over the gaps above 5° for which neighbouring views stand of (gap − usual gap)."""

    gap_rad: np.ndarray
    progress_rad: np.ndarray
    coverage_rad: float
    is_full: bool
    parts_rad: np.ndarray
    filled_rad: float = 0.0

    def unseen_rad(self, fan_rad: float = 0.0) -> float:
        """Returns the part of half a turn, in rad, in which neither a ray nor its opposite is measured: the largest value
        of rays at fan angles −fan_rad, 0 and fan_rad."""
        at_rad = np.linspace(0, 2 * np.pi, 1440, endpoint=False)
        fans = (-fan_rad, 0.0, fan_rad)
        shares = [(self.covers(at_rad) | self.covers(at_rad + np.pi + 2 * fan)).mean() for fan in fans]
        return float(np.pi * (1 - min(shares)))

    def covers(self, at_rad: np.ndarray) -> np.ndarray:
        """Returns which of the angles (...), given as progress in rad, lie in a part of the arc; bool (...)."""
        turned = np.mod(at_rad, 2 * np.pi)[..., None]
        return ((turned >= self.parts_rad[:, 0]) & (turned <= self.parts_rad[:, 1])).any(-1)


def view_arc(angle_rad: np.ndarray, filled_rad: float = 0.0) -> Arc:
    """Returns the arc that views at gantry angles (F,) cover, in any order and over any number of turns.

    Gaps that stand out divide the arc into parts. If none is wider than ``filled_rad``, the arc is a full turn, and the
    views at both sides stand for the gaps."""
    cell, centre = distinct_views(angle_rad)
    count = np.bincount(cell)
    ahead = np.diff(centre, append=centre[0] + 2 * np.pi)
    wide = _stand_out(ahead)
    wide &= ~_only_here(centre, ahead, wide)
    if not wide.any() or ahead[wide].max() <= filled_rad:
        gap = _filled_cells(ahead, wide)
        whole = np.array([[0.0, 2 * np.pi]])
        return Arc((gap / count)[cell], (centre - centre[0])[cell], 2 * np.pi, True, whole, _filled_rad(ahead))
    first = (int(np.argmax(np.where(wide, ahead, 0))) + 1) % ahead.size
    ahead, wide = np.roll(ahead, -first), np.roll(wide, -first)  # so that the widest gap that stands out is the last
    forward, back = _steps(ahead, wide)
    progress = np.concatenate([[0.0], np.cumsum(ahead[:-1])]) + back[0] / 2
    parts = np.stack([(progress - back / 2)[np.roll(wide, 1)], (progress + forward / 2)[wide]], -1)
    gap, filled = (forward + back) / 2, _filled_rad(ahead[~wide])
    place = (cell - first) % ahead.size
    arc = Arc((gap / np.roll(count, -first))[place], progress[place], float(gap.sum()), False, parts, filled)
    return arc if len(parts) == 1 else replace(arc, gap_rad=arc.gap_rad * np.pi / (np.pi - arc.unseen_rad()))


def _stand_out(ahead: np.ndarray) -> np.ndarray:
    """Returns which gaps ``ahead`` (K,), from each view to the next, are wide, bool (K,): the widest if it stands out from
    all others, and any gap above 10° that stands out from the two gaps beside it."""
    wide = np.zeros(ahead.size, bool)
    if ahead.size < 2:
        return wide
    second, largest = np.sort(ahead)[-2:]
    wide[np.argmax(ahead)] = largest > SHORT_SCAN_GAP * second
    beside = np.maximum(np.roll(ahead, 1), np.roll(ahead, -1))
    return wide | (ahead > np.maximum(SHORT_SCAN_GAP * beside, _WIDE_RAD))


def _only_here(centre: np.ndarray, ahead: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Returns which ``wide`` gaps ``ahead`` (K,), at most 15°, have another wide gap opposite, bool (K,). No opposite rays
    measure such a gap, so the views at its sides fill it. The widest gap is left out. centre (K,): angles of the views."""
    narrow = wide & (ahead <= FILLED_RAD) & (np.arange(ahead.size) != np.argmax(ahead))
    opposite = centre + ahead / 2 + np.pi
    before = np.searchsorted(centre, np.mod(opposite - centre[0], 2 * np.pi) + centre[0], side="right") - 1
    return narrow & wide[before]


def _steps(ahead: np.ndarray, wide: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the steps in rad from each view to the next (K,), and to each view from the one before (K,). They are the gaps
    ``ahead`` (K,); a gap that is ``wide``, bool (K,), is replaced by the gap on the view's other side."""
    forward = np.where(wide, np.roll(ahead, 1), ahead)
    return forward, np.roll(np.where(wide, np.roll(ahead, -1), ahead), 1)


def _filled_rad(ahead: np.ndarray) -> float:
    """Returns Σ (gap − usual) in rad over wide gaps; usual: max(median gap, both gaps beside it). ahead (K,): all gaps."""
    usual = np.maximum(np.median(ahead) if ahead.size else 0.0, np.maximum(np.roll(ahead, 1), np.roll(ahead, -1)))
    return float((ahead - usual)[ahead > np.maximum(SHORT_SCAN_GAP * usual, _NAMED_RAD)].sum())


def _filled_cells(ahead: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Returns the angle (K,) in rad for which each view of a full turn stands. A wide gap is divided among the views near
    it, with larger parts for nearer views. ahead, wide: as in ``_steps``."""
    forward, back = _steps(ahead, wide)
    known = (forward + back) / 2
    cells = known.copy()
    for gap in np.flatnonzero(wide):
        turned = np.cumsum(np.roll(ahead, -gap))  # angle from the view before the gap to each other view
        away_rad = np.minimum(turned - ahead[gap], 2 * np.pi - turned)
        near = np.roll(np.maximum(1 - away_rad / (_FILL_REACH * ahead[gap]), 0), gap + 1) * known
        cells += (ahead[gap] - (forward[gap] + np.roll(back, -1)[gap]) / 2) * near / near.sum()
    return cells


def distinct_views(angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns each view's index (F,) into the K distinct angles, and these angles (K,) in rad, ascending within a turn."""
    turned = np.mod(np.asarray(angle_rad, np.float64), 2 * np.pi)
    order = np.argsort(turned, kind="stable")
    tolerance = _SAME_VIEW * 2 * np.pi / turned.size
    is_new = np.diff(turned[order], prepend=-np.inf) > tolerance
    index = np.cumsum(is_new) - 1
    centre = turned[order][is_new]
    if centre.size > 1 and centre[0] + 2 * np.pi - turned[order[-1]] <= tolerance:  # first and last are one, as 0° and 360°
        index[index == centre.size - 1] = 0
        centre = centre[:-1]
    cell = np.empty(turned.size, np.int64)
    cell[order] = index
    return cell, centre
