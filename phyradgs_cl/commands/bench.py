"""bench: a quick comparison of methods."""

from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl.commands.files import file_parser, option
from phyradgs_cl.commands.options import Device, Scheduler, WorkerCount
from phyradgs_cl.commands.sweep import chosen_workers, make_sweep
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from phyradgs_cl.workflow.quick import ITERATIONS, PIXELS, VOXELS, quick_grid
from phyradgs_cl.workflow.sweep import RESULTS, SweepJob

EXAMPLE = (
    "Example: phyradgs bench quick\n\n"
    "Runs that the results file in the folder has already are not made again. The paper's tables, on volumes of your own: "
    "python benchmarks/tables --help, in a checkout."
)
_KIND = f"quick: methods with and without motion on two phantoms of {VOXELS}³ from {PIXELS}², a minute or two."
_OUTPUT = f"Folder for scans, {RESULTS} (one line per run), volumes and tables."
_TABLES = ("table1", "table2", "phantom")


def bench_command(
    kind: Annotated[str, typer.Argument(metavar="quick", help=_KIND)],
    output: Annotated[
        Path | None,
        option(_OUTPUT, "bench-results", "--output", "-o", parser=file_parser("-o"), metavar="DIR"),
    ] = None,
    seed: Annotated[int, option("Of noise, cloud and frame order.", min=0)] = 0,
    iterations: Annotated[int, option("Iterations of the splatting methods.")] = ITERATIONS,
    scheduler: Scheduler = None,
    workers: WorkerCount = None,
    device: Device = None,
) -> None:
    """Compare methods on two built-in phantoms: a resumable results file, volumes, a table."""
    if kind != "quick":
        remedy = f"'python benchmarks/tables {kind} …' in a checkout" if kind in _TABLES else ""
        raise InputError("bench", repr(kind), "quick", remedy)
    wish, folder = device_wish(device), output or Path("bench-results")
    asked = scheduler is not None or workers is not None
    pool = chosen_workers(scheduler, workers, device) if asked else None

    def prepared() -> SweepJob:
        grid = quick_grid(folder, lambda: Runtime(wish), seed=seed, iterations=iterations)
        return SweepJob(grid, folder, pool, wish if pool is None else None)

    make_sweep(folder, prepared)
