"""A benchmark's runs at the workers of a cluster: the same lines in the same file, and the same tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from phyradgs_cl.cluster import Lost, Pool, Workers, runtime_of_process
from phyradgs_cl.io import only_run
from phyradgs_cl.reconstructors import ignore_progress
from phyradgs_cl.runtime import Runtime
from tables.case import Case
from tables.figures import truth_of, write_slices
from tables.job import PHANTOM, BenchJob, PlannedRun, Report
from tables.pseudo_truth import PseudoTruth
from tables.results import Line, Present
from tables.run import Batch, Work, complete_bench, make_case, one_run, reference_lines

_LONGEST_WAIT_S = 86_400.0


@dataclass(frozen=True, eq=False)
class BenchTask:
    """A run as it is sent to a worker; ``known`` are the lines about references that the file has."""

    job: BenchJob
    run: PlannedRun
    known: Sequence[Line]
    is_first: bool


def run_bench_at_workers(
    job: BenchJob,
    workers: Workers,
    report: Report = lambda progress: None,
    told: Any = lambda dashboard: None,
) -> list[Path]:
    """As ``run_bench``, with the runs at workers; the folders must be the same files for all of them.

    ``report`` is called with finished runs only, ``told`` once with the address of Dask's dashboard.
    """
    volumes = None if job.volumes is None else job.volumes.absolute()
    job = replace(job, output=job.output.absolute(), volumes=volumes)

    def at_workers(work: Work) -> None:
        batch = Batch(job, work, report)
        tasks = _tasks(job, work)
        devices = 1

        def count(running: int, at_workers: int) -> None:
            nonlocal devices
            devices = max(1, at_workers)

        with Pool(workers) as pool:
            told(pool.dashboard)
            for name, found in pool.results(make_lines, tasks, count):
                run = tasks[name].run
                lines = [{**run.facts, "error": found.reason}] if isinstance(found, Lost) else found
                for line in lines:
                    if "error" in line or not batch.present.has(line):
                        batch.keep(line)
                batch.finish(run, lines[-1], devices)

    return complete_bench(job, at_workers)


def _tasks(job: BenchJob, work: Work) -> dict[str, BenchTask]:
    """By name, in the order of the plan; the first of a case also makes the lines about its references."""
    known = [line for line in work.lines if line.get("method") is None]
    tasks, seen = {}, set()
    for number, run in enumerate(work.missing):
        tasks[f"bench-{number}"] = BenchTask(job, run, known, run.case not in seen)
        seen.add(run.case)
    return tasks


_last_case: dict[tuple[Any, ...], Case] = {}


def make_lines(task: BenchTask) -> list[Line]:
    """The lines of a run, its own the last; in a worker, which keeps the last case that it has made."""
    rt = runtime_of_process()
    case = _case_of(task, rt)
    lines: list[Line] = []
    if task.is_first:
        write_slices(task.job.output, truth_of(task.run.facts), case.slices(case.truth))
        lines += reference_lines(task.job, task.run, case, rt, Present(task.known))
    return [*lines, one_run(task.job, task.run, case, rt, ignore_progress)]


def _case_of(task: BenchTask, rt: Runtime) -> Case:
    job, run = task.job, task.run
    key = (job.study, job.output, job.volumes, job.bench_size, job.axis, *run.case)
    if key not in _last_case:
        if job.study == PHANTOM:
            pseudo = PseudoTruth(job, rt, run.seed, ignore_progress)
            with only_run(pseudo.path, wait_s=_LONGEST_WAIT_S):  # one worker makes it, the others read it
                pseudo.volume_of()
        _last_case.clear()
        _last_case[key] = make_case(job, rt, run, ignore_progress)
        if task.is_first:
            _last_case[key].warn_of_inverse_crime()
    return _last_case[key]
