"""Makes the runs that a sweep's results file lacks, at workers or one after the other, and then the tables."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl.cluster import Lost, Pool, PoolState, Workers, runtime_of_process
from phyradgs_cl.errors import OutputError
from phyradgs_cl.io import only_run
from phyradgs_cl.io.json_lines import Line, append_line, read_lines, refuse_irregular
from phyradgs_cl.io.output import make_folder
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.reconstructors.interrupt import finish_despite_interrupt, keep_finished_work
from phyradgs_cl.workflow.sweep.grid import SweepGrid
from phyradgs_cl.workflow.sweep.plan import VOLUMES, SweepRun, is_sound, missing_runs, plan_sweep
from phyradgs_cl.workflow.sweep.tables import write_tables
from phyradgs_cl.workflow.sweep.task import failed_line, make_run

RESULTS = "results.jsonl"


@dataclass(frozen=True)
class SweepJob:
    """What to run into which folder; ``workers`` None makes the runs in this process, on ``device``."""

    grid: SweepGrid
    folder: Path
    workers: Workers | None = None
    device: str | None = None
    checkpoint_every_s: float = 600.0


@dataclass(frozen=True)
class SweepProgress:
    """Where a sweep is: runs done of all, failed ones among them, those at workers; ``line`` of a run just done;
    ``name`` and ``progress`` of the run under way in this process; ``dashboard`` is said once."""

    done: int
    total: int
    failed: int
    running: int = 0
    line: Line | None = None
    name: str = ""
    progress: Progress | None = None
    dashboard: str = ""


Report = Callable[[SweepProgress], None]


@np.errstate(all="ignore")
def run_sweep(job: SweepJob, report: Report = lambda progress: None) -> tuple[list[Path], int]:
    """Makes what is missing, then tables; the files written, and how many runs of the grid have failed now, which the next
    call makes again. An interruption (KeyboardInterrupt) loses nothing that is done. OutputError: the folder cannot be
    written; BusyError while another sweep is at work on it. InputError: no scheduler, or a package that is not installed."""
    results = _results_file(job.folder)
    with only_run(results):
        lines = read_lines(results, is_sound)
        plan = plan_sweep(job.grid, job.folder, job.checkpoint_every_s)
        missing = missing_runs(plan, lines)
        batch = _Batch(job, results, lines, len(plan), len(plan) - len(missing), report)
        if missing:
            batch.make(missing)
        with finish_despite_interrupt():
            return [results, *write_tables(job.folder, lines, plan)], batch.failed


class _Batch:
    """The runs that are made now."""

    def __init__(
        self, job: SweepJob, results: Path, lines: list[Line], total: int, done: int, report: Report
    ) -> None:
        self.job, self.results, self.lines, self.report = job, results, lines, report
        self.total, self.done, self.failed = total, done, 0

    def make(self, runs: Sequence[SweepRun]) -> None:
        made = self._here(runs) if self.job.workers is None else self._at_workers(self.job.workers, runs)
        for line in made:
            with finish_despite_interrupt():
                append_line(self.results, line)
                self.lines.append(line)
            self.done += 1
            self.failed += "error" in line
            self._say(line=line)

    def _here(self, runs: Sequence[SweepRun]) -> Iterator[Line]:
        with runtime_of_process(self.job.device):  # no device is no error of a run
            pass
        for run in runs:

            def forward(progress: Progress, name: str = run.name) -> None:
                self._say(running=1, name=name, progress=progress)

            with keep_finished_work():  # a run that is done is kept, then the sweep stops
                yield make_run(run, forward, self.job.device)

    def _at_workers(self, workers: Workers, runs: Sequence[SweepRun]) -> Iterator[Line]:
        by_name = {run.name: run for run in runs}

        def look(state: PoolState) -> None:
            self._say(running=state.running)

        with Pool(workers) as pool:
            self._say(dashboard=pool.dashboard)
            for name, found in pool.results(make_run, by_name, look):
                yield failed_line(by_name[name], found.reason) if isinstance(found, Lost) else found

    def _say(self, **more: Any) -> None:
        self.report(SweepProgress(self.done, self.total, self.failed, **more))


def _results_file(folder: Path) -> Path:
    path = folder / RESULTS
    make_folder(folder / VOLUMES, folder)
    refuse_irregular(path)
    try:
        path.open("ab").close()
    except OSError as error:
        found = error.strerror or str(error)
        raise OutputError(str(folder), found, "a folder that can be written") from error
    return path
