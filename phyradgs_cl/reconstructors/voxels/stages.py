"""Runs of several stages: each stage starts from the volume of the stage before it.

``fista`` reconstructs voxels, then subvoxels: coarse voxels cannot represent edges. The last passes therefore run on voxels
half as large; their block means make up most of the result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.reconstructors.checkpoint import State, history_arrays, history_of
from phyradgs_cl.reconstructors.result import Progress, Reconstruction, Report
from phyradgs_cl.reconstructors.voxels.run import MethodInputs

_STAGE, _VOLUME = "stage", "volume_before"  # entries of a state: the present stage, and the volume that it started from
_HISTORY = {"record": "record_before", "seconds": "seconds_before"}


@dataclass(frozen=True)
class Stage:
    """One stage: its number of iterations and a function that runs them.

    ``merge`` combines the stage's volume and that of the stages before it to the result of the whole run (nz, ny, nx)."""

    name: str
    iterations: int
    run: Callable[[MethodInputs], Reconstruction]
    merge: Callable[[np.ndarray, np.ndarray | None], np.ndarray] = lambda volume, before: volume


@dataclass
class StageProgress:
    """The result of the finished stages: volume, iterations, seconds and record; ``index``: the present stage."""

    volume: np.ndarray | None
    index: int = 0
    iterations: int = 0
    seconds: float = 0.0
    record: list[dict[str, float]] = field(default_factory=list)

    def state(self, stage_state: State) -> State:
        """Returns the state of the present stage as one of the whole run."""
        history = history_arrays(self.record, self.seconds)
        volume = {} if self.index == 0 or self.volume is None else {_VOLUME: self.volume}
        history = {_HISTORY[name]: array for name, array in history.items()}
        return {**stage_state, **volume, **history, _STAGE: np.array(self.index)}

    def restore(self, state: State, stages: Sequence[Stage]) -> State:
        """Continues from ``state``. Returns the present stage's own."""
        self.index = int(state[_STAGE])
        if self.index:
            self.volume = state[_VOLUME]
        self.record, self.seconds = history_of({name: state[stored] for name, stored in _HISTORY.items()})
        self.iterations = sum(stage.iterations for stage in stages[: self.index])
        return {name: array for name, array in state.items() if name not in (_STAGE, _VOLUME, *_HISTORY.values())}

    def finish(self, stage: Stage, result: Reconstruction) -> None:
        """Adds a stage's record and seconds."""
        shifted = [{**line, "iteration": self.iterations + line["iteration"]} for line in result.record]
        self.record = self.record + shifted
        self.seconds += result.facts["seconds"]


def run_stages(stages: Sequence[Stage], inputs: MethodInputs) -> Reconstruction:
    """Runs one stage after the other as one run, which is reported, stopped and resumed as such.

    Iterations, seconds and the record are those of all stages; the other facts are the last stage's. The fact ``stages``
    lists the iterations and seconds of each."""
    progress, stage_facts, grid = StageProgress(inputs.initial), {}, inputs.scan.grid
    resume = None if inputs.resume is None else progress.restore(inputs.resume, stages)
    report, total = Report.of(inputs.report), sum(stage.iterations for stage in stages)
    for stage in stages[progress.index :]:
        with report.through(partial(_of_whole_run, stage, progress, total, grid)):
            result = stage.run(replace(inputs, initial=progress.volume, report=report, resume=resume))
        volume, state = stage.merge(result.volume, progress.volume), result.state
        state = None if state is None else progress.state(state)
        iterations, interrupted_at = result.facts.get("iterations", stage.iterations), result.facts["interrupted_at"]
        stage_facts[stage.name] = {"iterations": iterations, "seconds": result.facts["seconds"]}
        progress.finish(stage, result)
        if interrupted_at is not None or stage is stages[-1]:
            break
        resume, progress.volume = None, volume
        progress.index, progress.iterations = progress.index + 1, progress.iterations + stage.iterations
    facts: dict[str, Any] = {**result.facts, "stages": stage_facts, "seconds": progress.seconds}
    facts["iterations"] = progress.iterations + iterations
    facts["interrupted_at"] = None if interrupted_at is None else progress.iterations + interrupted_at
    return Reconstruction(volume, grid, record=progress.record, facts=facts, state=state)


def _of_whole_run(stage: Stage, done: StageProgress, total: int, grid: Grid, progress: Progress) -> Progress:
    """Returns the progress of one stage as that of the whole run."""
    return progress.mapped(
        state=done.state, volume=lambda volume, _: (stage.merge(volume, done.volume), grid),
        iteration=done.iterations + progress.iteration, iterations=total,
        seconds=done.seconds + progress.seconds,
    )


def repeated(volume: np.ndarray | None, parts: int) -> np.ndarray | None:
    """Returns a volume with every voxel repeated ``parts`` times along each axis; None stays None."""
    return None if volume is None else volume.repeat(parts, 0).repeat(parts, 1).repeat(parts, 2)


def merge_subvoxels(volume: np.ndarray, before: np.ndarray | None, parts: int, share: float) -> np.ndarray:
    """Returns the mean of ``before`` (nz, ny, nx) and, weighted by ``share``, of the means of ``volume`` over blocks."""
    assert before is not None
    return before + np.float32(share) * (block_means(volume, (parts,) * 3) - before)
