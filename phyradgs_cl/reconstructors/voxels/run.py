"""Runs an iterative voxel method on a scan: its options, its inputs, its convergence, the facts of its result.

A method is a subclass of ``Algorithm``. ``voxel_method`` makes an entry of ``METHODS`` of it, and ``MethodRun`` runs it."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow, Scan
from phyradgs_cl.acquisition.motion import RAYS, MotionOptions, motions_for
from phyradgs_cl.acquisition.scan import MODELS_OF_METHODS
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.loop import Loop, Stepwise
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress, option_facts
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

MOST_ITERATIONS = 1_000_000
# Number of arrays of all frames that a system holds: measurement, mask, transmission, and those to compute a residual.
_SYSTEM_FRAMES = 6


@dataclass(frozen=True)
class IterativeOptions(MotionOptions):
    """Options of every iterative method.

    - motion: static, micro-views, or per-row (every line at its own times). iterations: passes over all frames.
    - nonnegative: clip the volume at 0 after every update.
    - tolerance: stop when an iteration changes the volume by less than this fraction of its norm; 0 runs all iterations.
    - detector_model: what the detector averages over a line's times: line integrals (log), intensity, or what the scan
      states (scan)."""

    transmission_weights: ClassVar[bool] = False
    """Whether pixels are weighted by their transmission. Methods that can do so have an option of this name."""

    noise_stop: ClassVar[float] = 0.0
    """The run ends if the residual is at most this many times the noise; 0: never. Some methods have this as an option."""

    MOTIONS: ClassVar[tuple[Motion, ...]] = motions_for(RAYS)

    motion: Motion = PerRow()
    iterations: int = checks.ranged(20, 0, MOST_ITERATIONS)
    nonnegative: bool = True
    tolerance: float = checks.ranged(0.0, 0, 1)
    detector_model: str = checks.option("scan", words=MODELS_OF_METHODS)


class Algorithm:
    """An iterative method on a system. ``volume`` (nz, ny, nx) in 1/mm is an array of the system's space.

    A subclass defines ``step``, and names the attributes that a state must hold: ``ARRAYS`` (of the space), ``NUMBERS``."""

    ARRAYS: ClassVar[tuple[str, ...]] = ("volume",)
    NUMBERS: ClassVar[tuple[str, ...]] = ()

    finished: str | None = None
    """Why the method stops before its last iteration; None unless it does."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.volume = system.space.full(system.volume_shape, 0.0)

    def start_from(self, volume: Any) -> None:
        """Takes a volume of the system's space as the first estimate, before the first step."""
        self.volume = volume

    def step(self) -> float:
        """Does one iteration, which replaces ``volume``. Returns the norm of the residual p − A x, or p − I(x) in the
        intensity model. The subclass's docstring says at which volume x."""
        raise NotImplementedError

    def state(self) -> dict[str, np.ndarray]:
        """Returns the arrays from which ``restore`` continues with the next iteration."""
        arrays = {name: self.system.space.numpy(getattr(self, name)) for name in self.ARRAYS}
        return {**arrays, **{name: np.array(getattr(self, name)) for name in self.NUMBERS}}

    def restore(self, state: State) -> None:
        """Continues from what ``state`` returned. Raises InputError if an array is missing (a state of another version)."""
        if missing := {*self.ARRAYS, *self.NUMBERS} - {*state}:
            found = f"a run of another version, without {', '.join(sorted(missing))}"
            raise InputError("--resume", found, "the same version", "start without --resume")
        for name in self.ARRAYS:
            setattr(self, name, self.system.space.array(state[name]))
        for name in self.NUMBERS:
            setattr(self, name, state[name].item())
        if self.system.intensity is not None:  # sets the derivative J, which depends on the volume
            self.system.expected(self.volume)


class WithFacts(Stepwise, Protocol):
    """A ``Stepwise`` method that adds facts to the result."""

    def facts(self, is_complete: bool) -> Mapping[str, object]:
        """Returns the facts after the last step. is_complete: whether the run came to its end without an interruption."""


@dataclass(frozen=True, eq=False)
class MethodRun:
    """A method's run on a scan. resume: the state to continue from. initial: the first volume (nz, ny, nx) in 1/mm; None:
    the method's own start. deformation: how the object moves. state_times_s (K,): times in s of the states of an object that
    changes. Seconds count from ``started``."""

    scan: Scan
    options: Any
    rt: Runtime
    seed: int = 0
    report: ProgressReport = ignore_progress
    resume: State | None = None
    initial: np.ndarray | None = None
    deformation: Deformation | None = None
    state_times_s: np.ndarray | None = None
    started: float = field(default_factory=time.perf_counter)

    def system(self, *, volumes: int, frames: int) -> System:
        """Returns the scan's system. Its arrays are on the device if the following fit there: the ``volumes`` volumes and
        ``frames`` arrays of all frames that the algorithm holds at one time, and what the system itself holds."""
        system = System.of_scan(
            self.rt, self.scan, self.options.motion, self.options.detector_model, deformation=self.deformation,
            state_times_s=self.state_times_s, is_dense=self.initial is not None,
        )  # fmt: skip
        if self.options.transmission_weights:
            system = system.transmission_weighted()
        return system.resident(self.rt, volumes + 2, frames + _SYSTEM_FRAMES)

    def result(self, name: str, method: WithFacts) -> Reconstruction:
        """Runs a method in a loop. Returns its volume, convergence record and facts.

        The record has, for each iteration, the residual ‖p − A x‖/‖p‖, the change ‖x − x'‖/‖x‖, and the seconds so far."""
        loop = Loop(method, self.rt.ranks, self.report, self.started)
        loop.run(self.resume)
        facts: dict[str, object] = {
            "method": name, "options": option_facts(self.options), **method.facts(loop.interrupted_at is None),
            "iterations": method.iteration, "stopped_by": loop.stopped_by, "seconds": loop.seconds,
            "interrupted_at": loop.interrupted_at, "ranks": self.rt.ranks.size,
        }  # fmt: skip
        volume, grid = method.present_volume()
        return Reconstruction(volume, grid, record=loop.record, facts=facts, state=loop.state_if_interrupted())


def voxel_method(
    name: str, default: IterativeOptions, make: Callable[[System, Any, MethodRun], Algorithm], *,
    volumes: int | Callable[[Scan, Any], int], frames: int,
) -> Method:
    """Returns the method ``name``, which runs the algorithm that ``make`` builds. volumes: how many volumes the algorithm
    holds at one time, or a function (scan, options) of this number. frames: how many arrays of all frames it holds."""

    def reconstruct(scan: Scan, options: Any, rt: Runtime, **arguments: Any) -> Reconstruction:
        run = MethodRun(scan, options, rt, **arguments)
        system = run.system(volumes=volumes(scan, options) if callable(volumes) else volumes, frames=frames)
        return run.result(name, Iterations(make(system, options, run), run))

    return Method(reconstruct, {"default": default}, is_shared=True, takes_initial=True, takes_deformation=True)


class Iterations:
    """Runs an algorithm step by step for a ``Loop``. Keeps two measures of the last iteration: ``residual``, ‖p − A x‖/‖p‖,
    and ``change``, ‖x − x'‖/‖x‖, where x' is the volume before the iteration."""

    quantity = "residual"

    def __init__(self, algorithm: Algorithm, run: MethodRun) -> None:
        self.algorithm, self.options, self.grid = algorithm, run.options, run.scan.grid
        self.iteration, self.iterations = 0, run.options.iterations
        self.residual, self.change = 0.0, 0.0
        has_relaxation = hasattr(run.options, "relaxation")
        self.remedy = "check the scan for extreme values" + (", or lower the relaxation" if has_relaxation else "")
        system = algorithm.system
        if run.initial is not None and run.resume is None:
            algorithm.start_from(system.space.array(np.ascontiguousarray(run.initial, np.float32)))
        self.measured_norm = system.space.norm(system.measured) or 1.0
        noise = system.noise_norm() if run.options.noise_stop else 0.0
        self.noise_residual = run.options.noise_stop * noise / self.measured_norm

    @property
    def finished(self) -> str | None:
        if self.noise_residual and self.residual <= self.noise_residual:
            return "residual as small as the noise"
        return self.algorithm.finished or ("tolerance" if self.change < self.options.tolerance else None)

    def step(self) -> None:
        before, space = self.algorithm.volume, self.algorithm.system.space
        self.residual = self.algorithm.step() / self.measured_norm
        self.iteration += 1
        size = space.norm(self.algorithm.volume)
        self.change = space.norm(space.add(self.algorithm.volume, before, -1.0)) / size if size else 0.0

    def measures(self) -> dict[str, float]:
        return {"residual": self.residual, "change": self.change}

    def facts(self, is_complete: bool) -> dict[str, object]:
        return {"detector_model": "log" if self.algorithm.system.intensity is None else "intensity"}

    def state(self) -> dict[str, np.ndarray]:
        return {**self.algorithm.state(), "iteration": np.array(self.iteration)}

    def restore(self, state: State) -> None:
        self.iteration = int(state["iteration"])
        self.algorithm.restore(state)

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        """Returns the volume (nz, ny, nx) in 1/mm, which is the mean of the states if there are several, and its grid."""
        values = self.algorithm.system.space.numpy(self.algorithm.volume)
        return values if values.ndim == 3 else values.mean(0), self.grid
