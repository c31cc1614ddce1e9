"""The runs of a sweep: made one after the other, or by Dask's workers, and kept as lines of one results file."""

import functools
import logging
import math
import os
import platform
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from phyradgs_cl import __version__, checks
from phyradgs_cl.errors import InputError, NumericalError, OutOfMemoryError, OutputError, PhyradgsError
from phyradgs_cl.io import only_run, written_beside
from phyradgs_cl.io.output import BusyError, make_folder
from phyradgs_cl.reconstructors import ProgressReport, ignore_progress
from phyradgs_cl.runtime import DEVICE_VARIABLE, Runtime, choose_device
from phyradgs_cl.runtime.device import environment
from phyradgs_cl.signals import finish_despite_interrupt, keep_finished_work
from phyradgs_cl.workflow.reconstruct import is_complete, resume_or_restart
from phyradgs_cl.workflow.sweep.grid import SweepRun
from phyradgs_cl.workflow.sweep.tables import Line, append_line, markdown, read_lines

RESULTS, TABLE = "results.jsonl", "results.md"
_RETRIES, _CONNECT_S, _BUSY_S = 3, 10.0, 20.0
# other machines must not send work to this one
_LOCAL = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}

runtime_of_process = functools.cache(Runtime)  # built kernels stay from run to run


def run_sweep(
    runs: Sequence[SweepRun], folder: Path, workers: str | None = None, device: str | None = None, *,
    tell: Callable[[int, Line], object] = lambda done, line: None, report: ProgressReport = ignore_progress,
) -> int:  # fmt: skip
    """Makes the runs that the results file lacks, then the table, results.md. Returns the number of runs that failed now,
    which the next call makes again. workers: a number of Dask's workers on this machine, or the address of a Dask scheduler;
    None makes the runs here. ``tell`` gets the number of finished runs and the last line. Raises OutputError where the
    folder cannot be written, BusyError while another sweep uses it, InputError for no scheduler or a missing package."""
    make_folder(folder / "volumes", folder)
    with only_run(folder / RESULTS):
        newest = {line["run"]: line for line in read_lines(folder / RESULTS)}
        missing = [run for run in runs if "error" in newest.get(run.facts["run"], {"error": "not made"})]
        done, failed = len(runs) - len(missing), 0
        lines = _made_here(missing, device, report)
        if workers is not None and missing:
            lines = _made_by_workers(missing, workers, device, folder / "workers.html")
        for line in lines:
            with finish_despite_interrupt():
                append_line(folder / RESULTS, line)
            newest[line["run"]] = line
            done, failed = done + 1, failed + ("error" in line)
            tell(done, line)
        with finish_despite_interrupt(), written_beside(folder / TABLE) as temporary:
            temporary.write_text(markdown([newest[run.facts["run"]] for run in runs], len(runs)), encoding="utf-8")
        return failed


def _made_here(runs: Sequence[SweepRun], device: str | None, report: ProgressReport) -> Iterator[Line]:
    for run in runs:
        runtime_of_process(device)  # a missing device is not the error of a run
        with keep_finished_work():  # a finished run is kept, then the sweep stops
            try:
                line = make_run(run, report, device)
            except Exception as error:
                line = _failed(run, error)
            yield line


def _made_by_workers(runs: Sequence[SweepRun], workers: str, device: str | None, page: Path) -> Iterator[Line]:
    """Yields lines as the runs finish, and writes Dask's page about them."""
    os.environ.setdefault("DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION", "1.0")  # a death counts against one run only
    dask = checks.package("distributed", "the package that --workers needs", "phyradgs-cl[cluster]")
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # an error of ours says it
    count, where = int(workers) if workers.isdigit() else None, {"address": workers, "timeout": _CONNECT_S}
    if count is not None:
        checks.within("--workers", count, 1, 1024)
        choose_device(device)
        where = {"n_workers": count, "threads_per_worker": 1, "memory_limit": None, **_LOCAL}
    try:
        with dask.Client(**where) as client, dask.performance_report(str(page)):
            if count is not None:
                client.register_worker_callbacks(functools.partial(_begin, device))
                client.cluster.adapt(minimum=count, maximum=count)  # else a worker that dies early is not replaced
                device = None  # each has its own
            run_of = {client.submit(make_run, run, device=device, retries=_RETRIES, pure=False): run for run in runs}
            for future in dask.as_completed(list(run_of)):
                run = run_of.pop(future)
                failure = None if future.cancelled() else future.exception()
                yield future.result() if failure is None else _failed(run, failure)
    except (TimeoutError, dask.TimeoutError, CancelledError, OSError, RuntimeError, ValueError) as error:
        expected, remedy = "a number of processes, or the address of a running Dask scheduler", "repeat the command to go on"
        raise InputError(f"--workers {workers}", f"no answer ({error})", expected, remedy) from error


def _begin(device: str | None, dask_worker: Any) -> None:
    """Gives a worker its device, by its number. Ctrl-C in a terminal reaches every process; the sweep answers it."""
    os.environ[DEVICE_VARIABLE] = str(choose_device(device, int(dask_worker.name))[0].index)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def make_run(run: SweepRun, report: ProgressReport = ignore_progress, device: str | None = None) -> Line:
    """Returns the line of a run, with the error where scan or options are at fault. Raises what another try may change."""
    try:
        rt = runtime_of_process(device)
        result, metrics = resume_or_restart(run.plan, run.scan, run.output, lambda: rt, report, run.checkpoint_every_s)
    except (InputError, NumericalError, OutOfMemoryError) as error:
        return _failed(run, error)
    except Exception as error:
        runtime_of_process.cache_clear()  # the next run opens its device again
        time.sleep(_BUSY_S if isinstance(error, BusyError) else 0)  # a lost worker may still be making it
        raise
    if not is_complete(result):
        raise KeyboardInterrupt
    facts = {name: result.facts.get(name) for name in ("seconds", "gaussians")}
    facts["metrics"] = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    return {**run.facts, **facts, **environment(rt.device), "host": platform.node()}


def _failed(run: SweepRun, error: Exception) -> Line:
    """Returns the line of a run that failed, or whose workers died. Raises OutputError where there is no room for any."""
    if isinstance(error, OutputError) and not isinstance(error, BusyError):
        raise error
    text = str(error) if isinstance(error, PhyradgsError) else f"{type(error).__name__}: {error}"
    return {**run.facts, "error": text[:2000], "version": __version__, "host": platform.node()}
