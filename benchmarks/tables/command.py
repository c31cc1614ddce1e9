"""The command line: methods compared on volumes, as in the paper's tables."""

from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

import typer

from phyradgs_cl import signals
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.commands.console import complain, file_parser, say
from phyradgs_cl.commands.options import Device
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from tables import (
    KINDS,
    RESULTS,
    SIZES,
    BenchJob,
    BenchProgress,
    listed,
    listed_seeds,
    remake_tables,
    result_text,
    run_bench,
)

EXAMPLE = (
    "Example: python benchmarks/tables table1 --volumes VOLUMES -o results --size S --seeds 0,1,2\n\n"
    "Runs that the results file in the folder has already are not made again: interrupt and repeat at will."
)
BenchKind = Enum("BenchKind", {name: name for name in KINDS}, type=str)  # type: ignore[misc]
SizeName = Enum("SizeName", {name: name for name in SIZES}, type=str)  # type: ignore[misc]


def bench_command(
    kind: Annotated[
        BenchKind,  # type: ignore[valid-type]
        typer.Argument(
            help="table1: all methods, 25 and 50 views; table2: PhyRadGS over M and N; phantom: the paper's sphere "
            "phantom against a pseudo-truth.",
        ),
    ],
    volumes: Annotated[
        Path | None,
        typer.Option(
            parser=file_parser("--volumes"),
            metavar="DIR",
            help="Folder of HDF5 files NAME_COUNT.h5 or NAME.h5 with a dataset /volume; each is projected at its own "
            "resolution.",
            show_default="the built-in foot and jaw",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            parser=file_parser("-o"),
            metavar="DIR",
            help=f"Folder for {RESULTS} (one line per run), tables, figures and slices.",
            show_default="bench-results",
        ),
    ] = None,
    size: Annotated[
        SizeName | None,  # type: ignore[valid-type]
        typer.Option(
            help="; ".join(
                f"{s.name}: {s.voxels}³ from {s.pixels}², {s.iterations:,} iterations" for s in SIZES.values()
            ),
            show_default="S; M for phantom",
        ),
    ] = None,
    names: Annotated[str | None, typer.Option(help="Volumes, with commas.", show_default="all")] = None,
    rows: Annotated[
        str | None,
        typer.Option(
            help="Rows by their label in the table, with commas; a wrong one lists all.", show_default="all"
        ),
    ] = None,
    protocols: Annotated[
        str | None,
        typer.Option(
            help="rapid (25 views) and standard (50), with commas.",
            show_default="both for table1, else rapid",
        ),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            help="Seeds of noise, jitter, cloud and frame order, with commas.",
            show_default="0; with --table-only all",
        ),
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Iterations of the splatting methods.", show_default="the size's")
    ] = None,
    readout: Annotated[Literal[AXES], typer.Option(help="What is read out at one time.")] = "rows",
    table_only: Annotated[
        bool,
        typer.Option(
            "--table-only",
            help="Make tables and figures from the results file, of --names and --seeds or all; run nothing.",
        ),
    ] = False,
    device: Device = None,
) -> None:
    """Compares methods on volumes: a results file that grows, tables in Markdown and CSV, figures of slices."""
    chosen_seeds = None if seeds is None else listed_seeds("--seeds", seeds)
    job = BenchJob(
        kind.value,  # type: ignore[attr-defined]
        output or Path("bench-results"),
        volumes,
        size.value if size else None,  # type: ignore[attr-defined]
        listed("--names", names),
        listed("--protocols", protocols),
        listed("--rows", rows),
        (0,) if chosen_seeds is None else chosen_seeds,
        iterations,
        readout,
    )
    wish = device_wish(device)
    interrupted = (
        f"interrupted: finished runs are in {job.output / RESULTS}; repeat the command to continue, "
        "with --table-only for their tables"
    )
    try:
        written = remake_tables(job, chosen_seeds) if table_only else run_bench(job, lambda: Runtime(wish), BenchTicker())
    except KeyboardInterrupt:
        complain(interrupted)
        raise typer.Exit(signals.exit_status()) from None
    for path in written:
        say(str(path))


class BenchTicker:
    """Shows the progress of a benchmark: a counter for each run, and its result once it is done."""

    def __init__(self) -> None:
        self.title = ""
        self.ticker = Ticker("")

    def __call__(self, p: BenchProgress) -> None:
        if p.title != self.title:
            self.title = p.title
            self.ticker = Ticker(f"{p.number}/{p.runs} {p.title}: iteration")
        if p.line is not None:
            with self.ticker:  # this ends the line that the ticker rewrites
                pass
            say(result_text(p))
        elif p.iterations:
            self.ticker.show(p.iteration, p.iterations)
