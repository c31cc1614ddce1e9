"""The loop of every iterative method: progress, convergence record, Ctrl-C, stopping, resuming.

A method is a class with the attributes of ``Stepwise``. ``Loop`` runs the method in one process, or in several ranks (MPI
processes), which all take the same steps."""

import json
import time
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.result import Progress, ProgressReport
from phyradgs_cl.signals import stop_on_interrupt

SILENT_S = 10.0  # if its last report is this many seconds old, a run in one process reports its next finished iteration


class Stepwise(Protocol):
    """The interface by which ``Loop`` runs an iterative method. iterations: the number of iterations of a complete run."""

    iterations: int

    @property
    def quantity(self) -> str:
        """The name of the measure of convergence in ``measures``, ``loss`` or ``residual``. Its value must stay finite."""

    @property
    def remedy(self) -> str:
        """The advice in the error that ``Loop`` raises if the value of ``quantity`` is not finite."""

    @property
    def iteration(self) -> int:
        """Number of finished iterations. A step may make several iterations, or a part of one."""

    @property
    def finished(self) -> str | None:
        """Why the method has ended before its last iteration; None if it has not."""

    def step(self) -> None: ...

    def measures(self) -> Mapping[str, float]:
        """Returns, by name, the numbers for a line of the convergence record. One of the names is ``quantity``."""

    def state(self) -> dict[str, np.ndarray]:
        """Returns the arrays from which ``restore`` continues with the next step."""

    def restore(self, state: State) -> None:
        """Restores the method from arrays that ``state`` returned. Raises InputError for arrays of another run."""

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        """Returns the present volume (nz, ny, nx) in 1/mm, and its grid in mm."""


class Loop:
    """Runs a method to its end, an interruption, or its own reason to stop, and records its convergence.

    stopped_by: ``iterations``, ``interrupt``, or the text of the method's ``finished``. record_every: iterations from one
    line of the record to the next. report_every: iterations from one report to the next; slow runs report sooner. started:
    the value of ``time.perf_counter`` from which seconds count."""

    def __init__(
        self, method: Stepwise, ranks: Communicator, report: ProgressReport, started: float,
        record_every: int = 1, report_every: int = 1,
    ) -> None:
        self.method, self.ranks, self.report = method, ranks, report
        self.record_every, self.report_every = record_every, report_every
        self.record: list[dict[str, float]] = []
        self.stopped_by = "iterations"
        self._started = started
        self._reported = time.perf_counter()

    def run(self, resume: State | None) -> None:
        """Takes all steps of the method, or those that follow the state ``resume``. Ctrl-C, or a report that raises
        KeyboardInterrupt, ends the run after the present step, unless that step is the last."""
        method = self.method
        if resume is not None:
            method.restore(resume)
            self.record = json.loads(str(resume["record"]))
            self._started -= float(resume["seconds"])
        with stop_on_interrupt() as request:
            while method.iteration < method.iterations and self.stopped_by == "iterations":
                before = method.iteration
                method.step()
                is_stopped = self._tell(before) or request.is_set
                if method.finished:
                    self.stopped_by = method.finished
                elif self.ranks.any(is_stopped) and method.iteration < method.iterations:
                    self.stopped_by = "interrupt"

    @property
    def seconds(self) -> float:
        """Seconds since the start, including those before an interruption from which this run resumed."""
        return time.perf_counter() - self._started

    @property
    def interrupted_at(self) -> int | None:
        """The iteration after which Ctrl-C has stopped the run; None without an interruption."""
        return self.method.iteration if self.stopped_by == "interrupt" else None

    def state(self) -> dict[str, np.ndarray]:
        history = {"record": np.array(json.dumps(self.record)), "seconds": np.array(self.seconds)}
        return {**self.method.state(), **history}

    def state_if_interrupted(self) -> dict[str, np.ndarray] | None:
        return self.state() if self.stopped_by == "interrupt" else None

    def _tell(self, before: int) -> bool:
        """Records and reports the step that began at iteration ``before``, where these are due. Returns True if the report
        raises KeyboardInterrupt. Raises NumericalError if the value of the method's ``quantity`` is not finite."""
        is_recorded = self._reaches(self.record_every, before)
        is_slow = time.perf_counter() - self._reported > SILENT_S and self.ranks.size == 1  # clocks of ranks differ
        is_reported = self._reaches(self.report_every, before) or (is_slow and self.method.iteration > before)
        if not (is_recorded or is_reported):
            return False
        measures, name = self.method.measures(), self.method.quantity
        iteration, seconds = self.method.iteration, self.seconds
        if not np.isfinite(measures[name]):
            found = f"{measures[name]} at iteration {iteration}"
            raise NumericalError(name, found, "a finite number", self.method.remedy)
        if is_recorded:
            self.record.append({"iteration": iteration, **measures, "seconds": seconds})
        if not is_reported or self.ranks.rank > 0:  # only rank 0 reports, for all ranks
            return False
        self._reported = time.perf_counter()
        progress = Progress(
            iteration, self.method.iterations, measures[name], int(measures.get("gaussians", 0)), seconds,
            quantity=name, state=self.state, volume=self.method.present_volume,
        )
        try:
            self.report(progress)
        except KeyboardInterrupt:
            return True
        return False

    def _reaches(self, every: int, before: int) -> bool:
        """Returns whether the step that began at iteration ``before`` reached a multiple of ``every``, or the run's end."""
        now = self.method.iteration
        return now // every > before // every or now == self.method.iterations
