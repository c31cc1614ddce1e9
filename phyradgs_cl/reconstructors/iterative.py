"""The loop around every iterative voxel method: progress, convergence record, Ctrl-C, stopping, going on.

A method is a class with ``volume``, ``step()``, ``state()`` and ``restore()``; this module runs it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import ClassVar
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors.checked_state import check_like, checked_history, count_of
from phyradgs_cl.reconstructors.interrupt import stop_on_interrupt
from phyradgs_cl.reconstructors.reporting import report_once
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    State,
    history_arrays,
)
from phyradgs_cl.reconstructors.system import System, norm
from phyradgs_cl.runtime import Runtime

MOST_ITERATIONS = 1_000_000


@dataclass(frozen=True)
class IterativeOptions:
    """What every iterative method can be told.

    motion: static, micro-views, or per-row (every line at its own times). iterations: passes over all frames.
    nonnegative: clip the volume at 0 after every update. tolerance: stop when an iteration changes the volume by
    less than this share of its norm; 0 runs all iterations. detector_model: what is averaged over a line's times, line
    integrals (log) or intensity, or what the scan says.
    """

    transmission_weights: ClassVar[bool] = False
    """Weigh pixels by their transmission; methods that can have an option of this name."""

    motion: Motion = Motion("static")
    iterations: int = 20
    nonnegative: bool = True
    tolerance: float = 0.0
    detector_model: str = "scan"

    def __post_init__(self) -> None:
        checks.within("iterations", self.iterations, 0, MOST_ITERATIONS)
        checks.within("tolerance", self.tolerance, 0, 1)
        checks.one_of("detector_model", self.detector_model, ("scan", *DETECTOR_MODELS))
        if self.motion.name == "exact":
            expected = "static, static-start, micro-views or per-row: exact moves splats, and rays have none"
            raise InputError("--motion", "'exact'", expected, "take --motion per-row")


class Algorithm(Interface):
    """One iterative method on one system."""

    volume: np.ndarray
    """The present estimate (nz, ny, nx) float32, 1/mm; a new array after every step."""
    finished: str | None
    """Why the method stops by itself, else None."""

    def step(self) -> float:
        """One iteration; the norm of p − A x as far as the method knows it (see its own docstring)."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """What ``restore`` needs to go on with the next iteration."""
        ...

    def restore(self, state: State) -> None: ...


def run_iterations(
    method: str,
    make: Callable[[System], Algorithm],
    scan: Scan,
    options: IterativeOptions,
    rt: Runtime,
    report: ProgressReport,
    resume: State | None,
) -> Reconstruction:
    """Builds the scan's system, runs the method on it, and returns volume, record and facts.

    The record has a line an iteration: residual ‖p − A x‖/‖p‖, change ‖x − x'‖/‖x‖, seconds since the start.
    """
    started = time.perf_counter()
    system = System.of_scan(rt, scan, options.motion, options.detector_model)
    if options.transmission_weights:
        system = system.trusting_light()
    algorithm = make(system)
    iteration, record = 0, []
    if resume is not None:
        check_like(resume, algorithm.state())
        iteration = count_of(resume, "iteration", options.iterations)
        record, before_s = checked_history(resume)
        algorithm.restore(resume)
        started -= before_s
    loop = _Loop(algorithm, options, scan.grid, norm(system.measured) or 1.0, report, started, rt.ranks)
    loop.record = record
    loop.run(iteration)
    facts: dict[str, object] = {
        "method": method,
        "options": asdict(options),
        "detector_model": "log" if system.intensity is None else "intensity",
        "iterations": loop.iteration,
        "stopped_by": loop.stopped_by,
        "seconds": time.perf_counter() - started,
        "interrupted_at": loop.iteration if loop.stopped_by == "interrupt" else None,
        "ranks": rt.ranks.size,
    }
    state = None
    if loop.stopped_by == "interrupt":
        state = loop.state()
    return Reconstruction(algorithm.volume, scan.grid, record=loop.record, facts=facts, state=state)


class _Loop:
    """Where the run is, and why it ended: iterations, tolerance, interrupt, or the method's own reason."""

    def __init__(
        self,
        algorithm: Algorithm,
        options: IterativeOptions,
        grid: Grid,
        measured_norm: float,
        report: ProgressReport,
        started: float,
        ranks: Communicator,
    ) -> None:
        self.ranks = ranks
        self.algorithm, self.options, self.grid, self.report = algorithm, options, grid, report
        self.measured_norm, self.started = measured_norm, started
        self.record: list[dict[str, float]] = []
        self.iteration = 0
        self.stopped_by = "iterations"

    def run(self, first: int) -> None:
        self.iteration = first
        with stop_on_interrupt() as request:
            while self.iteration < self.options.iterations:
                self._iterate()
                if self.algorithm.finished:
                    self.stopped_by = self.algorithm.finished
                elif self.iteration < self.options.iterations and self.ranks.any(request.is_set):
                    self.stopped_by = "interrupt"
                if self.stopped_by != "iterations":
                    return

    def state(self) -> dict[str, np.ndarray]:
        """What ``restore`` and a loop need to go on from here."""
        so_far = history_arrays(self.record, time.perf_counter() - self.started)
        return {**self.algorithm.state(), "iteration": np.array(self.iteration), **so_far}

    def _iterate(self) -> None:
        before = self.algorithm.volume
        residual = self.algorithm.step() / self.measured_norm
        self.iteration += 1
        if not np.isfinite(residual):
            remedy = "check the scan for extreme values, or lower the relaxation"
            raise NumericalError(
                "residual", f"{residual} at iteration {self.iteration}", "a finite number", remedy
            )
        after = self.algorithm.volume
        size = norm(after)
        change = norm(after - before) / size if size else 0.0
        seconds = time.perf_counter() - self.started
        self.record.append(
            {"iteration": self.iteration, "residual": residual, "change": change, "seconds": seconds}
        )
        if change < self.options.tolerance:
            self.stopped_by = "tolerance"
        total = self.options.iterations
        progress = Progress(
            *(self.iteration, total, residual, 0, seconds),
            quantity="residual",
            state=self.state,
            volume=lambda: (self.algorithm.volume, self.grid),
        )
        if report_once(self.ranks, self.report, progress) and self.iteration < total:
            self.stopped_by = "interrupt"
