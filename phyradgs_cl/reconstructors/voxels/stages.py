"""A run of several stages, each a run of its own that starts from the volume of the one before."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.checkpoint import check_array, checked_history, count_of
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    Report,
    State,
    history_arrays,
    state_arrays,
)

_STAGE, _VOLUME = "stage", "volume_before"  # of a state: which stage, and what it has started from
_HISTORY = {"record": "record_before", "seconds": "seconds_before"}


@dataclass(frozen=True)
class Stage:
    """run: from the volume before it, with a report, from a state of its own, if any. iterations: how many it has.

    shown: its volume, and the one before it, to what the whole run has by then (nz, ny, nx).
    """

    name: str
    iterations: int
    run: Callable[[np.ndarray | None, ProgressReport, State | None], Reconstruction]
    shown: Callable[[np.ndarray, np.ndarray | None], np.ndarray] = lambda volume, before: volume


@dataclass
class _Way:
    """What the stages so far have come to."""

    volume: np.ndarray | None
    index: int = 0
    iterations: int = 0
    seconds: float = 0.0
    record: list[dict[str, float]] = field(default_factory=list)

    def state(self, own: State) -> State:
        """The state of the present stage as the whole run's."""
        history = history_arrays(self.record, self.seconds)
        volume = {} if self.index == 0 or self.volume is None else {_VOLUME: self.volume}
        return {**own, **volume, **{_HISTORY[name]: a for name, a in history.items()}, _STAGE: np.array(self.index)}

    def restore(self, state: State, stages: Sequence[Stage], grid: Grid) -> State:
        """The inverse of ``state``; raises InputError for one that the run cannot have left."""
        self.index = count_of(state, _STAGE, len(stages) - 1)
        if self.index:
            (volume,) = state_arrays(state, [_VOLUME])
            check_array(_VOLUME, volume, grid.shape, np.float32)
            self.volume = volume
        before = dict(zip(_HISTORY, state_arrays(state, list(_HISTORY.values())), strict=True))
        self.record, self.seconds = checked_history(before)
        self.iterations = sum(stage.iterations for stage in stages[: self.index])
        return {name: array for name, array in state.items() if name not in (_STAGE, _VOLUME, *_HISTORY.values())}


def run_stages(
    stages: Sequence[Stage], grid: Grid, report: ProgressReport, resume: State | None, initial: np.ndarray | None
) -> Reconstruction:
    """One stage after the other, reported as one run, from ``initial`` or from a state of the whole run.

    The result is the last stage's; iterations, seconds and the record are of all, facts has ``stages``: those of each.
    """
    way, facts = _Way(initial), {}
    own, report = None if resume is None else way.restore(resume, stages, grid), Report.of(report)
    total = sum(stage.iterations for stage in stages)
    while True:
        stage = stages[way.index]
        with report.through(partial(_of_whole_run, stage, way, total, grid)):
            result = stage.run(way.volume, report, own)
        done = result.facts.get("iterations", stage.iterations)
        facts[stage.name], own = {"iterations": done, "seconds": result.facts["seconds"]}, None
        volume = stage.shown(result.volume, way.volume)
        at, state = result.facts["interrupted_at"], result.state
        state = None if state is None else way.state(state)
        way.record = _later(way.record, result.record, way.iterations)
        way.seconds += result.facts["seconds"]
        if at is not None or way.index == len(stages) - 1:
            break
        way.volume, way.index, way.iterations = volume, way.index + 1, way.iterations + stage.iterations
    whole: dict[str, Any] = {**result.facts, "stages": facts, "seconds": way.seconds}
    whole["iterations"] = way.iterations + done
    whole["interrupted_at"] = None if at is None else way.iterations + at
    return Reconstruction(volume, grid, result.gaussians, way.record, whole, state)


def _later(
    record: list[dict[str, float]], own: list[dict[str, float]], iterations: int
) -> list[dict[str, float]]:
    return record + [{**line, "iteration": iterations + line["iteration"]} for line in own]


def _of_whole_run(stage: Stage, way: _Way, total: int, grid: Grid, progress: Progress) -> Progress:
    """Returns the progress of one stage as that of the whole run."""
    return progress.mapped(
        state=way.state,
        volume=lambda volume, _: (stage.shown(volume, way.volume), grid),
        iteration=way.iterations + progress.iteration,
        iterations=total,
        seconds=way.seconds + progress.seconds,
    )
