"""Reconstructs a scan file to a volume file, with checkpoints."""

import logging
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl import __version__, checks, signals
from phyradgs_cl import reconstructors as methods
from phyradgs_cl.acquisition import MicroViews, Scan
from phyradgs_cl.acquisition.geometry import cuts
from phyradgs_cl.detector import noise_level
from phyradgs_cl.errors import InputError, OutputError, PhyradgsError
from phyradgs_cl.io import hashing, only_run, read_checkpoint, read_scan_header, write_checkpoint
from phyradgs_cl.io.output import checkpoint_path, former_checkpoint_path, partial_path, refuse_overwriting
from phyradgs_cl.io.volume import Volume, write_volume
from phyradgs_cl.metrics import METRICS, VOXEL_BY_VOXEL, aligned, compare
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.reconstructors.result import COMPARED, HELD_OUT
from phyradgs_cl.reconstructors.run import check_resumable, check_scan
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.files import check_output, expecting, load_scan
from phyradgs_cl.workflow.slabs import Slabs, reconstruct_slabs, remove_slabs, surely_fits
from phyradgs_cl.workflow.volumes import compared_states

log = logging.getLogger(__name__)
# A converged run with a large last residual (a fraction of the line integrals' norm) gives a warning.
_SETTLED = 5  # fewer recorded residuals show no convergence; the first is 1 unless the run begins with a given volume
_UNLIKELY = 0.15  # smaller residuals give no warning: correct scans had at most 0.13, besides noise
_AT_REST = 1.05  # converged: (residual after 3/4 of the iterations) / (last residual) is at most this
_BEYOND_NOISE = 1.5  # no warning if residual / noise is at most this; correct scans, even of 100 photons, had at most 1.1
_ALL_ROWS = Slabs()


class _Checkpoints:
    """Writes a run's checkpoints, at most every ``every_s`` seconds, never for 0; call it with each progress report. A
    killed run leaves its last complete checkpoint. A failure to write gives a warning, once, and no error."""

    def __init__(self, path: Path, every_s: float) -> None:
        self.path, self.every_s = path, every_s
        self.last_s = time.monotonic()
        self.has_failed = False
        self.iteration: int | None = None  # iteration of this run's last checkpoint

    def __call__(self, progress: methods.Progress) -> None:
        is_due = self.every_s > 0 and time.monotonic() - self.last_s >= self.every_s
        if is_due and progress.state is not None and progress.iteration < progress.iterations:
            self.write(progress.state(), progress.iteration)
            self.last_s = time.monotonic()

    def write(self, state: methods.State, iteration: int) -> None:
        try:
            write_checkpoint(self.path, state)
            self.iteration = iteration
        except OutputError as error:
            if not self.has_failed:
                log.warning("no checkpoint: %s", error)
            self.has_failed = True

    @contextmanager
    def mentioned_in_errors(self) -> Iterator[None]:
        """Makes errors say how to resume, if this run has written a checkpoint."""
        try:
            yield
        except PhyradgsError as error:
            if self.iteration is not None:
                way_on = f"--resume continues from iteration {self.iteration}"
                error.remedy = "; ".join(part for part in (error.remedy, way_on) if part)
            raise


@np.errstate(all="ignore")
def run_reconstruction(
    plan: methods.RunPlan, scan: Path, output: Path, make_runtime: Callable[[], Runtime],
    report: methods.ProgressReport = methods.ignore_progress, *, resume: bool = False,
    checkpoint_every_s: float = 600.0, inputs: Sequence[Path] = (), ranks: Communicator | None = None,
    slabs: Slabs = _ALL_ROWS,
) -> tuple[methods.Reconstruction, dict[str, float]]:
    """Reconstructs a scan file and writes a volume file; returns the result and its metrics.

    A parallel-beam scan is reconstructed in slabs of rows if ``slabs`` asks for them, or if four copies of its frames exceed
    half of this machine's memory.

    An interrupted run does not change ``output``. It writes ``io.partial_path`` and a checkpoint, from which ``resume``
    continues; a complete run removes both. A killed run leaves its last checkpoint. inputs: other files that the output
    must not overwrite. ranks: the runtime's MPI processes, of which only rank 0 writes and has metrics. Raises OutputError
    if the output cannot be written, BusyError while another run writes it, and InputError for a wrong scan, option or
    checkpoint."""
    checks.within("--checkpoint-every (seconds)", checkpoint_every_s, 0, 1e9)
    leads = ranks is None or ranks.rank == 0
    if leads:
        export = f"write volume.h5, then 'phyradgs export volume.h5 -o {plain_text(output.name)}'"
        check_output(output, scan, *inputs, remedy=export)
        refuse_overwriting("-o", partial_path(output), scan, *inputs)
    parts = _slabs_of(plan, slabs, scan, ranks)
    if resume and not parts:
        check_resumable(plan)
    with only_run(output) if leads else nullcontext():
        if parts:
            rt = make_runtime()
            with hashing(scan) as scan_hash_of:
                result = reconstruct_slabs(plan, scan, output, parts, rt, report, resume=resume)
                scan_hash = scan_hash_of()
            with signals.finish_despite_interrupt():
                write_volume(output, result.volume, result.grid, _provenance(result, scan_hash, plan, scan, rt))
            remove_slabs(output)
            return result, {}
        return _reconstructed(plan, scan, output, make_runtime, report, resume, checkpoint_every_s)


def _slabs_of(plan: methods.RunPlan, slabs: Slabs, scan: Path, ranks: Communicator | None) -> list[tuple[int, int]]:
    """Returns the slabs of a run; [] reconstructs the whole scan at once. Raises InputError for runs that need all rows."""
    if slabs == _ALL_ROWS and surely_fits(scan):
        return []
    with expecting(scan, "scan"):
        parts = slabs.of(read_scan_header(scan))
    finds = methods.method_of(plan.method).finds_motion
    if parts and (finds or plan.object_motion is not None):
        expected, remedy = "all rows at a time: the object does not rest", "leave --rows and --slab out"
        raise InputError(f"--method {plan.method_name}" if finds else "--object-motion", "slabs of rows", expected, remedy)
    if parts and plan.preprocessing.doubt:
        raise InputError("--doubt", "slabs of rows", "all rows at a time", "leave --rows and --slab out, or bin the scan")
    if parts and ranks is not None and ranks.size > 1:
        raise InputError("--rows", f"slabs on {ranks.size} ranks", "one rank", "run a slab of rows on each machine")
    return parts


def _reconstructed(
    plan: methods.RunPlan, path: Path, output: Path, make_runtime: Callable[[], Runtime],
    report: methods.ProgressReport, resume: bool, checkpoint_every_s: float,
) -> tuple[methods.Reconstruction, dict[str, float]]:
    with hashing(path) as scan_hash_of:
        scan = load_scan(path, plan.preprocessing.flats)
        scan_hash = scan_hash_of()
    check_scan(scan, plan)
    _warn_of_doubts(plan, path, scan)
    rt = make_runtime()
    leads, state = rt.ranks.rank == 0, None
    if resume:
        state = rt.ranks.bcast(read_checkpoint(checkpoint_path(output)) if leads else None)
    elif leads:
        _set_aside(output)
    checkpoints = _Checkpoints(checkpoint_path(output), checkpoint_every_s)

    def told(progress: methods.Progress) -> None:
        report(progress)
        checkpoints(progress)

    with checkpoints.mentioned_in_errors():
        result = methods.reconstruct(scan, plan, rt, report=told, resume=state)
        if not leads:
            return result, {}
        with signals.finish_despite_interrupt():
            metrics = _metrics(scan, result)
            target = output if result.state is None else partial_path(output)
            provenance = _provenance(result, scan_hash, plan, path, rt)
            parts = result.volume, result.grid, provenance, result.gaussians, metrics or None
            write_volume(target, *parts, deformation=result.deformation, states=result.states, doubt=result.doubt)
            _keep_checkpoint(output, result)
            _warn_of_residual(path, scan, result)
    return result, metrics


def _metrics(scan: Scan, result: methods.Reconstruction) -> dict[str, float]:
    """Returns the metrics against the scan's true volume, on the grid of ``metrics.aligned``, and metrics on held-out
    pixels. If the object moves or changes, they are means over the times of the scan's true volumes. Removes the held-out
    metrics from the result's facts, and adds there how volumes were compared, unless voxel by voxel."""
    held_out = result.facts.pop(HELD_OUT, {})
    if scan.reference is None:
        return held_out
    pair = aligned(result.volume, result.grid, scan.reference, scan.grid)
    if pair is None or not pair.reference.max() > 0:
        log.warning("no PSNR: nothing of the scan's reference lies in the volume's box")
        return held_out
    if scan.moving_truth is not None and result.moves is not None:
        moving = Volume(result.volume, result.grid, deformation=result.deformation, states=result.states)
        facts = compared_states(moving, scan.moving_truth, scan.grid)
        result.facts[COMPARED] = f"mean of {len(facts['states'])} states"
        return {**{name: facts[f"mean_{name}"] for name in METRICS}, **held_out}
    if pair.how != VOXEL_BY_VOXEL:
        result.facts[COMPARED] = pair.how
    return {**compare(pair.volume, pair.reference), **held_out}


def _warn_of_doubts(plan: methods.RunPlan, path: Path, scan: Scan) -> None:
    motion, preprocessing = getattr(plan.options, "motion", None), plan.preprocessing
    if scan.detector_model == "intensity" and motion is not None and not hasattr(plan.options, "detector_model"):
        cells = motion.cells(scan, 0)
        if cells.is_moving or cells.averages:  # otherwise nothing is averaged: both models agree
            text = "%s averages intensity over an exposure; --method %s averages line integrals"
            log.warning(text, path, plan.method_name)
    if scan.is_fly and isinstance(motion, MicroViews) and motion.strips > scan.lines:
        text = "%d strips are more than the %d lines of %s: one strip per line is the most there is"
        log.warning(text, motion.strips, scan.lines, path)
    grid = preprocessing.with_margin(scan.with_grid(preprocessing).grid)
    if grid != scan.grid and hasattr(plan.options, "iterations") and cuts(grid, scan.grid, scan.geometry):
        text = "%s: the grid ends inside the field of view, and --method %s puts the object beyond it into the grid; "
        has_margin, wider = preprocessing.margin_mm is not None, "if the object is larger still, widen --margin-mm"
        text += wider if has_margin else "--margin-mm reconstructs a margin, and discards it"
        log.warning(text, path, plan.method_name)
    late = np.flatnonzero(np.diff(scan.frame_start_s) <= 0)
    if scan.is_fly and late.size:
        text = "%s: frame %d starts no later than frame %d: check frame_start_time, and that frames are in order"
        log.warning(text, path, late[0] + 1, late[0])
    if not scan.projections.any():
        log.warning("%s: all line integrals are 0: there is no object in it", path)


def _warn_of_residual(path: Path, scan: Scan, result: methods.Reconstruction) -> None:
    """Warns if the iterations have converged to a volume whose residual is far above the scan's noise.

    Residuals of wrong scans (four objects of 32³, 25 views, default options): axis off by 2 pixels 0.25, by 10 pixels 0.6;
    flats of another scale 0.48 to 1; reversed angles 0.12 to 0.24; wrong units and orders 0.16 to 0.28."""
    residuals = [float(one.get("residual", 0.0)) for one in result.record]
    if len(residuals) < _SETTLED or (residual := residuals[-1]) <= _UNLIKELY:
        return
    if residuals[3 * len(residuals) // 4] > _AT_REST * residual:
        return
    valid = np.broadcast_to(scan.valid, scan.projections.shape)
    noise = noise_level(scan.projections, valid) / max(float(np.sqrt(np.square(scan.projections[valid]).mean())), 1e-30)
    if residual > _BEYOND_NOISE * noise:
        text = "%s: the volume does not explain %.0f %% of the line integrals, and their noise is %.2g %%: angles, axis, "
        text += "flats or grid are wrong; run 'phyradgs check' and see what it doubts"
        log.warning(text, path, 100 * residual, 100 * noise)


def _provenance(
    result: methods.Reconstruction, scan_hash: str, plan: methods.RunPlan, scan: Path, rt: Runtime
) -> dict[str, object]:
    return {
        **result.facts, "program": f"phyradgs-cl {__version__}", "python": platform.python_version(),
        "device": rt.device.name, "device_version": rt.device.version, "seed": plan.seed,
        "input": plan.preprocessing.facts(), "scan": str(scan), "scan_sha256": scan_hash,
        **(plan.initial.facts if plan.initial else {}), **(plan.object_motion.facts if plan.object_motion else {}),
        "record": result.record,
    }


def _set_aside(output: Path) -> None:
    """Renames an earlier run's checkpoint instead of overwriting it: it may hold hours of work."""
    checkpoint = checkpoint_path(output)
    if checkpoint.is_file():
        kept = former_checkpoint_path(output)
        os.replace(checkpoint, kept)
        remedy = "to go on from it, stop, rename it back and add --resume"
        log.warning("%s is of an earlier run and is kept as %s: %s", checkpoint, kept.name, remedy)


def _keep_checkpoint(output: Path, result: methods.Reconstruction) -> None:
    path = checkpoint_path(output)
    if result.state is None:
        for outdated in (path, partial_path(output)):
            with suppress(OSError):  # a file that stays is harmless: the volume is complete
                outdated.unlink()
    else:
        write_checkpoint(path, result.state)


def resume_or_restart(
    plan: methods.RunPlan, scan: Path, output: Path, make_runtime: Callable[[], Runtime],
    report: methods.ProgressReport = methods.ignore_progress, checkpoint_every_s: float = 600.0,
) -> tuple[methods.Reconstruction, dict[str, float]]:
    """Continues ``run_reconstruction`` from its checkpoint; starts again if there is none that this run can use."""
    run = partial(run_reconstruction, plan, scan, output, make_runtime, report, checkpoint_every_s=checkpoint_every_s)
    checkpoint = checkpoint_path(output)
    if checkpoint.is_file() and methods.method_of(plan.method).is_resumable:
        try:
            return run(resume=True)
        except InputError as error:
            named = ("--resume", str(checkpoint))
            if error.subject not in named and not error.subject.startswith("checkpoint"):
                raise
    return run(resume=False)
