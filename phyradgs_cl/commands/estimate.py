"""estimate: what a reconstruction would take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import checks
from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.files import file_argument
from phyradgs_cl.commands.options import RANKS
from phyradgs_cl.commands.run_options import RunRequest, with_run_options
from phyradgs_cl.errors import InputError
from phyradgs_cl.estimate import duration, estimate, seconds_around, seconds_since_start
from phyradgs_cl.rank_plan import plan_ranks
from phyradgs_cl.reconstructors import Reconstruction, method_options
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.memory import memory_limit
from phyradgs_cl.workflow import load_scan

EXAMPLE = "Example: phyradgs estimate scan.h5 --method fista-tv --motion per-row"
MOST_RANKS = 100_000


@with_run_options("seed")
def estimate_command(
    scan: Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")],
    request: RunRequest,
    ranks: Annotated[
        int | None,
        typer.Option(
            metavar="R",
            help="Without a trial: what lies where on R ranks of mpiexec, bytes a rank, bytes exchanged.",
            rich_help_panel=RANKS,
        ),
    ] = None,
) -> None:
    """Say how long a reconstruction would take and how much memory, from a few iterations of it."""
    settings = request.settings()
    options = method_options(settings.method, settings.preset, settings.changes)
    loaded = load_scan(scan)
    if ranks is not None:
        checks.within("--ranks", ranks, 1, MOST_RANKS)
        if (device := request.given["device"]) is not None:
            remedy = "leave it out: a plan needs no device"
            raise InputError("--device", repr(device), "none with --ranks", remedy)
        plan = plan_ranks(loaded.with_grid(settings.before), settings.method, options, ranks)
        say(plan.text(memory_limit(settings.memory)))
        return
    with settings.naming_origins():
        rt = Runtime(settings.device, memory=settings.memory)
    before_s = seconds_since_start()  # a run will have started, and read the scan, as this did

    def around(result: Reconstruction) -> float:
        return before_s + seconds_around(scan, loaded, result)

    found = estimate(loaded, settings.method, options, rt, settings.before, around)
    say(f"{settings.method} on {rt.device.name}, from a trial of {duration(found.trial_seconds)}")
    say(found.text())
