"""What a reconstruction will take: short runs of the real thing, timed, and the rest by proportion.

A cloud of Gaussians grows under density control, so the trial goes through the whole schedule in few iterations.
"""

import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.io import sha256_of, write_volume
from phyradgs_cl.io.memory import in_use_bytes
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import Reconstruction, RunPlan, method_of, reconstruct
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import Runtime

_SPLAT_TRIALS = (20, 200)  # iterations
_ITERATIVE_TRIALS = (1, 3)
_LEAST_DIFFERENCE_S = 0.3  # between the trials of methods whose iterations are alike
_MOST_ALIKE = 200
# a whole run that takes no longer is the best estimate of a method that may stop by itself
_AS_WELL_RUN_S = 20.0
# by how much a cloud has to grow for a longer trial, and how much longer that is
_GROWN, _GROWTH_TRIALS = 1.1, 3
_FEWEST_BETWEEN = 5  # iterations from one round of density control to the next, in a trial


@dataclass(frozen=True)
class Estimate:
    """seconds, host_bytes and device_bytes of a whole run; the trial's own iterations and seconds.

    around_s: what ``seconds`` has beside the method: reading, comparing, writing. host_bytes: the process's largest resident
    memory, on a CPU device its buffers too; device_bytes: the most that is held in buffers at one time.
    """

    seconds: float
    host_bytes: int
    device_bytes: int
    iterations: int
    seconds_per_iteration: float
    trial_iterations: int
    trial_seconds: float
    around_s: float = 0.0

    def text(self) -> str:
        """Two lines: time, and memory."""
        parts = []
        if self.seconds_per_iteration > 0:
            parts.append(f"{self.iterations} iterations of {1e3 * self.seconds_per_iteration:.3g} ms")
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
    """Runs the plan for a few iterations (FDK as a whole) and says what it would take as a whole. ``around``: seconds
    of what a run does beside the method, from a result of it. The first trial builds kernels, as the run will."""
    started = time.perf_counter()
    trials, method, options = _Trials(scan, plan, rt), method_of(plan.method), plan.options
    total = getattr(options, "iterations", None)
    if total is None or not method.is_resumable:
        whole_s, each_s, total = trials.run(None), 0.0, 0
    elif isinstance(options, SplatOptions):
        whole_s, each_s = _of_schedule(trials, options, *_SPLAT_TRIALS)
    else:
        whole_s, each_s = _of_alike(trials, total, *_ITERATIVE_TRIALS)
        if whole_s <= _AS_WELL_RUN_S and method.stops_itself(options):
            whole_s = trials.run(total)  # only a run tells when
    around_s = around(trials.last) if around else 0.0
    spent_s, held = time.perf_counter() - started, peak_host_bytes()
    return Estimate(
        whole_s + around_s, held, trials.device_bytes, total, each_s, trials.iterations, spent_s, around_s
    )


class _Trials:
    """Short runs of one reconstruction; ``last`` is the latest and longest, ``iterations`` how many they had in all;
    ``device_bytes`` of the last alone, since clouds grow most in the shortest."""

    def __init__(self, scan: Scan, plan: RunPlan, rt: Runtime) -> None:
        self.scan, self.rt = scan, rt
        self.plan = replace(plan, preprocessing=replace(plan.preprocessing, tune=""))  # which would be runs in each trial
        self.iterations = 0

    def run(self, iterations: int | None) -> float:
        """Seconds of so many iterations, or of the method as a whole."""
        options = self.plan.options
        plan = self.plan if iterations is None else replace(self.plan, options=shortened(options, iterations))
        self.iterations += iterations or 0
        self.rt.reset_peak()
        begun = time.perf_counter()
        self.last = reconstruct(self.scan, plan, self.rt)
        seconds, self.device_bytes = time.perf_counter() - begun, self.rt.peak_bytes
        return seconds

    def run_beside_control(self, iterations: int) -> float:
        """The seconds of a run, without those of density control."""
        return self.run(iterations) - self.control_s

    def least(self, iterations: int) -> float:
        """The shorter of two such runs: what else the machine does can only add to one."""
        return min(self.run_beside_control(iterations) for _ in range(2))

    @property
    def control_s(self) -> float:
        """Seconds of the last run in density control, which only clouds have."""
        return float(self.last.facts.get("density_control_seconds", 0.0))

    @property
    def has_grown(self) -> bool:
        """Whether the last run ended with more Gaussians than it began with."""
        return self.last.facts["gaussians"] > _GROWN * self.last.facts["gaussians_first"]


def shortened(options: Any, iterations: int) -> Any:
    """The same run in fewer iterations: of splats, with everything that has a time of its own at the same share."""
    if not isinstance(options, SplatOptions) or iterations >= options.iterations:
        return replace(options, iterations=min(iterations, options.iterations))
    share, control = iterations / options.iterations, options.control
    every = max(round(share * control.every), _FEWEST_BETWEEN) if control.every else 0
    control = replace(control, every=every, start_iteration=round(share * control.start_iteration))
    late = round(share * options.parameter_terms_from)
    return replace(options, iterations=iterations, control=control, parameter_terms_from=late)


def _of_schedule(trials: _Trials, options: SplatOptions, few: int, more: int) -> tuple[float, float]:
    """(seconds of a whole run, seconds of one of its iterations), of a run that changes on its way.

    ``few`` iterations, repeated, tell what a run takes beside them; ``more`` go through all of its schedule, with as many
    rounds of density control as the whole run. A cloud that grows does so faster in a short run, where gradients are
    larger: then a longer one, up to a fifth of the whole, says more.
    """
    total = options.iterations
    first_s = trials.run(min(few, total))
    if total <= few:
        return first_s, first_s / max(total, 1)
    early_control_s = trials.control_s
    if total <= more:
        warm_s = trials.run(total)  # the first has built the kernels, for this one too
        return first_s + (1 - few / total) * warm_s, warm_s / total
    first_s -= early_control_s
    again_s = trials.least(few)
    through_s = trials.run_beside_control(more)
    if trials.has_grown and total > _GROWTH_TRIALS * more:
        more *= _GROWTH_TRIALS
        through_s = trials.run_beside_control(more)
    else:
        through_s = min(through_s, trials.run_beside_control(more))
    rounds = trials.last.facts["density_control_rounds"]
    each_s = max(through_s - again_s, 0.0) / (more - few)
    due = sum(options.control.is_due(i, total) for i in range(1, total + 1))
    control_s = trials.control_s * due / max(rounds, 1)
    return first_s + (total - few) * each_s + control_s, each_s + control_s / total


def _of_alike(trials: _Trials, total: int, few: int, more: int) -> tuple[float, float]:
    """The same of a run whose iterations are alike; so many that the difference of two trials can be told from noise."""
    first_s = trials.run(min(few, total))
    if total <= few:  # the first has built the kernels, which the run will find built
        whole_s = trials.run(total)
        return first_s, whole_s / max(total, 1)
    again_s = trials.least(few)
    while True:
        more = min(more, total)
        more_s = trials.least(more)
        if more_s - again_s >= _LEAST_DIFFERENCE_S or more == total or more >= _MOST_ALIKE:
            break
        more *= 4
    each_s = max(more_s - again_s, 0.0) / (more - few)
    return first_s + (total - few) * each_s, each_s


def seconds_around(path: Path, scan: Scan, result: Reconstruction) -> float:
    """What ``reconstruct`` does after the method: the scan's hash, a comparison where there is a truth, the file."""
    begun = time.perf_counter()
    sha256_of(path)
    if scan.reference is not None and result.volume.shape == scan.reference.shape:
        compare(result.volume, scan.reference)
    with tempfile.TemporaryDirectory() as folder:
        write_volume(Path(folder) / "volume.h5", result.volume, result.grid, {}, result.gaussians)
    return time.perf_counter() - begun


def seconds_since_start() -> float:
    """How long this process has been there, its start and imports too; its processor time where the system does not tell."""
    with suppress(OSError, ValueError, IndexError):
        ticks = float(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        lived_s = float(Path("/proc/uptime").read_text().split()[0]) - ticks / os.sysconf("SC_CLK_TCK")
        if lived_s > 0:  # in some containers the two clocks are not of one system
            return lived_s
    return time.process_time()


def peak_host_bytes() -> int:
    """The largest resident memory of this process so far (in Linux the system's call would add that of its parent)."""
    if held := in_use_bytes("VmHWM:"):
        return held
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else 1024 * largest


def duration(seconds: float) -> str:
    """A duration for people: 8.3 s, 4 min 20 s, 3 h 05 min."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 6000:
        return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"
    return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:02.0f} min"
