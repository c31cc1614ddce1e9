"""The grids of a calibration, from coarse to fine, and its progress in passes through the frames."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.checks import ceil_div

Report = Callable[[int, int, str, float], None]
"""Takes the passes done, the passes in all, the phase, and the share of the time that has passed."""
_LEAST_SHARE = 0.1  # lower limit of the cost still expected of a phase, over that of the most passes still to come
Passes = tuple[int, float]
"""The most passes to come, and the cost that all passes are expected to have together."""


@dataclass(frozen=True)
class Stage:
    """One grid of a calibration: at most ``columns`` blocks of pixels along the panel's longer side.

    first, again: iterations of a first volume and of a later one. steps: the most Gauss–Newton steps. project: iterations
    of CGLS in each step that remove what a volume explains."""

    columns: int
    first: int
    again: int
    steps: int = 3
    project: int = 20

    def block(self, scan: Scan) -> int:
        """Returns the pixels along a block's side."""
        return ceil_div(max(scan.geometry.detector_shape), self.columns)

    def passes(self, parameters: int, asks: bool) -> int:
        """Returns the largest number of passes through the frames. asks: the stage also tests which parameters the frames
        determine."""
        return self.first - self.again + self.steps * (self.again + self.project * (parameters + (3 if asks else 1)))


def pass_cost(scans: Sequence[Scan], columns: int, most_frames: int) -> float:
    """Returns the cost of a pass through the scans with at most ``columns`` blocks, proportional to rays × voxels along a
    ray."""
    shape = scans[0].geometry.detector_shape
    rows, across = (ceil_div(n, ceil_div(max(shape), columns)) for n in shape)
    return float(sum(min(scan.frames, most_frames) for scan in scans) * rows * across * max(rows, across))


class PassCounter:
    """Counts passes and reports them. plan: number and cost of the passes of each phase, in order. Passes that turn out
    not to be needed are removed, so that the total falls."""

    def __init__(self, report: Report, plan: Mapping[str, Passes]) -> None:
        self.plan = dict(plan)
        self._report = report
        self._done, self._spent, self._text = 0, 0.0, ""
        self._current: Passes = (0, 0.0)  # passes that remain in this phase

    def begin(self, phase: str, text: str) -> None:
        """Begins a phase, with the words of its report; earlier phases of the plan are over."""
        while phase in self.plan and next(iter(self.plan)) != phase:
            self.plan.pop(next(iter(self.plan)))
        self._text, self._current = text, self.plan.pop(phase, (0, 0.0))
        self._say()

    def counter(self, cost: float) -> Callable[[], None]:
        """Returns a function that counts one pass of this cost at each call."""

        def count() -> None:
            passes, remaining = self._current
            self._done, self._spent = self._done + 1, self._spent + cost
            self._current = max(passes - 1, 0), max(remaining - cost, _LEAST_SHARE * max(passes - 1, 0) * cost)
            self._say()

        return count

    def _say(self) -> None:
        passes, costs = zip(self._current, *self.plan.values(), strict=True)
        spent_share = self._spent / max(self._spent + sum(costs), 1e-30)
        self._report(self._done, self._done + sum(passes), self._text, spent_share)
