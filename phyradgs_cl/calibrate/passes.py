"""Progress of a calibration: passes through the frames, each of which costs more on a finer grid."""

import math
from collections.abc import Callable, Mapping, Sequence

from phyradgs_cl.acquisition import Scan

Report = Callable[[int, int, str, float], None]
"""Takes passes done, passes in all, the phase, and the share of the time that has passed."""
Passes = Sequence[tuple[float, int]]
"""Passes to come: (cost of one, number)."""


def pass_cost(scans: Sequence[Scan], columns: int, most_frames: int) -> float:
    """Returns the cost of one pass with at most ``columns``: in proportion to rays times voxels along a ray."""
    shape = scans[0].geometry.detector_shape
    rows, across = (math.ceil(n / math.ceil(max(shape) / columns)) for n in shape)
    return float(sum(min(scan.frames, most_frames) for scan in scans) * rows * across * max(rows, across))


class PassCounter:
    """Counts passes and reports them. ``plan``: the most passes of each phase, in order. Passes that turn out not to be
    needed are removed, so that the total falls and the time left stays true."""

    def __init__(self, report: Report, plan: Mapping[str, Passes]) -> None:
        self.plan = dict(plan)
        self._report = report
        self._done, self._spent, self._text = 0, 0.0, ""
        self._current: tuple[int, float] = (0, 0.0)  # passes and cost that remain in this phase

    def begin(self, phase: str, text: str) -> None:
        """Begins a phase; the plan's earlier phases are over."""
        while phase in self.plan and next(iter(self.plan)) != phase:
            self.plan.pop(next(iter(self.plan)))
        self._text = text
        self.expect(self.plan.pop(phase, ()))
        self._say()

    def expect(self, passes: Passes) -> None:
        """Replaces what remains of this phase."""
        self._current = _total(passes)

    def counter(self, cost: float) -> Callable[[], None]:
        """Returns a function that counts one pass of this cost at each call."""

        def count() -> None:
            passes, remaining = self._current
            self._done, self._spent = self._done + 1, self._spent + cost
            self._current = max(passes - 1, 0), max(remaining - cost, 0.0)
            self._say()

        return count

    def _say(self) -> None:
        later_count, later_cost = _total([one for passes in self.plan.values() for one in passes])
        count, cost = self._current
        spent_share = self._spent / max(self._spent + (cost + later_cost), 1e-30)
        self._report(self._done, self._done + count + later_count, self._text, spent_share)


def _total(passes: Passes) -> tuple[int, float]:
    """Returns the number and the cost of all passes."""
    return sum(count for _, count in passes), sum(cost * count for cost, count in passes)
