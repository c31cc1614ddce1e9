"""sweep: scans × settings × seeds; bench: a first comparison of methods."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import signals
from phyradgs_cl.cluster import LOCAL, Workers, has_dask
from phyradgs_cl.commands.console import complain, file_argument, file_parser, option, remark, say, scores
from phyradgs_cl.commands.options import CHECKPOINT_EVERY_S, CheckpointEvery, Device, Scheduler, WorkerCount
from phyradgs_cl.errors import InputError
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish, read_config
from phyradgs_cl.workflow.sweep import RESULTS, SweepJob, SweepProgress, read_grid, run_sweep
from phyradgs_cl.workflow.sweep.grid import ITERATIONS, PIXELS, VOXELS, quick_grid

_REPEAT = "The command makes only the runs that its results file lacks: interrupt and repeat it at will."
EXAMPLES = {
    "sweep": f"Example: phyradgs sweep grid.toml -o results\n\n{_REPEAT} Docs: cluster.md.",
    "bench": (
        f"Example: phyradgs bench quick\n\n{_REPEAT} The paper's tables, on volumes of your own: "
        "python benchmarks/tables --help, in a checkout."
    ),
}
GROUPS = {"sweep": {"Basics": ("output", "checkpoint_every"), "Workers": ("scheduler", "workers", "device")}}
GROUPS["bench"] = {"Basics": ("output", "seed", "iterations"), "Workers": GROUPS["sweep"]["Workers"]}
_OUTPUT = f"Folder for {RESULTS} (one line per run), volumes and tables."
_DEVICES = "Devices of local workers, with commas: indices, cpu, gpu or parts of names."
_KIND = f"quick: methods with and without motion on two phantoms of {VOXELS}³ from {PIXELS}², a minute or two."
_TABLES = ("table1", "table2", "phantom")


def sweep_command(
    grid: Annotated[Path, file_argument("GRID", "TOML file: scans, settings and seeds (docs: cluster.md).")],
    output: Annotated[Path, option(_OUTPUT, True, "--output", "-o", metavar="DIR")],
    scheduler: Scheduler = None, workers: WorkerCount = None,
    checkpoint_every: CheckpointEvery = CHECKPOINT_EVERY_S,
    device: Annotated[str | None, option(_DEVICES, "all GPUs, else the best device")] = None,
) -> None:
    """Reconstruct many scans with many settings: a results file, volumes, and tables."""
    table = read_grid(read_config(grid, "GRID"), grid)
    pool = workers_of(scheduler, workers, device)  # may print a line, and an error has only one
    own_device = device if pool is None else None
    make_sweep(output, lambda: SweepJob(table, output, pool, own_device, checkpoint_every))


def bench_command(
    kind: Annotated[str, typer.Argument(metavar="quick", help=_KIND)],
    output: Annotated[
        Path | None,
        option(_OUTPUT, "bench-results", "--output", "-o", parser=file_parser("-o"), metavar="DIR"),
    ] = None,
    seed: Annotated[int, option("Seed of noise, cloud and frame order.", min=0)] = 0,
    iterations: Annotated[int, option("Iterations of the splatting methods.")] = ITERATIONS,
    scheduler: Scheduler = None,
    workers: WorkerCount = None,
    device: Device = None,
) -> None:
    """Compare methods on two built-in phantoms: a results file, volumes, and tables."""
    if kind != "quick":
        remedy = f"'python benchmarks/tables {kind} …' in a checkout" if kind in _TABLES else ""
        raise InputError("bench", repr(kind), "quick", remedy)
    wish, folder = device_wish(device), output or Path("bench-results")
    has_workers = scheduler is not None or workers is not None
    pool = workers_of(scheduler, workers, device) if has_workers else None

    def job() -> SweepJob:
        grid = quick_grid(folder, lambda: Runtime(wish), seed=seed, iterations=iterations)
        return SweepJob(grid, folder, pool, wish if pool is None else None)

    make_sweep(folder, job)


def make_sweep(folder: Path, make_job: Callable[[], SweepJob]) -> None:
    """Runs a sweep into ``folder`` with its progress on stderr, and prints the written files."""
    try:
        with SweepTicker() as ticker:
            written, failed = run_sweep(make_job(), ticker)
    except KeyboardInterrupt:
        complain(f"interrupted: finished runs are in {folder / RESULTS}; repeat the command to continue")
        raise typer.Exit(signals.exit_status()) from None
    for path in written:
        say(str(path))
    if failed:
        complain(f"{failed} runs failed: {folder / 'results.md'} gives the reasons; repeat the command to try again")
        raise typer.Exit(2)


def workers_of(scheduler: str | None, count: int | None, device: str | None) -> Workers | None:
    """Returns the workers of a command; None for this process, where no option names workers and Dask is missing."""
    device_wish(device)
    if scheduler is not None or count is not None or has_dask():
        return Workers(LOCAL if scheduler is None else scheduler, count, device)
    if device is not None and "," in device:
        remedy = "pip install 'phyradgs-cl[cluster]'"
        raise InputError("--device", repr(device), "one device, as dask.distributed is not installed", remedy)
    remark("dask.distributed is not installed: one run after the other; pip install 'phyradgs-cl[cluster]'")
    return None


class SweepTicker:
    """Progress of a sweep: a line per finished run, a counter of all runs, and one of the iterations of a run made here."""

    def __init__(self) -> None:
        self.all_runs, self.one_run, self.name = Ticker("run"), Ticker("iteration"), ""

    def __enter__(self) -> "SweepTicker":
        return self

    def __exit__(self, *_: object) -> None:
        self._end_lines()

    def __call__(self, p: SweepProgress) -> None:
        if p.dashboard:
            remark(f"Dask's dashboard: {p.dashboard}")
            return
        if p.line is not None:
            self._end_lines()
            error = p.line.get("error")
            outcome = f"failed: {error}" if error else f"{p.line['seconds']:.1f} s{scores(p.line['metrics'])}"
            say(f"{p.done}/{p.total} {p.line['run']} ({p.line['label']}): {outcome}")
        if p.progress is not None:
            if p.name != self.name:
                self.name, self.one_run = p.name, Ticker(f"{p.done + 1}/{p.total} {p.name}: iteration")
            self.one_run.progress(p.progress)
        elif p.line is not None or p.done < p.total:
            failed = f"  {p.failed} failed" if p.failed else ""
            running = f"  {p.running} under way" if p.running else ""
            self.all_runs.show(p.done, p.total, failed + running)

    def _end_lines(self) -> None:
        self.all_runs.end_line()
        self.one_run.end_line()
