"""The iterative voxel methods between scan and loop: options, system, convergence, facts.

A method is a class with ``system``, ``volume``, ``step()``, ``state()`` and ``restore()``; ``run_iterations`` runs it, and
``voxel_method`` makes a line of the registry of it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan, Static
from phyradgs_cl.acquisition.motion import RAYS, check_motion, motions_for
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.checkpoint import check_like, count_of
from phyradgs_cl.reconstructors.loop import Loop
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    option_facts,
)
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

MOST_ITERATIONS = 1_000_000
_SYSTEM_FRAMES = 6  # stacks of frames: measurement, mask, transmission, and what one comparison makes


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

    noise_stop: ClassVar[float] = 0.0
    """Times the noise, the residual at which the run ends; likewise."""

    MOTIONS: ClassVar[tuple[Motion, ...]] = motions_for(RAYS)

    motion: Motion = Static()
    iterations: int = 20
    nonnegative: bool = True
    tolerance: float = 0.0
    detector_model: str = "scan"

    def __post_init__(self) -> None:
        checks.within("iterations", self.iterations, 0, MOST_ITERATIONS)
        checks.within("tolerance", self.tolerance, 0, 1)
        checks.within("noise_stop", self.noise_stop, 0, 1e6)
        checks.one_of("detector_model", self.detector_model, ("scan", *DETECTOR_MODELS))
        check_motion(self.motion, self.MOTIONS)


class Algorithm(Interface):
    """One iterative method on one system."""

    system: System
    volume: Any
    """The present estimate (nz, ny, nx) float32, 1/mm, an array of the system's space; a new one after every step."""
    finished: str | None
    """Why the method stops by itself, else None."""

    def start_from(self, volume: Any) -> None:
        """Takes a volume of the system's space as the first estimate, before the first step."""
        ...

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
    initial: np.ndarray | None = None,
    *,
    volumes: int,
    frames: int,
) -> Reconstruction:
    """Builds the scan's system, runs the method on it, and returns volume, record and facts. ``initial``: where it starts.

    ``volumes`` and ``frames`` (stacks of all of them) are what the method holds at one time, its tables included: where the
    device has room for them they stay on it.
    The record has a line an iteration: residual ‖p − A x‖/‖p‖, change ‖x − x'‖/‖x‖, seconds since the start.
    """
    started = time.perf_counter()
    system = System.of_scan(rt, scan, options.motion, options.detector_model)
    if options.transmission_weights:
        system = system.transmission_weighted()
    system = system.resident(rt, volumes + 2, frames + _SYSTEM_FRAMES)
    algorithm = make(system)
    if initial is not None and resume is None:
        algorithm.start_from(system.space.array(np.ascontiguousarray(initial, np.float32)))
    norm = system.space.norm(system.measured) or 1.0
    enough = options.noise_stop * system.noise_norm() / norm if options.noise_stop else 0.0
    run = _Iterations(algorithm, options, scan.grid, norm, enough)
    loop = Loop(run, rt.ranks, report, started)
    loop.run(resume)
    facts: dict[str, object] = {
        "method": method,
        "options": option_facts(options),
        "detector_model": "log" if system.intensity is None else "intensity",
        "iterations": run.iteration,
        "stopped_by": loop.stopped_by,
        "seconds": loop.seconds,
        "interrupted_at": loop.interrupted_at,
        "ranks": rt.ranks.size,
    }
    (volume, _), state = run.present_volume(), loop.state_if_interrupted()
    return Reconstruction(volume, scan.grid, record=loop.record, facts=facts, state=state)


class Setting(NamedTuple):
    """What a method may need beside its system and its options."""

    scan: Scan
    rt: Runtime
    seed: int
    initial: np.ndarray | None


def voxel_method(
    name: str,
    default: IterativeOptions,
    make: Callable[[System, Any, Setting], Algorithm],
    *,
    volumes: int | Callable[[Scan, Any], int],
    frames: int,
) -> Method:
    """An algorithm as a method; ``volumes``, of scan and options where it depends on them, and ``frames`` as of
    ``run_iterations``."""

    def run(
        scan: Scan,
        options: Any,
        rt: Runtime,
        *,
        seed: int = 0,
        report: ProgressReport = ignore_progress,
        resume: State | None = None,
        initial: np.ndarray | None = None,
    ) -> Reconstruction:
        setting = Setting(scan, rt, seed, initial)
        held = volumes(scan, options) if callable(volumes) else volumes
        return run_iterations(
            name, lambda system: make(system, options, setting), scan, options, rt, report, resume, initial,
            volumes=held, frames=frames,
        )  # fmt: skip

    return Method(run, {"default": default}, is_shared=True, takes_initial=True, ends_anywhere=True)


class _Iterations:
    """An algorithm with its convergence, ``Stepwise`` for the loop."""

    quantity, remedy = "residual", "check the scan for extreme values, or lower the relaxation"

    def __init__(
        self, algorithm: Algorithm, options: IterativeOptions, grid: Grid, measured_norm: float, enough: float
    ) -> None:
        self.algorithm, self.options, self.grid = algorithm, options, grid
        self.measured_norm, self.enough = measured_norm, enough
        self.iteration, self.iterations = 0, options.iterations
        self.residual, self.change = 0.0, 0.0

    @property
    def finished(self) -> str | None:
        if self.enough and self.residual <= self.enough:
            return "residual as small as the noise"
        return self.algorithm.finished or ("tolerance" if self.change < self.options.tolerance else None)

    def step(self) -> None:
        before, space = self.algorithm.volume, self.algorithm.system.space
        self.residual = self.algorithm.step() / self.measured_norm
        self.iteration += 1
        size = space.norm(self.algorithm.volume)
        moved = space.add(self.algorithm.volume, before, -1.0)
        self.change = space.norm(moved) / size if size else 0.0

    def measures(self) -> dict[str, float]:
        return {"residual": self.residual, "change": self.change}

    def state(self) -> dict[str, np.ndarray]:
        return {**self.algorithm.state(), "iteration": np.array(self.iteration)}

    def restore(self, state: State) -> None:
        check_like(state, self.algorithm.state())
        self.iteration = count_of(state, "iteration", self.iterations)
        self.algorithm.restore(state)

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        return self.algorithm.system.space.numpy(self.algorithm.volume), self.grid
