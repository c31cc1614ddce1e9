"""Estimates the time and memory of a reconstruction from short runs of two lengths. The difference of their times gives the
time per iteration; the rest is the time of everything else. A method without iterations or checkpoints runs as a whole.

Density control adds Gaussians during a run and makes iterations slower. Short runs of a method with Gaussians therefore go
through the whole schedule of density control, in fewer iterations."""

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.io import sha256_of, write_volume
from phyradgs_cl.io.files import in_use_bytes
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import Reconstruction, RunPlan, method_of, reconstruct
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import Runtime

_SPLAT_TRIALS = (20, 200)  # iterations of the two short runs (trials) of methods with Gaussians
_TRIALS = (1, 3)  # iterations of the two short runs of other methods, unless their options have ``TRIALS``
_LEAST_DIFFERENCE_S = 0.3  # if the two trials' times differ by less, the second is prolonged, since times are noisy
_LONGEST_TRIAL = 200  # a trial of this many iterations is not prolonged, because estimating would take too long
_FEWEST_BETWEEN = 5  # least number of iterations between rounds of density control in a trial


@dataclass(frozen=True)
class Estimate:
    """The estimated time ``seconds`` and memory of a whole run.

    trial_seconds: the time that estimating took. around_s: the part of ``seconds`` for reading, comparing and writing.
    host_bytes: the most resident memory of the process; with a CPU device this includes the OpenCL buffers.
    device_bytes: the most memory in OpenCL buffers at one time."""

    seconds: float
    host_bytes: int
    device_bytes: int
    iterations: int
    seconds_per_iteration: float
    trial_seconds: float
    around_s: float = 0.0

    def text(self) -> str:
        parts = []
        if self.seconds_per_iteration > 0:
            parts.append(f"{self.iterations} iterations of {1e3 * self.seconds_per_iteration:.3g} ms")
            start_s = self.seconds - self.around_s - self.iterations * self.seconds_per_iteration
            parts.append(f"{duration(max(start_s, 0.0))} to build kernels and begin")
        if self.around_s > 0:
            parts.append(f"{duration(self.around_s)} to read, compare and write")
        each = f" ({', '.join(parts)})" if parts else ""
        return (
            f"time    {duration(self.seconds)}{each}\n"
            f"memory  {self.host_bytes / 2**20:.0f} MiB of the host, {self.device_bytes / 2**20:.0f} MiB in buffers"
        )


def estimate(
    scan: Scan, plan: RunPlan, rt: Runtime, around: Callable[[Reconstruction], float] | None = None
) -> Estimate:
    """Estimates the time and memory of a run from short trials. A method without iterations or checkpoints runs as a whole.

    around: a function that takes a result and returns the seconds that the run will spend outside the method. The first
    trial also builds the kernels; their build is part of the estimate, since the run will build them again."""
    started = time.perf_counter()
    trials, total = _Trials(scan, plan, rt), getattr(plan.options, "iterations", None)
    few, more = getattr(plan.options, "TRIALS", _SPLAT_TRIALS if isinstance(plan.options, SplatOptions) else _TRIALS)
    if total is None or not method_of(plan.method).is_resumable:
        seconds, each_s, total = trials.run(None), 0.0, 0
    elif total <= few:
        seconds = trials.run(total)
        each_s = trials.run(total) / max(total, 1)  # from a second run: the first one also built the kernels
    else:
        seconds, each_s = trials.extrapolated(few, more, total)
    around_s = around(trials.result) if around else 0.0
    spent_s = time.perf_counter() - started
    return Estimate(
        seconds + around_s, peak_host_bytes(), trials.device_bytes, total, each_s, spent_s, around_s
    )


class _Trials:
    """Makes short runs of one plan. ``result`` and ``device_bytes`` (most memory in OpenCL buffers) are of the last run."""

    def __init__(self, scan: Scan, plan: RunPlan, rt: Runtime) -> None:
        self.scan, self.plan, self.rt = scan, plan, rt

    def run(self, iterations: int | None) -> float:
        """Runs the plan with ``iterations`` iterations; None runs it as a whole. Returns the seconds that the run took."""
        options = self.plan.options
        plan = self.plan if iterations is None else replace(self.plan, options=shortened(options, iterations))
        self.rt.reset_peak()
        started = time.perf_counter()
        self.result = reconstruct(self.scan, plan, self.rt).complete()
        self.device_bytes = self.rt.peak_bytes
        return time.perf_counter() - started

    def extrapolated(self, few: int, more: int, total: int) -> tuple[float, float]:
        """Returns the seconds of a run of ``total`` iterations, and those of one iteration. They are extrapolated from runs
        of ``few`` and ``more`` iterations. If their times differ by less than 0.3 s, the longer run is prolonged."""
        first_s = self.run(few) - self._control_s
        again_s = self.run(few) - self._control_s  # the first run also built the kernels, so it took longer
        more = min(more, total)
        more_s = self.run(more) - self._control_s
        while more_s - again_s < _LEAST_DIFFERENCE_S and more < min(total, _LONGEST_TRIAL):
            more = min(4 * more, total)
            more_s = self.run(more) - self._control_s
        each_s = max(more_s - again_s, 0.0) / (more - few)
        control_s = self._control_s * self._rounds_due(total)
        return first_s + (total - few) * each_s + control_s, each_s + control_s / total

    @property
    def _control_s(self) -> float:
        """The seconds that the last run spent in density control, which do not count as time of its iterations."""
        return float(self.result.facts.get("density_control_seconds", 0.0))

    def _rounds_due(self, total: int) -> float:
        """Returns (rounds of density control in ``total`` iterations) / (rounds in the last trial); 0 if the latter is 0."""
        rounds = self.result.facts.get("density_control_rounds", 0)
        return sum(self.plan.options.control.is_due(i, total) for i in range(1, total + 1)) / rounds if rounds else 0.0


def shortened(options: Any, iterations: int) -> Any:
    """Returns a run's options with at most ``iterations``. The schedule of density control is shortened in proportion."""
    if not isinstance(options, SplatOptions) or iterations >= options.iterations:
        return replace(options, iterations=min(iterations, options.iterations))
    share, control = iterations / options.iterations, options.control
    every = max(round(share * control.every), _FEWEST_BETWEEN) if control.every else 0
    control = replace(control, every=every, start_iteration=round(share * control.start_iteration))
    late = round(share * options.parameter_terms_from)
    return replace(options, iterations=iterations, control=control, parameter_terms_from=late)


def seconds_around(path: Path, scan: Scan, result: Reconstruction) -> float:
    """Measures the seconds of what the command ``reconstruct`` does besides the method: it hashes the scan file ``path``,
    compares the volume with the scan's ``reference`` if both have one shape, and writes the volume."""
    started = time.perf_counter()
    sha256_of(path)
    if scan.reference is not None and result.volume.shape == scan.reference.shape:
        compare(result.volume, scan.reference)
    with tempfile.TemporaryDirectory() as folder:
        write_volume(Path(folder) / "volume.h5", result.volume, result.grid, {}, result.gaussians)
    return time.perf_counter() - started


def peak_host_bytes() -> int:
    """Returns the most resident memory of this process so far, in bytes. On Linux it comes from /proc, because getrusage may
    count the parent's memory too."""
    if peak_bytes := in_use_bytes("VmHWM:"):
        return peak_bytes
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else 1024 * largest


def duration(seconds: float) -> str:
    """Returns a duration as 8.3 s, 4 min 20 s or 3 h 05 min."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 6000:
        return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"
    return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:02.0f} min"
