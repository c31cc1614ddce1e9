"""The runs of a sweep: planned, made at workers or one after the other, and kept as lines of one results file."""

import hashlib
import json
import logging
import math
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.cluster import Lost, Pool, Workers, runtime_of_process
from phyradgs_cl.errors import DeviceError, OutputError, PhyradgsError
from phyradgs_cl.io import only_run, written_beside
from phyradgs_cl.io.output import BusyError, make_folder, shortened
from phyradgs_cl.reconstructors import Progress, ProgressReport, ignore_progress
from phyradgs_cl.runtime.device import environment
from phyradgs_cl.signals import finish_despite_interrupt, keep_finished_work
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.reconstruct import is_complete, resume_or_restart
from phyradgs_cl.workflow.sweep import tables
from phyradgs_cl.workflow.sweep.grid import Setting, SweepGrid
from phyradgs_cl.workflow.sweep.tables import Line

RESULTS, VOLUMES = "results.jsonl", "volumes"
_STEM_BYTES = 80
_BUSY_S = 600.0
_LONGEST_ERROR = 2000
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SweepRun:
    """One reconstruction, in the form in which a worker gets it; ``facts`` identify it in the results file."""

    name: str
    setting: Setting
    seed: int
    scan: Path
    output: Path
    checkpoint_every_s: float
    facts: Line

    @property
    def record(self) -> Path:
        """The file next to the volume that holds the run's line, in case the line does not reach the sweep."""
        return self.output.with_suffix(".json")


@dataclass(frozen=True)
class SweepJob:
    """What to run into which folder. Without ``workers`` this process makes the runs, on ``device``."""

    grid: SweepGrid
    folder: Path
    workers: Workers | None = None
    device: str | None = None
    checkpoint_every_s: float = 600.0


@dataclass(frozen=True)
class SweepProgress:
    """The state of a sweep: finished runs, all runs, failed ones, and those that workers are making. line: of a run that has
    just finished. name, progress: of the run that this process is making. dashboard: the address of Dask's page, once."""

    done: int
    total: int
    failed: int
    running: int = 0
    line: Line | None = None
    name: str = ""
    progress: Progress | None = None
    dashboard: str = ""


Report = Callable[[SweepProgress], None]


def plan_sweep(grid: SweepGrid, folder: Path, checkpoint_every_s: float = 600.0) -> list[SweepRun]:
    """Returns every run, scan by scan, each with a name that its settings determine; volumes go to ``folder``/volumes."""
    runs = []
    for scan in grid.scans:
        stat = scan.stat()
        for setting in grid.settings:
            shared = {
                "scan": str(scan), "scan_bytes": stat.st_size, "scan_mtime_ns": stat.st_mtime_ns,
                "method": setting.method, "preset": setting.preset, "label": setting.label,
                "changes": _as_json(setting.changes), "input": _as_json(setting.before),
                "options": _as_json(asdict(setting.plan().options)),
            }
            for seed in grid.seeds:
                name = _name(scan, setting, seed)
                output = folder.resolve() / VOLUMES / f"{name}.h5"
                facts = {"run": name, **shared, "seed": seed, "volume": f"{VOLUMES}/{name}.h5"}
                runs.append(SweepRun(name, setting, seed, scan, output, checkpoint_every_s, facts))
    return runs


@np.errstate(all="ignore")
def run_sweep(job: SweepJob, report: Report = lambda progress: None) -> tuple[list[Path], int]:
    """Makes the missing runs, then the tables. Returns the written files and the number of runs that failed now. The next
    call makes failed runs again. An interruption (KeyboardInterrupt) loses no finished run. OutputError: the folder cannot
    be written; BusyError while another sweep uses it. InputError: no scheduler, or a missing package."""
    results = _results_file(job.folder)
    with only_run(results):
        lines = tables.read_lines(results)
        plan = plan_sweep(job.grid, job.folder, job.checkpoint_every_s)
        finished = {tables.identity(line) for line in lines if "error" not in line}
        missing = [run for run in plan if tables.identity(run.facts) not in finished]
        done, failed = len(plan) - len(missing), 0

        def say(**more: Any) -> None:
            report(SweepProgress(done, len(plan), failed, **more))

        for line in _lines(job, missing, say):
            with finish_despite_interrupt():
                tables.append_line(results, line)
                lines.append(line)
            done += 1
            failed += "error" in line
            say(line=line)
        with finish_despite_interrupt():
            return [results, *tables.write_tables(job.folder, lines, [run.facts for run in plan])], failed


def _lines(job: SweepJob, runs: Sequence[SweepRun], say: Callable[..., None]) -> Iterator[Line]:
    if not runs:
        return
    if job.workers is not None:
        by_name = {run.name: run for run in runs}
        with Pool(job.workers) as pool:
            say(dashboard=pool.dashboard)
            for name, line in pool.results(make_run, by_name, lambda running, devices: say(running=running)):
                yield failed_line(by_name[name], line.reason) if isinstance(line, Lost) else line
        return
    runtime_of_process(job.device)  # a missing device is not the error of a run
    for run in runs:

        def forward(progress: Progress, name: str = run.name) -> None:
            say(running=1, name=name, progress=progress)

        with keep_finished_work():  # a finished run is kept, then the sweep stops
            yield make_run(run, forward, job.device)


def make_run(run: SweepRun, report: ProgressReport = ignore_progress, device: str | None = None) -> Line:
    """Makes a run, in a worker or in this process, and returns its line, with the error where it fails. A finished run whose
    line was lost on its way is not made again. Raises KeyboardInterrupt for a run that was stopped, OutputError where
    nothing can be written."""
    try:
        with only_run(run.record, wait_s=_BUSY_S):  # a worker that lost its scheduler may still be making it
            return _recorded(run) or _reconstructed(run, report, device)
    except Exception as error:
        if isinstance(error, OutputError) and not isinstance(error, BusyError):
            raise
        is_defect = not isinstance(error, PhyradgsError | MemoryError)
        if is_defect:  # which must not cost a night's other runs
            log.exception("%s", run.name)
        if is_defect or isinstance(error, DeviceError):
            runtime_of_process.cache_clear()
        message = str(error) if isinstance(error, PhyradgsError) else f"{type(error).__name__}: {error}".rstrip(": ")
        return failed_line(run, message)


def _reconstructed(run: SweepRun, report: ProgressReport, device: str | None) -> Line:
    started = time.perf_counter()
    rt = runtime_of_process(device)
    plan = run.setting.plan(run.seed)
    result, metrics = resume_or_restart(plan, run.scan, run.output, lambda: rt, report, run.checkpoint_every_s)
    if not is_complete(result):
        raise KeyboardInterrupt
    line = {
        **run.facts,
        "metrics": {name: value if math.isfinite(value) else None for name, value in metrics.items()},
        "seconds": round(float(result.facts["seconds"]), 3),
        "total_s": round(time.perf_counter() - started, 3),
        "gaussians": result.facts.get("gaussians"),
        **environment(rt.device),
        "host": platform.node(),
    }
    with written_beside(run.record) as temporary:
        temporary.write_text(tables.json_text(line), encoding="utf-8")
    return line


def _recorded(run: SweepRun) -> Line | None:
    """Returns the line stored next to the volume, if both exist and the line is of this run."""
    lines = tables.read_lines(run.record) if run.output.is_file() else []
    return next((line for line in lines if tables.identity(line) == tables.identity(run.facts)), None)


def failed_line(run: SweepRun, error: str) -> Line:
    """Returns the line of a run that failed, or whose workers died."""
    finished = datetime.now(timezone.utc).isoformat(timespec="seconds")
    facts = {"version": __version__, "host": platform.node(), "finished": finished}
    return {**run.facts, "error": error[:_LONGEST_ERROR], **facts}  # a compiler's message may have many pages


def _results_file(folder: Path) -> Path:
    path = folder / RESULTS
    make_folder(folder / VOLUMES, folder)
    try:
        path.open("ab").close()
    except OSError as error:
        found = error.strerror or str(error)
        raise OutputError(str(folder), found, "a folder that can be written") from error
    return path


def _as_json(value: Any) -> Any:
    """Returns a value as it comes back from JSON: tuples become lists."""
    return json.loads(json.dumps(value, default=str))


def _name(scan: Path, setting: Setting, seed: int) -> str:
    """Joins the scan's name, the method, a digest that tells equal names apart, and the seed."""
    parts = [str(scan), setting.method, setting.preset, _as_json(setting.changes), _as_json(setting.before)]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:10]
    return f"{shortened(plain_text(scan.stem), _STEM_BYTES)}_{setting.method}_{digest}_s{seed}"
