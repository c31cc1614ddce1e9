"""How much of a calibration is done: passes through the frames, each as long as its level is fine."""

import math
from collections.abc import Callable, Mapping, Sequence

from phyradgs_cl.acquisition import Scan

Report = Callable[[int, int, str, float], None]
"""Takes passes done, passes in all, what is under way, and the share of the time that has gone by."""
Passes = Sequence[tuple[float, int]]
"""(what one of them costs, how many) of passes that are still to come."""


def cost_of(scans: Sequence[Scan], columns: int, most_frames: int) -> float:
    """What a pass costs at most so many ``columns``: in proportion to rays times voxels along one."""
    shape = scans[0].geometry.detector_shape
    rows, across = (math.ceil(n / math.ceil(max(shape) / columns)) for n in shape)
    return float(sum(min(scan.frames, most_frames) for scan in scans) * rows * across * max(rows, across))


class Work:
    """Counts passes and reports them. ``plan``: those of each phase to come, in order, at most: one that ends early, or
    is not needed, is taken out, so that the total falls and the time left stays true."""

    def __init__(self, report: Report, plan: Mapping[str, Passes]) -> None:
        self.plan = dict(plan)
        self._report = report
        self._done, self._spent, self._text, self._now = 0, 0.0, "", (0, 0.0)

    def begin(self, phase: str, text: str) -> None:
        """Goes on to a phase; those before it in the plan are over."""
        while phase in self.plan and next(iter(self.plan)) != phase:
            self.plan.pop(next(iter(self.plan)))
        self._text = text
        self.expect(self.plan.pop(phase, ()))
        self._say()

    def expect(self, passes: Passes) -> None:
        """Puts what is left of the phase under way in the place of what was planned."""
        self._now = sum(count for _, count in passes), sum(cost * count for cost, count in passes)

    def expect_at(self, cost: float, count: int) -> None:
        """``expect`` of so many passes of one cost."""
        self.expect([(cost, count)])

    def counts(self, cost: float) -> Callable[[], None]:
        """What counts a pass of this cost each time it is called."""

        def count() -> None:
            left, due = self._now
            self._done, self._spent, self._now = self._done + 1, self._spent + cost, (max(left - 1, 0), max(due - cost, 0.0))
            self._say()

        return count

    def _say(self) -> None:
        later = [one for passes in self.plan.values() for one in passes]
        total = self._done + self._now[0] + sum(count for _, count in later)
        due = self._now[1] + sum(cost * count for cost, count in later)
        self._report(self._done, total, self._text, self._spent / max(self._spent + due, 1e-30))
