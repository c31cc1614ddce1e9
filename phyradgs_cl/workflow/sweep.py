"""Reconstructs many scans with many settings and seeds, listed in a TOML file that is checked before any run. Runs are made
one by one or by Dask's workers. Each adds a line to one results file; a table has the means over scans and seeds."""

import functools
import glob
import hashlib
import itertools
import json
import logging
import math
import os
import platform
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.errors import InputError, NumericalError, OutOfMemoryError, OutputError, PhyradgsError
from phyradgs_cl.io import only_run, written_beside
from phyradgs_cl.io.hdf5 import open_hdf5
from phyradgs_cl.io.output import BusyError, make_folder, shortened
from phyradgs_cl.io.scan.header import read_header
from phyradgs_cl.io.tables import read_toml, refuse_unknown
from phyradgs_cl.metrics import HELD_OUT, METRICS
from phyradgs_cl.reconstructors import ProgressReport, RunPlan, ignore_progress, plan_run
from phyradgs_cl.reconstructors.method import DEFAULT_METHOD, method_name
from phyradgs_cl.runtime import DEVICE_VARIABLE, Runtime, choose_device
from phyradgs_cl.runtime.device import environment
from phyradgs_cl.signals import finish_despite_interrupt, keep_finished_work
from phyradgs_cl.text import flattened, nested, plain_text
from phyradgs_cl.workflow.files import expecting
from phyradgs_cl.workflow.reconstruct import resume_or_restart

log = logging.getLogger(__name__)
RESULTS, TABLE = "results.jsonl", "results.md"
_RETRIES = 3  # times that Dask repeats a run after an error
_CONNECT_S = 10.0  # time limit in s for connecting to Dask's scheduler
_BUSY_S = 20.0  # pause in s before a new try of a run whose output another process is writing
# Dask listens on this machine only, so that nobody else can send work to it
_LOCAL = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
Line = dict[str, Any]

runtime_of_process = functools.cache(Runtime)  # one Runtime per process and device, so that kernels are built only once


@dataclass(frozen=True)
class SweepRun:
    """One reconstruction of a sweep. facts: the first entries of the run's line of results; "run" is the run's name."""

    scan: Path
    plan: RunPlan
    output: Path
    facts: dict[str, Any]
    checkpoint_every_s: float


def plan_sweep(path: Path, folder: Path, checkpoint_every_s: float = 600.0) -> list[SweepRun]:
    """Returns every run of the sweep's file ``path``, scan by scan. Volumes will be written to ``folder``/volumes. Patterns
    of scans are relative to the folder of ``path``. A run's name depends on its scan (path, size, time of change), setting
    and seed. Raises InputError for what would stop a run: unknown keys, wrong values, patterns that match no scan."""
    document = read_toml(path, f"GRID {path}")
    refuse_unknown(f"{path}:", document, ("scans", "seeds", "options", "grid", "runs"))
    patterns = _list(document.get("scans"), str, f"{path}: scans", 'a list of files or patterns, as ["scans/*.h5"]')
    seeds = dict.fromkeys(_list(document.get("seeds", [0]), int, f"{path}: seeds", "a list of whole numbers"))
    settings, runs = list(_settings(document, path)), []
    for scan in dict.fromkeys(scan for pattern in patterns for scan in _files(pattern, path)):
        with expecting(scan, "scan"), open_hdf5(scan) as source:
            read_header(source)
        version = [str(scan), scan.stat().st_size, scan.stat().st_mtime_ns]
        for values, seed in itertools.product(settings, seeds):
            plan = _plan(values, seed, str(path))
            label = " ".join([plan.method_name, *(f"{n}={value}" for n, value in values.items() if n != "method")])
            digest = hashlib.sha256(json.dumps([version, values], sort_keys=True, default=str).encode()).hexdigest()[:10]
            name = f"{shortened(plain_text(scan.stem), 80)}_{plan.method_name}_{digest}_s{seed}"
            facts = {"run": name, "scan": str(scan), "method": plan.method_name, "options": values, "label": label}
            facts |= {"seed": seed, "volume": f"volumes/{name}.h5"}
            runs.append(SweepRun(scan, plan, folder.resolve() / str(facts["volume"]), facts, checkpoint_every_s))
    return list({run.facts["run"]: run for run in runs}.values())


def _list(values: Any, kind: type, subject: str, expected: str) -> list[Any]:
    if not (isinstance(values, list) and values and all(type(value) is kind for value in values)):
        raise InputError(subject, checks.short_repr(values), expected)
    return values


def _files(pattern: str, path: Path) -> list[Path]:
    folder = path.resolve().parent
    files = sorted(name for name in glob.glob(str(folder / pattern), recursive=True) if os.path.isfile(name))
    if not files:
        remedy = f"patterns start at the folder of the file, {folder}"
        raise InputError(f"{path}: scans", f"no file for {pattern!r}", "at least one scan file", remedy)
    return [Path(os.path.abspath(name)) for name in files]


def _settings(document: Mapping[str, Any], path: Path) -> Iterator[dict[str, Any]]:
    """Yields the options of every setting, by dotted name: each [[runs]], and all combinations of the lists in each
    [[grid]]. [options] are added to all. Raises InputError for a file with neither table, and for an empty list."""
    keys = [key for key in ("grid", "runs") if key in document]
    if not keys:
        remedy = "write for example [[grid]] with method = ['fdk', 'sirt']"
        raise InputError(str(path), "neither [[grid]] nor [[runs]]", "at least one of them", remedy)
    (shared,) = _list([document.get("options", {})], dict, f"{path}: options", "a table")
    for key in keys:
        for table in _list(document[key], dict, f"{path}: {key}", f"tables that begin with [[{key}]]"):
            stated = dict(flattened(table))
            lists = [value if isinstance(value, list) and key == "grid" else [value] for value in stated.values()]
            if [] in lists:
                raise InputError(f"{path}: [[grid]]", "an empty list", "the values to try")
            for values in itertools.product(*lists):
                yield {**dict(flattened(shared)), **dict(zip(stated, values, strict=True))}


def _plan(values: Mapping[str, Any], seed: int, where: str) -> RunPlan:
    """Returns the plan of a run. In errors of ``plan_run``, ``where`` and the ``values`` come before the message."""
    options = nested(values)
    method, preset = options.pop("method", DEFAULT_METHOD), options.pop("preset", None)
    try:
        return plan_run(method_name(method), options, preset=preset, seed=seed)
    except PhyradgsError as error:
        stated = ", ".join(f"{name}={checks.short_repr(value)}" for name, value in values.items())
        raise type(error)(f"{where} ({stated}): {error.subject}", error.found, error.expected, error.remedy) from error


def run_sweep(
    runs: Sequence[SweepRun], folder: Path, workers: str | None = None, device: str | None = None, *,
    tell: Callable[[int, Line], object] = lambda done, line: None, report: ProgressReport = ignore_progress,
) -> int:  # fmt: skip
    """Makes the runs that the results file lacks, then the table results.md. Returns how many runs failed; the next call
    tries them again. workers: a number of Dask's workers on this machine, or the address of a Dask scheduler; None makes
    the runs in this process. tell: called with the number of finished runs and the last line. Raises OutputError if the
    folder cannot be written, BusyError while another sweep uses it, and InputError for a scheduler that does not answer or
    a missing package."""
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
        runtime_of_process(device)  # without a device no run can succeed, so its error stops the sweep
        with keep_finished_work():  # Ctrl-C stops the sweep, but a finished run is kept
            try:
                line = make_run(run, report, device)
            except Exception as error:
                line = _failed(run, error)
            yield line


def _made_by_workers(runs: Sequence[SweepRun], workers: str, device: str | None, page: Path) -> Iterator[Line]:
    """Yields lines of runs as they finish; writes Dask's report to ``page``. Raises InputError if no scheduler answers."""
    os.environ.setdefault("DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION", "1.0")  # else a worker's death fails queued runs
    dask = checks.package("distributed", "the package that --workers needs", "phyradgs-cl[cluster]")
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # Dask's own log would repeat the InputError below
    count, where = int(workers) if workers.isdigit() else None, {"address": workers, "timeout": _CONNECT_S}
    if count is not None:
        checks.within("--workers", count, 1, 1024)
        choose_device(device)
        where = {"n_workers": count, "threads_per_worker": 1, "memory_limit": None, **_LOCAL}
    try:
        with dask.Client(**where) as client, dask.performance_report(str(page)):
            if count is not None:
                client.register_worker_callbacks(functools.partial(_begin, device))
                client.cluster.adapt(minimum=count, maximum=count)  # else Dask does not replace a worker that dies early
                device = None  # _begin chooses each worker's device
            run_of = {client.submit(make_run, run, device=device, retries=_RETRIES, pure=False): run for run in runs}
            for future in dask.as_completed(list(run_of)):
                run = run_of.pop(future)
                failure = None if future.cancelled() else future.exception()
                yield future.result() if failure is None else _failed(run, failure)
    except (TimeoutError, dask.TimeoutError, CancelledError, OSError, RuntimeError, ValueError) as error:
        expected, remedy = "a number of processes, or the address of a running Dask scheduler", "repeat the command to go on"
        raise InputError(f"--workers {workers}", f"no answer ({error})", expected, remedy) from error


def _begin(device: str | None, dask_worker: Any) -> None:
    """Prepares a worker: chooses its device by its number, and ignores Ctrl-C, which the sweep's main process handles."""
    os.environ[DEVICE_VARIABLE] = str(choose_device(device, int(dask_worker.name))[0].index)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def make_run(run: SweepRun, report: ProgressReport = ignore_progress, device: str | None = None) -> Line:
    """Makes one run of the sweep and returns its line of results, which has the error if another try would fail too. Raises
    all other errors, and KeyboardInterrupt for an interrupted run."""
    try:
        rt = runtime_of_process(device)
        result, metrics = resume_or_restart(run.plan, run.scan, run.output, lambda: rt, report, run.checkpoint_every_s)
    except (InputError, NumericalError, OutOfMemoryError) as error:
        return _failed(run, error)
    except Exception as error:
        runtime_of_process.cache_clear()  # the device may have failed: the next run opens it again
        time.sleep(_BUSY_S if isinstance(error, BusyError) else 0)  # a worker that lost contact may be writing the output
        raise
    result.complete()
    facts = {name: result.facts.get(name) for name in ("seconds", "gaussians")}
    facts["metrics"] = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    return {**run.facts, **facts, **environment(rt.device), "host": platform.node()}


def _failed(run: SweepRun, error: Exception) -> Line:
    """Returns the line of results of a failed run. Raises an OutputError that is no BusyError, because all runs would meet
    it."""
    if isinstance(error, OutputError) and not isinstance(error, BusyError):
        raise error
    text = str(error) if isinstance(error, PhyradgsError) else f"{type(error).__name__}: {error}"
    return {**run.facts, "error": text[:2000], "version": __version__, "host": platform.node()}


def markdown(lines: Sequence[Line], planned: int) -> str:
    """Returns a table in Markdown with the means and standard deviations of every setting over scans and seeds. Below are
    the failed runs. planned: the number of all runs."""
    done, failed = [line for line in lines if "error" not in line], [line for line in lines if "error" in line]
    measured = {name for line in done for name in line["metrics"]}
    metrics = {**METRICS, **{name: metric for name, metric in HELD_OUT.items() if name in measured}}
    headings = ["setting", "runs", *(metric.heading for metric in metrics.values()), "seconds"]
    title = f"{len(done)} of {planned} runs, {len(failed)} failed; mean ± standard deviation over scans and seeds."
    rows = [title, "", _row(headings), _row(["---"] + ["---:"] * (len(headings) - 1))]
    for label in dict.fromkeys(line["label"] for line in done):
        same = [line for line in done if line["label"] == label]
        means = [_mean([line["metrics"].get(name) for line in same], metric.form) for name, metric in metrics.items()]
        rows.append(_row([label, str(len(same)), *means, _mean([line["seconds"] for line in same], ".1f")]))
    if failed:
        rows += ["", _row(["failed run", "setting", "error"]), _row(["---"] * 3)]
    return "\n".join([*rows, *(_row([line["run"], line["label"], line["error"]]) for line in failed), ""])


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _mean(values: Sequence[Any], form: str) -> str:
    numbers = [float(value) for value in values if value is not None]
    spread = f" ± {np.std(numbers, ddof=1):{form}}" if len(numbers) > 1 else ""
    return f"{np.mean(numbers):{form}}{spread}" if numbers else "–"


def read_lines(path: Path) -> list[Line]:
    """Reads the lines of a results file; [] if there is no file. Leaves damaged lines out, with a warning."""
    lines, damaged = [], []
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    for number, row in enumerate(text.split("\n"), 1):
        try:
            line = json.loads(row)
            lines.append({"run": line["run"], **line})
        except (ValueError, KeyError, TypeError):
            damaged += [str(number)] if row.strip() else []
    if damaged:
        log.warning("%s: damaged and left out: line %s", path, ", ".join(damaged))
    return lines


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Appends one line in a single write, and waits until it is on the disk. Raises OutputError if that fails."""
    text = plain_text(json.dumps(line, ensure_ascii=False, allow_nan=False, default=str)) + "\n"
    try:
        with open(path, "ab+") as file:
            if file.tell() and file.seek(-1, os.SEEK_END) >= 0 and file.read(1) != b"\n":
                text = "\n" + text  # the last line was cut off: begin a new one
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(str(path), error.strerror or str(error), "a file that can be appended to") from error
