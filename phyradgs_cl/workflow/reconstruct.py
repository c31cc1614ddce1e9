"""From a scan file to a volume file, with checkpoints on the way."""

import json
import logging
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks, importers, signals
from phyradgs_cl.acquisition import MicroViews, Scan
from phyradgs_cl.acquisition.field_of_view import cuts
from phyradgs_cl.errors import InputError, OutputError, PhyradgsError, naming_host_memory
from phyradgs_cl.io import (
    check_writable,
    checkpoint_path,
    former_checkpoint_path,
    hashing,
    only_run,
    partial_path,
    read_checkpoint,
    sha256_of,
    write_checkpoint,
    write_volume,
)
from phyradgs_cl.metrics import VOXEL_BY_VOXEL, aligned, compare
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors import (
    DEFAULT_METHOD,
    METHODS,
    InputOptions,
    Progress,
    ProgressReport,
    Reconstruction,
    State,
    method_of,
    method_options,
    reconstruct,
)
from phyradgs_cl.reconstructors.interrupt import finish_despite_interrupt, keep_finished_work
from phyradgs_cl.reconstructors.result import COMPARED, HELD_OUT, option_facts
from phyradgs_cl.runtime import Runtime, profile_text
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.files import load_scan, refuse_foreign_suffix, refuse_overwriting

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReconstructionJob:
    """Which scan to reconstruct by which method, as from ``method_name``, into which file."""

    scan: Path
    output: Path
    method: str = DEFAULT_METHOD
    preset: str | None = None
    changes: Mapping[str, Any] | None = None
    seed: int = 0
    resume: bool = False
    config: Path | None = None
    before: InputOptions = InputOptions()
    checkpoint_every_s: float = 600.0
    initial: Path | None = None

    def __post_init__(self) -> None:
        checks.within("--checkpoint-every (seconds)", self.checkpoint_every_s, 0, 1e9)


class _Keeper:
    """A report that also keeps a checkpoint, at most one every so many seconds; 0: none before the end. It is replaced
    in one step, so that a kill leaves the last whole one; where it cannot be written the run goes on."""

    def __init__(self, path: Path, fingerprint: str, every_s: float, report: ProgressReport) -> None:
        self.path, self.fingerprint, self.every_s, self.report = path, fingerprint, every_s, report
        self.last_s = time.monotonic()
        self.failed = False
        self.kept: int | None = None
        """The iteration of the checkpoint that is there, if this run has written one."""

    def __call__(self, progress: Progress) -> None:
        self.report(progress)
        due = self.every_s > 0 and time.monotonic() - self.last_s >= self.every_s
        if due and progress.state is not None and progress.iteration < progress.iterations:
            self._keep(dict(progress.state()), progress.iteration)
            self.last_s = time.monotonic()

    def _keep(self, state: dict[str, np.ndarray], iteration: int) -> None:
        try:
            write_checkpoint(self.path, state, self.fingerprint)
            self.kept = iteration
        except OutputError as error:
            if not self.failed:
                log.warning("no checkpoint: %s", error)
            self.failed = True

    @contextmanager
    def telling(self) -> Iterator[None]:
        """Errors of the body say that there is a checkpoint to go on from, if there is one."""
        try:
            with naming_host_memory():
                yield
        except PhyradgsError as error:
            if self.kept is not None:
                way_on = f"--resume goes on from iteration {self.kept}"
                error.remedy = "; ".join(part for part in (error.remedy, way_on) if part)
            raise


@np.errstate(all="ignore")
def run_reconstruction(
    job: ReconstructionJob,
    make_runtime: Callable[[], Runtime],
    report: ProgressReport,
    ranks: Communicator | None = None,
) -> tuple[Reconstruction, dict[str, float]]:
    """Reconstructs and writes a volume file; returns the result and its metrics where the scan has a reference.

    An interrupted run leaves ``output`` alone: what it has goes to ``io.partial_path``, and a checkpoint that ``resume``
    continues; both go when a run ends. One that is killed leaves its last checkpoint. Of ``ranks``, which the runtime must
    have too, rank 0 alone writes and has metrics. Raises OutputError while another run is at work on the output.
    """
    leads = ranks is None or ranks.rank == 0
    options = method_options(job.method, job.preset, job.changes, job.before.tune)
    if leads:
        export = f"write volume.h5, then 'phyradgs export volume.h5 -o {plain_text(job.output.name)}'"
        refuse_foreign_suffix(job.output, export)
        check_writable(job.output)
    for path in (job.output, partial_path(job.output)):
        refuse_overwriting("-o", path, job.scan, *(other for other in (job.config, job.initial) if other))
    with only_run(job.output) if leads else nullcontext():
        return _reconstructed(job, options, make_runtime, report)


def _reconstructed(
    job: ReconstructionJob, options: Any, make_runtime: Callable[[], Runtime], report: ProgressReport
) -> tuple[Reconstruction, dict[str, float]]:
    with hashing(job.scan) as scan_hash_of:
        scan = load_scan(job.scan, job.before.flats)
        scan_hash = scan_hash_of()
    _warn_of_doubts(job, scan, options)
    rt = make_runtime()
    fingerprint = _fingerprint(scan_hash, job, options)
    extra: dict[str, Any] = {"before": job.before}
    leads = rt.ranks.rank == 0
    if job.initial is not None:
        extra["initial"] = importers.load_volume(job.initial)
    if job.resume:
        extra["resume"] = rt.ranks.bcast(_resumed(job, fingerprint) if leads else None)
    elif leads:
        _set_aside(job.output)
    keeper = _Keeper(checkpoint_path(job.output), fingerprint, job.checkpoint_every_s, report)
    result: Reconstruction | None = None
    metrics: dict[str, float] = {}
    try:
        with keeper.telling(), keep_finished_work():
            result = reconstruct(scan, job.method, rt, options, seed=job.seed, report=keeper, **extra)
            if not leads:
                return result, metrics
            with finish_despite_interrupt():
                metrics = _metrics(scan, result)
                path = job.output if result.state is None else partial_path(job.output)
                told = _provenance(result, scan_hash, job, rt)
                parts = result.volume, result.grid, told, result.gaussians, metrics or None
                write_volume(path, *parts, disagreement=result.disagreement)
                _keep_checkpoint(job, result, fingerprint)
    except signals.InterruptedAfterwards:
        if result is None or result.state is None:  # else told already, in the result
            raise
    return result, metrics


def _metrics(scan: Scan, result: Reconstruction) -> dict[str, float]:
    """Against the scan's reference, by the rule of ``metrics.aligned``, and against held-out pixels. The result's facts say
    how they were compared where that is not voxel by voxel."""
    held_out = result.facts.pop(HELD_OUT, {})
    if scan.reference is None:
        return held_out
    pair = aligned(result.volume, result.grid, scan.reference, scan.grid)
    if pair is None or not pair.reference.max() > 0:
        log.warning("no PSNR: nothing of the scan's reference lies in the volume's box")
        return held_out
    if pair.how != VOXEL_BY_VOXEL:
        result.facts[COMPARED] = pair.how
    return {**compare(pair.volume, pair.reference), **held_out}


def _warn_of_doubts(job: ReconstructionJob, scan: Scan, options: Any) -> None:
    """Says what can be reconstructed, but is hardly what was meant."""
    motion = getattr(options, "motion", None)
    is_ignored = scan.detector_model == "intensity" and not hasattr(options, "detector_model")
    if is_ignored and _averages(scan, options):
        found = "%s averages intensity over an exposure; --method %s averages line integrals"
        log.warning(found, job.scan, job.method)
    if scan.is_fly and isinstance(motion, MicroViews) and motion.strips > scan.lines:
        found = "%d strips are more than the %d lines of %s: one strip per line is the most there is"
        log.warning(found, motion.strips, scan.lines, job.scan)
    grid = job.before.with_margin(scan.with_grid(job.before).grid)
    if grid != scan.grid and hasattr(options, "iterations") and cuts(grid, scan.grid, scan.geometry):
        found = "%s: the grid ends inside the field of view, and --method %s puts what lies beyond into it; "
        given = job.before.margin_mm is not None
        found += "if the object goes on, widen --margin-mm" if given else "--margin-mm has that filled, and discards it"
        log.warning(found, job.scan, job.method)
    late = np.flatnonzero(np.diff(scan.frame_start_s) <= 0)
    if scan.is_fly and late.size:
        found = "%s: frame %d starts no later than frame %d: check frame_start_time, and that frames are in order"
        log.warning(found, job.scan, late[0] + 1, late[0])
    if (largest := float(scan.projections.max())) <= 0:
        found = f"no line integral is above 0 (the largest is {largest + 0.0:g})"  # + 0.0 makes a 0 of a -0
        log.warning("%s: %s: there is no object in it, or the sign is wrong", job.scan, found)


def _averages(scan: Scan, options: Any) -> bool:
    """Whether the method merges several poses into a line: of one pose, both detector models are the same."""
    if not hasattr(options, "motion"):
        return False
    cells = options.motion.cells(scan, 0)
    return cells.is_moving or cells.averages


def profile_report(rt: Runtime, result: Reconstruction) -> str:
    """A table of where a run's device time went; ``rt`` is the run's own, with ``profile``."""
    pairs = {str(name): int(n) for name, n in result.facts.get("evaluated_pairs", {}).items()}
    return profile_text(rt.kernel_uses(), float(result.facts["seconds"]), rt.best_rates(), pairs)


def _provenance(
    result: Reconstruction, scan_hash: str, job: ReconstructionJob, rt: Runtime
) -> dict[str, object]:
    return {
        **result.facts,
        "program": f"phyradgs-cl {__version__}",
        "python": platform.python_version(),
        "device": rt.device.name,
        "device_version": rt.device.version,
        "seed": job.seed,
        "input": job.before.facts(),
        "scan": str(job.scan),
        "scan_sha256": scan_hash,
        **_start_facts(job),
        "record": result.record,
    }


def _fingerprint(scan_hash: str, job: ReconstructionJob, options: Any) -> str:
    """What a run that goes on must have in common with the one that it continues, as JSON."""
    run = {"method": job.method, "seed": job.seed, "input": job.before.facts(), **option_facts(options), **_start_facts(job)}
    return json.dumps({"scan": scan_hash[:16], **run}, sort_keys=True, default=repr)


def _start_facts(job: ReconstructionJob) -> dict[str, str]:
    """Which volume the run starts from, if any."""
    return {} if job.initial is None else {"initial": str(job.initial), "initial_sha256": sha256_of(job.initial)}


def _resumed(job: ReconstructionJob, fingerprint: str) -> State:
    if not method_of(job.method).is_resumable:
        resumable = [name for name, method in METHODS.items() if method.is_resumable]
        expected = f"a method with checkpoints: {', '.join(resumable)}"
        raise InputError("--resume", f"--method {job.method}", expected)
    return read_checkpoint(checkpoint_path(job.output), fingerprint)


def _set_aside(output: Path) -> None:
    """Whoever repeats a command without --resume may have meant it: the hours in a checkpoint are not thrown away."""
    checkpoint = checkpoint_path(output)
    if checkpoint.is_file():
        kept = former_checkpoint_path(output)
        os.replace(checkpoint, kept)
        remedy = "to go on from it, stop, rename it back and add --resume"
        log.warning("%s is of an earlier run and is kept as %s: %s", checkpoint, kept.name, remedy)


def _keep_checkpoint(job: ReconstructionJob, result: Reconstruction, fingerprint: str) -> None:
    path = checkpoint_path(job.output)
    if result.state is None:
        for outdated in (path, partial_path(job.output)):
            with suppress(OSError):  # the volume is there, whatever lies in their place
                outdated.unlink()
    else:
        write_checkpoint(path, dict(result.state), fingerprint)


def go_on(
    job: ReconstructionJob, make_runtime: Callable[[], Runtime], report: ProgressReport
) -> tuple[Reconstruction, dict[str, float]]:
    """As ``run_reconstruction``; a checkpoint of another scan or other options, or a damaged one, is set aside."""
    checkpoint = checkpoint_path(job.output)
    if checkpoint.is_file() and method_of(job.method).is_resumable:
        try:
            return run_reconstruction(replace(job, resume=True), make_runtime, report)
        except InputError as error:
            named = ("--resume", str(checkpoint))
            if error.subject not in named and not error.subject.startswith("checkpoint"):
                raise
    return run_reconstruction(replace(job, resume=False), make_runtime, report)


def is_whole(result: Reconstruction) -> bool:
    """Whether the run came to its end; a stopped one has left a checkpoint."""
    return result.facts.get("interrupted_at") is None
