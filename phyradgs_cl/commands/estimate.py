"""estimate: what a reconstruction would take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import checks
from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.options import (
    Assignments,
    Batch,
    Config,
    Device,
    GaussianCount,
    IgnoreLag,
    Iterations,
    LineModel,
    MedianFilter,
    Memory,
    Method,
    MotionModel,
    Parts,
    Preset,
    Segments,
    Split,
    Strips,
    SubIntervals,
    TimeError,
    file_argument,
    given_options,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.estimate import duration, estimate, seconds_around, seconds_since_start
from phyradgs_cl.rank_plan import plan_ranks
from phyradgs_cl.reconstructors import Reconstruction, method_options
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.memory import memory_limit
from phyradgs_cl.settings import run_settings
from phyradgs_cl.workflow import load_scan

EXAMPLE = "Example: phyradgs estimate scan.h5 --method fista-tv --motion per-row"
MOST_RANKS = 100_000


def estimate_command(
    scan: Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")],
    method: Method = None,
    motion: MotionModel = None,
    strips: Strips = None,
    sub_intervals: SubIntervals = None,
    segments: Segments = None,
    time_error: TimeError = None,
    iterations: Iterations = None,
    gaussians: GaussianCount = None,
    preset: Preset = None,
    batch: Batch = None,
    split: Split = None,
    parts: Parts = None,
    config: Config = None,
    assignments: Assignments = None,
    detector_model: LineModel = None,
    ignore_lag: IgnoreLag = False,
    median_filter: MedianFilter = None,
    device: Device = None,
    memory: Memory = None,
    ranks: Annotated[
        int | None,
        typer.Option(
            metavar="R",
            help="Without a trial: what lies where on R ranks of mpiexec, bytes a rank, bytes exchanged (docs: cluster.md).",
        ),
    ] = None,
) -> None:
    """Say how long a reconstruction would take and how much memory, from a few iterations of it."""
    given = given_options(
        method=method,
        motion=motion,
        strips=strips,
        sub_intervals=sub_intervals,
        segments=segments,
        time_error=time_error,
        iterations=iterations,
        gaussians=gaussians,
        preset=preset,
        batch=batch,
        split=split,
        parts=parts,
        detector_model=detector_model,
        ignore_lag=ignore_lag,
        median_filter=median_filter,
        device=device,
        memory=memory,
    )
    settings = run_settings(config, given, assignments or [])
    options = method_options(settings.method, settings.preset, settings.changes)
    loaded = load_scan(scan)
    loaded.check_timing()
    if ranks is not None:
        checks.within("--ranks", ranks, 1, MOST_RANKS)
        if device is not None:
            raise InputError(
                "--device", repr(device), "none with --ranks", "leave it out: a plan needs no device"
            )
        say(plan_ranks(loaded, settings.method, options, ranks).text(memory_limit(settings.memory)))
        return
    with settings.naming_origins():
        rt = Runtime(settings.device, memory=settings.memory)
    before_s = seconds_since_start()  # a run will have started, and read the scan, as this did

    def around(result: Reconstruction) -> float:
        return before_s + seconds_around(scan, loaded, result)

    found = estimate(loaded, settings.method, options, rt, settings.before, around)
    say(f"{settings.method} on {rt.device.name}, from a trial of {duration(found.trial_seconds)}")
    say(found.text())
