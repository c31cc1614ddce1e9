"""What a reconstruction will take: a few iterations of the real thing, timed, and the rest by proportion."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors import METHODS, InputOptions, reconstruct
from phyradgs_cl.reconstructors.splat_options import SplatOptions
from phyradgs_cl.runtime import Runtime

_SPLAT_TRIALS = (20, 100)  # iterations
_ITERATIVE_TRIALS = (1, 3)


@dataclass(frozen=True)
class Estimate:
    """seconds, host_bytes and device_bytes of a whole run; the trial's own iterations and seconds.

    host_bytes: the process's largest resident memory, which on a CPU device holds the device's buffers too;
    device_bytes: the most that is held in buffers at one time.
    """

    seconds: float
    host_bytes: int
    device_bytes: int
    iterations: int
    seconds_an_iteration: float
    trial_iterations: int
    trial_seconds: float

    def text(self) -> str:
        """Two lines: time, and memory."""
        each = (
            f" ({self.iterations} iterations of {1e3 * self.seconds_an_iteration:.3g} ms)"
            if self.seconds_an_iteration > 0
            else ""
        )
        return (
            f"time    {duration(self.seconds)}{each}\n"
            f"memory  {self.host_bytes / 2**20:.0f} MiB of the host, {self.device_bytes / 2**20:.0f} MiB in buffers"
        )


def estimate(
    scan: Scan, method: str, options: Any, rt: Runtime, before: InputOptions | None = None
) -> Estimate:
    """Runs ``method`` for a few iterations (FDK as a whole) and says what ``options`` would take.

    Splats are timed on their first cloud: where density control lets it grow, time grows with it.
    """
    started = time.perf_counter()

    def seconds(iterations: int | None) -> float:
        short = options if iterations is None else replace(options, iterations=iterations)
        begun = time.perf_counter()
        reconstruct(scan, method, rt, short, before=before)
        return time.perf_counter() - begun

    total = getattr(options, "iterations", None)
    if total is None or not METHODS[method].is_resumable:
        whole_s, each_s, trial, total = seconds(None), 0.0, 0, 0
    else:
        few, more = _trials(options)
        trial = few + more
        whole_s, each_s = _by_proportion(seconds, total, few, more)
    held = _host_bytes()
    return Estimate(whole_s, held, rt.peak_bytes, total, each_s, trial, time.perf_counter() - started)


def _trials(options: Any) -> tuple[int, int]:
    return _SPLAT_TRIALS if isinstance(options, SplatOptions) else _ITERATIVE_TRIALS


def _by_proportion(seconds: Callable[[int], float], total: int, few: int, more: int) -> tuple[float, float]:
    """(seconds of ``total`` iterations, seconds of one): kernels are built by the shorter trial, which is timed as it is."""
    first_s = seconds(min(few, total))
    if total <= few:  # the first has built the kernels, which the run will find built
        return first_s, seconds(total) / max(total, 1)
    again_s, longer_s = seconds(few), seconds(more)
    each_s = max(longer_s - again_s, 0.0) / (more - few)
    return first_s + (total - few) * each_s, each_s


def _host_bytes() -> int:
    """The largest resident memory of this process so far."""
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else 1024 * largest


def duration(seconds: float) -> str:
    """A duration for people: 8.3 s, 4 min 20 s, 3 h 05 min."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 6000:
        return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"
    return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:02.0f} min"
