"""Runs of several stages: each stage starts from the volume of the stage before it.

``fista`` reconstructs voxels, then smaller voxels, because large voxels cannot represent edges: the last passes run on
voxels of half the side. Their means over blocks as large as the first voxels make up most of the result."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.voxels.run import MethodRun, WithFacts

# Names of arrays in a state: the stage's number, its first volume, and the names of all the run's stages, with commas.
_STAGE, _VOLUME, STAGES = "stage", "volume_before", "stages"


@dataclass(frozen=True)
class Stage:
    """One stage of a run. make: returns the stage's method, which starts from the given volume (nz, ny, nx), or from its own
    first volume if None is given. merge: returns the run's volume, from this stage's volume and that of the stage before.
    end: is called with the stage's method when the stage ends."""

    name: str
    iterations: int
    make: Callable[[np.ndarray | None], WithFacts]
    merge: Callable[[np.ndarray, np.ndarray | None], np.ndarray] = lambda volume, before: volume
    end: Callable[[Any], object] = lambda method: None


class Stages:
    """Several stages, one after the other, which a ``Loop`` runs, reports, stops and resumes as if they were one method.

    The first stage starts from ``run.initial``; if that is None, from its method's own first volume."""

    def __init__(self, stages: Sequence[Stage], run: MethodRun) -> None:
        self.stages, self.grid = stages, run.scan.grid
        self.before = run.initial
        self.iterations = sum(stage.iterations for stage in stages)
        self._facts: dict[str, Any] = {"stages": {}}
        index = 0
        if run.resume is not None:
            index, self.before = int(run.resume[_STAGE]), run.resume.get(_VOLUME, run.initial)
        self.stage, self._index, self._started = stages[index], index, run.started
        self.method: WithFacts = self.stage.make(self.before)

    @property
    def quantity(self) -> str:
        return self.method.quantity

    @property
    def remedy(self) -> str:
        return self.method.remedy

    @property
    def iteration(self) -> int:
        return sum(stage.iterations for stage in self.stages[: self._index]) + self.method.iteration

    @property
    def is_last(self) -> bool:
        return self._index == len(self.stages) - 1

    @property
    def finished(self) -> str | None:
        return self.method.finished if self.is_last else None

    def step(self) -> None:
        while not self.is_last and (self.method.iteration >= self.stage.iterations or self.method.finished):
            self.advance()
        self.method.step()

    def advance(self) -> None:
        """Ends the present stage and begins the next. Frees the old stage's memory first, since both may not fit at once."""
        self.before, _ = self.present_volume()
        self.stage.end(self.method)
        self._note()
        self._index, self._started = self._index + 1, time.perf_counter()
        self.stage = self.stages[self._index]
        del self.method
        self.method = self.stage.make(self.before)

    def _note(self) -> None:
        seconds = time.perf_counter() - self._started
        self._facts["stages"][self.stage.name] = {"iterations": self.method.iteration, "seconds": seconds}
        self._facts.update(self.method.facts(True))

    def facts(self, is_complete: bool) -> Mapping[str, object]:
        """Returns the facts of the last stage that ran, with each stage's iterations, and its seconds in this process. A
        complete run first ends all stages before the last, since a last stage of 0 iterations has not begun yet."""
        while is_complete and not self.is_last:
            self.advance()
        self._note()
        return self._facts

    def measures(self) -> Mapping[str, float]:
        return self.method.measures()

    def state(self) -> dict[str, np.ndarray]:
        volume = {} if self._index == 0 or self.before is None else {_VOLUME: self.before}
        names = ",".join(stage.name for stage in self.stages).encode()
        return {**self.method.state(), **volume, _STAGE: np.array(self._index), STAGES: np.frombuffer(names, np.uint8)}

    def restore(self, state: State) -> None:
        self.method.restore(state)

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        return self.stage.merge(self.method.present_volume()[0], self.before), self.grid


def repeated(volume: np.ndarray | None, parts: int) -> np.ndarray | None:
    """Returns a volume with every voxel repeated ``parts`` times along each axis; None stays None."""
    return None if volume is None else volume.repeat(parts, 0).repeat(parts, 1).repeat(parts, 2)


def merge_subvoxels(volume: np.ndarray, before: np.ndarray | None, parts: int, share: float) -> np.ndarray:
    """Returns (1 − share) ``before`` + share · (means of ``volume`` over blocks of ``parts``³ voxels), (nz, ny, nx)."""
    assert before is not None
    return before + np.float32(share) * (block_means(volume, (parts,) * 3) - before)
