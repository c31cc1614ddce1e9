"""sweep: scans × settings × seeds."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import signals
from phyradgs_cl.cluster import LOCAL, Workers, has_dask
from phyradgs_cl.commands.console import complain, remark, say, scores
from phyradgs_cl.commands.files import file_argument, option
from phyradgs_cl.commands.options import Scheduler, WorkerCount
from phyradgs_cl.errors import InputError
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import device_wish, read_config
from phyradgs_cl.workflow.sweep import RESULTS, SweepJob, SweepProgress, read_grid, run_sweep

EXAMPLE = (
    "Example: phyradgs sweep grid.toml -o results\n\n"
    "Runs that the results file in the folder has already are not made again: interrupt and repeat at will. "
    "Docs: cluster.md."
)
_OUTPUT = f"Folder for {RESULTS} (one line per run), volumes and tables."
_CHECKPOINT = "Keep a checkpoint of each run so often; a lost run goes on from it."


def sweep_command(
    grid: Annotated[Path, file_argument("GRID", "TOML file: scans, settings and seeds (docs: cluster.md).")],
    output: Annotated[Path, option(_OUTPUT, True, "--output", "-o", metavar="DIR")],
    scheduler: Scheduler = None,
    workers: WorkerCount = None,
    checkpoint_every: Annotated[float, option(_CHECKPOINT, metavar="SECONDS")] = 600.0,
    device: Annotated[
        str | None,
        option(
            "Devices of local workers, with commas: indices, cpu, gpu or parts of names.",
            "all GPUs, else the best device",
        ),
    ] = None,
) -> None:
    """Reconstruct many scans with many settings: a resumable results file, volumes, and tables."""
    read = read_grid(read_config(grid, "GRID"), grid)
    where = chosen_workers(scheduler, workers, device)  # may say something, and an error has one line
    here = device if where is None else None
    make_sweep(output, lambda: SweepJob(read, output, where, here, checkpoint_every))


def make_sweep(folder: Path, prepared: Callable[[], SweepJob]) -> None:
    """Runs the sweep that is ``prepared`` into ``folder``, with progress, and says what was written."""
    interrupted = f"interrupted: finished runs are in {folder / RESULTS}; repeat the command to go on"
    try:
        with SweepTicker() as ticker:
            written, failed = run_sweep(prepared(), ticker)
    except KeyboardInterrupt:
        complain(interrupted)
        raise typer.Exit(signals.exit_status()) from None
    for path in written:
        say(str(path))
    if failed:
        complain(f"{failed} runs failed: {folder / 'results.md'} says why; repeat the command to try again")
        raise typer.Exit(2)


def chosen_workers(scheduler: str | None, count: int | None, device: str | None) -> Workers | None:
    """Workers as the options ask for them; None is this process, where nothing is asked for and Dask is missing."""
    device_wish(device)
    if scheduler is not None or count is not None or has_dask():
        return Workers(LOCAL if scheduler is None else scheduler, count, device)
    if device is not None and "," in device:
        remedy = "pip install 'phyradgs-cl[cluster]'"
        raise InputError("--device", repr(device), "one device, as dask.distributed is not installed", remedy)
    remark("dask.distributed is not installed: one run after the other; pip install 'phyradgs-cl[cluster]'")
    return None


class SweepTicker:
    """Progress of a sweep: one line per finished run, a counter for all, and for the iterations of a run made here."""

    def __init__(self) -> None:
        self.all, self.one, self.name = Ticker("run"), Ticker("iteration"), ""

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
            found = f"failed: {error}" if error else f"{p.line['seconds']:.1f} s{scores(p.line['metrics'])}"
            say(f"{p.done}/{p.total} {p.line['run']} ({p.line['label']}): {found}")
        if p.progress is not None:
            if p.name != self.name:
                self.name, self.one = p.name, Ticker(f"{p.done + 1}/{p.total} {p.name}: iteration")
            self.one.progress(p.progress)
        else:
            if p.line is None and p.done == p.total:  # said with the last line
                return
            failed = f"  {p.failed} failed" if p.failed else ""
            self.all.show(p.done, p.total, f"{failed}  {p.running} under way" if p.running else failed)

    def _end_lines(self) -> None:
        for ticker in (self.all, self.one):
            with ticker:
                pass
