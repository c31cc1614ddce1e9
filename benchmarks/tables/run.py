"""Runs a benchmark: the runs that the results file lacks, one line each, and then the tables."""

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import PROTOCOLS, ConeGeometry
from phyradgs_cl.errors import InputError, NumericalError, OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.io import file_kind, only_run
from phyradgs_cl.neural import INSTALL
from phyradgs_cl.reconstructors import Progress, ProgressReport, RunPlan, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.device import environment
from phyradgs_cl.signals import finish_despite_interrupt, keep_finished_work
from phyradgs_cl.simulation import Scene, phantom_scene, volume_scene
from tables.case import SyntheticCase
from tables.identity import refuse_other_objects
from tables.job import PHANTOM, BenchJob, BenchProgress, PlannedRun, Report, plan_runs
from tables.phantom_case import PhantomCase
from tables.pseudo_truth import PseudoTruth, refuse_interrupted
from tables.results import Line, Present, append_line, read_lines
from tables.summary import REFERENCE
from tables.tables import write_tables

RESULTS = "results.jsonl"
Case = SyntheticCase | PhantomCase
# R2-Gaussian's scanner: distances and sides in scene units.
_TO_AXIS, _TO_DETECTOR, _PANEL_SIDE, _BOX_SIDE = 5.0, 7.0, 4.0, 2.0
log = logging.getLogger(__name__)


@np.errstate(all="ignore")  # overflow is found in the result, and reported in one line
def run_bench(
    job: BenchJob, make_runtime: Callable[[], Runtime], report: Report = lambda progress: None
) -> list[Path]:
    """Makes the runs that the results file lacks, then tables. Returns the files written.

    A run is in the file once it is done. An interruption (KeyboardInterrupt) loses only the present run, and the same job
    continues from there. job: all of it is checked before the first run. make_runtime: called once, if there is anything to
    do. report: called at the iterations of a run, and with its line when it is done.

    Raises InputError for rows, volumes, names or options that do not exist, and OutputError for a folder that cannot be
    written."""

    plan = plan_runs(job)
    _name_rows_left_out(job)
    results = _results_file(job.output)
    with only_run(results):
        lines = read_lines(results)
        refuse_other_objects(results, [run.facts for run in plan], lines)
        present = Present(lines)
        missing = [run for run in plan if not present.has(run.facts)]
        _check_volumes(missing)
        if missing:
            batch = Batch(job, results, lines, len(plan) - len(missing), len(plan), report, make_runtime())
            for _, group in groupby(missing, key=lambda run: run.case):
                batch.run_case(list(group))
        return _write_tables(job, lines)


def remake_tables(job: BenchJob, seeds: Sequence[int] | None = None) -> list[Path]:
    """Writes tables from the present results file. Returns the files written.

    The job's names, if it has any, and ``seeds`` restrict what is read."""
    lines = read_lines(job.output / RESULTS)
    if job.names:
        held = list(dict.fromkeys(str(line.get("volume")) for line in lines))
        for name in job.names:
            checks.one_of("--names", name, held)
    chosen = [line for line in lines if not job.names or line.get("volume") in job.names]
    return _write_tables(job, [x for x in chosen if seeds is None or x.get("seed") in seeds])


def _write_tables(job: BenchJob, lines: Sequence[Line]) -> list[Path]:
    if not lines:
        raise InputError(str(job.output / RESULTS), "no results", "a results file", "run the benchmark first")
    with finish_despite_interrupt():
        return write_tables(job, lines)


def _name_rows_left_out(job: BenchJob) -> None:
    """Names the rows that this machine cannot run."""
    lacking = {row.label: row.lacks(job.bench_size.voxels) for row in job.chosen_rows}
    left_out = [f"{label} {lacks}" for label, lacks in lacking.items() if lacks]
    if left_out:
        log.warning("left out: %s (%s)", ", ".join(left_out), INSTALL)


class Batch:
    """The runs after the first ``done`` of ``total``, one case after the other. ``lines`` are those of the results file, and
    grow."""

    def __init__(
        self, job: BenchJob, results: Path, lines: list[Line], done: int, total: int, report: Report, rt: Runtime
    ) -> None:
        self.job, self.results, self.report, self.rt = job, results, report, rt
        self.lines, self.present = lines, Present(lines)
        self.done, self.total = done, total
        self.warned: set[str] = set()

    def keep(self, line: Line) -> None:
        """Adds a line to the file and to ``lines``."""
        with finish_despite_interrupt():
            append_line(self.results, line)
        self.present.add(line)
        self.lines.append(line)

    def run_case(self, runs: Sequence[PlannedRun]) -> None:
        """Makes all missing runs of one case."""
        title = f"reference of seed {runs[0].seed}"
        first = BenchProgress(self.done + 1, self.total, title)
        case = make_case(self.job, self.rt, runs[0], _forwarded(self.report, first))
        if isinstance(case, PhantomCase):
            for line in reference_lines(self.job, runs[0], case, self.rt, self.present):
                self.keep(line)
        elif runs[0].volume not in self.warned:
            self.warned.add(runs[0].volume)
            case.warn_of_inverse_crime()
        for run in runs:
            self.done += 1
            started = BenchProgress(self.done, self.total, run.title)
            self.report(started)
            with keep_finished_work():  # a finished run is measured and kept, then the benchmark stops
                line = one_run(run, case, self.rt, _forwarded(self.report, started))
                self.keep(line)
            self.report(replace(started, line=line))


def reference_lines(
    job: BenchJob, run: PlannedRun, case: PhantomCase, rt: Runtime, present: Present
) -> Iterator[Line]:
    """Returns lines about what results are compared with, where any are missing."""
    same = {"acquisition": REFERENCE, "method": None, "options": {}, "iterations": job.bench_size.iterations}
    for name, measure in case.references().items():
        facts = {**run.facts, **same, "run": name, "label": name}
        if not present.has(facts):
            metrics = {key: _number(value) for key, value in measure().items()}
            yield {**facts, "metrics": metrics, **environment(rt.device)}


def one_run(run: PlannedRun, case: Case, rt: Runtime, progress: ProgressReport) -> Line:
    """Makes a run. Where numbers overflowed, the line has the error."""
    scan = case.scan(run.acquisition)
    started, used = time.perf_counter(), time.process_time()
    try:
        result = reconstruct(scan, RunPlan(str(run.row.method), run.options, seed=run.seed), rt, report=progress)
    except NumericalError as error:  # an overflow in one method must not cost a night's other runs
        log.warning("%s: %s", run.title, error)
        return {**run.facts, "error": str(error), **environment(rt.device)}
    seconds, processor_s = time.perf_counter() - started, time.process_time() - used
    refuse_interrupted(result)
    return {
        **run.facts,
        "metrics": {name: _number(value) for name, value in case.measure(result.volume).items()},
        "seconds": round(seconds, 3),
        "processor_s": round(processor_s, 3),  # of all threads: unlike seconds, it is comparable beside other work
        "gaussians": result.facts.get("gaussians"),
        **environment(rt.device),
    }


def make_case(job: BenchJob, rt: Runtime, run: PlannedRun, report: ProgressReport) -> Case:
    """Returns the object of a run on its scanner. ``report`` follows the reconstruction of a pseudo-truth."""
    size, protocol = job.bench_size, PROTOCOLS[run.protocol]
    if job.study == PHANTOM:
        pseudo = PseudoTruth(job, rt, run.seed, report)
        return PhantomCase(rt, size, protocol, job.axis, run.seed, pseudo.volume_of)
    geometry = ConeGeometry(_TO_AXIS, _TO_DETECTOR, (size.pixels,) * 2, (_PANEL_SIDE / size.pixels,) * 2)
    return SyntheticCase(rt, _scene(job, rt, run, geometry), geometry, protocol, job.axis, run.seed)


def _scene(job: BenchJob, rt: Runtime, run: PlannedRun, geometry: ConeGeometry) -> Scene:
    voxels = job.bench_size.voxels
    box = Grid.cube(voxels, _BOX_SIDE)
    if run.source is None:
        return phantom_scene(rt, run.volume, geometry, box, voxels, job.axis, 0)
    return volume_scene(rt, load_attenuation(run.source), f"volume {run.source}", geometry, box, voxels, job.axis)


def _number(value: float) -> float | None:
    """Returns a number for JSON, which has neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None


def _forwarded(report: Report, started: BenchProgress) -> ProgressReport:
    """Returns a method's report as the benchmark's."""

    def forward(p: Progress) -> None:
        report(BenchProgress(started.number, started.runs, started.title, p.iteration, p.iterations))

    return forward


def _check_volumes(runs: Sequence[PlannedRun]) -> None:
    """Refuses files that are no volumes now, not after hours of other runs."""
    for path in dict.fromkeys(run.source for run in runs):
        if path is not None and file_kind(path) == "scan":
            expected = "a dataset /volume (z, y, x), or one of our volumes"
            raise InputError(str(path), "a scan", expected, "take it out of the folder, or choose --names")
        if path is not None:
            load_attenuation(path, warn=False)  # the warning comes when the volume is used


def _results_file(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / RESULTS
        path.open("ab").close()
    except OSError as error:
        raise OutputError(
            str(folder), error.strerror or str(error), "a folder that can be written"
        ) from error
    return path
