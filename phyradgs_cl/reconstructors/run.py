"""Runs a plan on a scan: preprocessing, first volume, margin, held-out pixels, and the method."""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.motion import check_own_motion, with_times
from phyradgs_cl.errors import InputError, OutOfMemoryError, naming_host_memory
from phyradgs_cl.fields import Grid, Metal, triple
from phyradgs_cl.io.files import HOST_SHARE, free_bytes, host_bytes
from phyradgs_cl.metrics import resampled, shared_slices
from phyradgs_cl.prepare import PREPARED_KEY
from phyradgs_cl.prepare.step import with_masked
from phyradgs_cl.reconstructors.checkpoint import State, with_identity, without_identity
from phyradgs_cl.reconstructors.doubt import FEWEST_FRAMES, MEASURED, Doubter
from phyradgs_cl.reconstructors.method import METHODS, check_able, method_of
from phyradgs_cl.reconstructors.plan import InitialVolume, RunPlan, check_object_motion, preprocessing_of
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.reconstructors.projected import (
    FramePair,
    frame_pairs,
    held_out,
    holdout_errors,
    spread_frames,
)
from phyradgs_cl.reconstructors.result import (
    HELD_OUT,
    MARGIN_MM,
    Progress,
    ProgressReport,
    Reconstruction,
    ignore_progress,
    through,
)
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import each_warning_once

log = logging.getLogger(__name__)

# Largest number of volumes that each voxel method holds at one time, two of them for the intensity model (docs/large.md).
# Each method also holds _STACKS arrays of all frames, and needs a buffer as large as _ONE_BUFFER volumes.
_HELD = {"sirt": 8, "sart": 28, "os-sart": 28, "cgls": 11, "asd-pocs": 32, "fista-tv": 16}
_HELD |= {"fista": 20, "moving": 28, "changing": 22}
_STACKS, _ONE_BUFFER = 12, 3
_OF_OTHERS = 4  # number of volumes that any other method holds: its result, and copies while it is made, checked, written
_DEVICE_SHARE = 0.9  # fraction of the device's memory limit that a proposed --size may fill
_ROUND = 8  # a proposed --size is rounded down to a multiple of this


@each_warning_once()
def reconstruct(
    scan: Scan, plan: RunPlan, rt: Runtime, *, report: ProgressReport = ignore_progress,
    resume: State | None = None,
) -> Reconstruction:
    """Runs a plan on a scan and returns the result. resume: the state of an interrupted run of the same plan.

    The plan's first volume is resampled onto the scan's grid. Raises InputError for a scan or state that the plan cannot
    take, and OutOfMemoryError if the memory of the host or the device is too small."""
    run = _Prepared(scan, plan, rt, resume)
    method, state = method_of(plan.method), run.arguments.pop("resume", None)

    def once(visible: Scan, state: State | None, report: ProgressReport) -> Reconstruction:
        arguments = run.arguments if state is None else {**run.arguments, "resume": state}
        return method.run(visible, run.options, rt=rt, seed=plan.seed, report=report, **arguments)

    report = through(run.shown, report)
    with _naming_size_that_fits(rt, run.scan, plan), naming_host_memory():
        if plan.preprocessing.doubt:
            kind = "iterative" if hasattr(run.options, "iterations") else "analytic"
            if plan.method not in MEASURED:
                text = "error bars were measured for %s: those of %s may be far too narrow"
                text += "" if plan.preprocessing.holdout else "; --holdout 2 widens them in part"
                log.warning(text, ", ".join(MEASURED), plan.method)
            doubter = Doubter(rt, run.visible, run.scan, run.hidden, run.deformation, plan.seed, kind)
            result = doubter.run(once, report, state)
        else:
            result = once(run.visible, state, report)
    return run.finished(result)


def check_scan(scan: Scan, plan: RunPlan) -> None:
    """Raises InputError for a scan that the plan's method or its error bars cannot take. Logs no warnings."""
    method_of(plan.method).check(scan, plan.options)
    if plan.preprocessing.doubt and not hasattr(plan.options, "iterations") and scan.frames < FEWEST_FRAMES:
        raise InputError("--doubt", f"frames: {scan.frames}", f"{FEWEST_FRAMES} or more, two in each half", "leave it out")


class _Prepared:
    """A run that is ready for its method: ``scan`` after preprocessing, with its margin; ``visible``, that scan with its
    held-out pixels masked; the method's ``options`` and its further ``arguments``."""

    def __init__(self, scan: Scan, plan: RunPlan, rt: Runtime, resume: State | None) -> None:
        preprocessing, self.plan, self.rt = plan.preprocessing, plan, rt
        check_scan(scan, plan)
        if rt.ranks.size > 1:
            _check_ranks(plan.method_name, rt)
        if preprocessing.margin_mm is not None:
            _check_margin(plan)
        self.identity = cache(partial(plan.identity, scan))  # computed only when needed, because it reads all frames
        self.arguments: dict[str, Any] = {}
        if resume is not None:
            check_resumable(plan)
            self.arguments["resume"] = without_identity(resume, self.identity(), _with_defaults)
        self.scan = self.visible = prepared(scan, preprocessing, rt)
        self.scan.check_sight()
        check_own_motion(getattr(plan.options, "motion", None), self.scan)
        if plan.initial is not None:
            self.arguments["initial"] = _initial(plan, plan.initial, self.scan.grid)
        self.deformation = None if plan.object_motion is None else plan.object_motion.deformation
        if self.deformation is not None:
            check_object_motion(self.deformation, self.scan)
            self.arguments["deformation"] = self.deformation
        self.scan.warn_of_blind_places()
        self.scan.warn_of_negative_integrals()
        if self.scan.metal is not None and (self.deformation is not None or plan.method_name == "moving"):
            log.warning("metal: found and masked as in an object at rest, and this one moves: do not trust what is near it")
        self.options = plan.options
        # times per exposure depend on the object's speed, which ``moving`` finds only during its run
        if hasattr(self.options, "motion") and plan.method_name != "moving":
            motion = with_times(self.options.motion, self.scan, self.deformation)
            self.options = replace(self.options, motion=motion)
        self.hidden = held_out(self.scan, preprocessing.holdout) if preprocessing.holdout else None
        if self.hidden is not None:
            self.visible = with_masked(self.scan, self.hidden)
        self.box = None if preprocessing.margin_mm is None else preprocessing.of(scan.grid)

    def shown(self, progress: Progress) -> Progress:
        """Returns progress with the run's identity in its state, with frames, and with its volume without the margin."""
        progress = progress.mapped(state=lambda state: with_identity(state, self.identity()))
        if progress.volume is not None and self.rt.ranks.size == 1:  # ranks can project only together
            whole = cache(progress.volume)
            progress = replace(progress, volume=whole, frames=partial(self._pairs, progress, whole))
        box = self.box
        return progress if box is None else progress.mapped(volume=lambda volume, grid: _within(volume, grid, box))

    def _pairs(self, progress: Progress, volume: Callable[[], tuple[np.ndarray, Grid]], count: int) -> list[FramePair]:
        moves = progress.states() if progress.states is not None else progress.deformation or self.deformation
        return frame_pairs(self.rt, self.scan, *volume(), spread_frames(self.scan.frames, count), moves)

    def finished(self, result: Reconstruction) -> Reconstruction:
        """Returns the method's result without the margin, with its metal, the run's identity in its state, and facts."""
        if result.state is not None:
            result = replace(result, state=with_identity(result.state, self.identity()))
        if self.hidden is not None and self.rt.ranks.rank == 0:
            pairs = self.rt, self.scan, self.hidden, result.volume, result.grid
            result.facts[HELD_OUT] = holdout_errors(*pairs, result.moves or self.deformation)
        if self.scan.metal is not None:
            result = _with_metal(result, self.scan.metal)
        if PREPARED_KEY in self.scan.provenance:
            result.facts[PREPARED_KEY] = self.scan.provenance[PREPARED_KEY]
        if self.box is None:
            return result
        result.facts[MARGIN_MM] = self.plan.preprocessing.margin_mm
        return result.within(self.box)


def check_resumable(plan: RunPlan) -> None:
    """Raises InputError for a method without checkpoints."""
    check_able("--resume", plan.method, "is_resumable", "a method with checkpoints", "leave it out")


def _with_defaults(identity: dict[str, Any]) -> dict[str, Any]:
    """Returns an earlier run's identity, with the defaults of preprocessing options that its version did not have."""
    with suppress(InputError):  # an earlier version may have had options that this one lacks
        return {**identity, "input": preprocessing_of(identity["input"]).facts()}
    return identity


def _initial(plan: RunPlan, initial: InitialVolume, grid: Grid) -> np.ndarray:
    """Returns the first volume, resampled onto the scan's ``grid``. Raises InputError for a method that cannot start from a
    volume, and for a volume that does not meet the grid."""
    check_able("--initial", plan.method, "takes_initial", "a method that starts from a volume", "leave --initial out")
    if initial.grid == grid:
        return initial.values
    volume, share = resampled(initial.values, initial.grid, grid)
    if share == 0:
        box_mm = np.round(initial.grid.box_mm, 3).tolist()
        raise InputError("--initial", f"a volume in {box_mm} mm (z, y, x)", "one that meets the scan's grid")
    return volume


def _with_metal(result: Reconstruction, metal: Metal) -> Reconstruction:
    """Overwrites voxels of the result's volume and states with the metal that ``prepare`` found, and returns the result."""
    amount, _ = resampled((metal.values != 0).astype(np.float32), metal.grid, result.grid)
    values, _ = resampled(metal.values, metal.grid, result.grid)
    inside = amount >= 0.5
    of_metal = values[inside] / amount[inside]
    for volume in (result.volume, *(() if result.states is None else result.states.volumes)):
        volume[inside] = of_metal
    return result


def _check_margin(plan: RunPlan) -> None:
    """Raises InputError for a margin with a method in which the voxels of the margin do not affect the others."""
    if (way := getattr(plan.options, "extrapolate", None)) not in (None, "reprojected"):
        found = f"--method {plan.method_name} with extrapolate={way}, whose voxels do not depend on each other"
        remedy = "add --set extrapolate=reprojected, or leave it out"
        raise InputError("--margin-mm", found, "a method that explains frames by what is in the box", remedy)


def _within(volume: np.ndarray, grid: Grid, box: Grid) -> tuple[np.ndarray, Grid]:
    """Returns the part of a volume (nz, ny, nx) whose voxel centres lie in ``box``, and the part's grid; the whole volume if
    none do. The voxels may be coarser than those of ``box``."""
    if (part := shared_slices(grid, box)) is None:
        return volume, grid
    inner = volume[part]
    return inner, grid.part(triple(one.start for one in part), triple(inner.shape))


def _check_ranks(method: str, rt: Runtime) -> None:
    """Raises InputError for a method that ranks cannot share, and for ranks on different devices."""
    if method not in METHODS or not METHODS[method].is_shared:
        names = ", ".join(name for name, one in METHODS.items() if one.is_shared)
        found = f"{rt.ranks.size} ranks"
        raise InputError(f"--method {method}", found, f"one, or one of {names}", "start it without mpiexec")
    device, first = rt.device.name, rt.ranks.bcast(rt.device.name)
    if device != first:
        expected, remedy = f"that of rank 0, {first}", "choose devices of one kind with --device"
        raise InputError(f"device of rank {rt.ranks.rank}", device, expected, remedy)


@contextmanager
def _naming_size_that_fits(rt: Runtime, scan: Scan, plan: RunPlan) -> Iterator[None]:
    """Adds to an OutOfMemoryError the ``--size`` that would fit, if there is one, and the size of the grid with its margin.

    Raises OutOfMemoryError at once for a volume that this machine cannot hold."""
    size = _size_that_fits(rt, scan, plan.method_name, plan.options)
    try:
        volume_bytes, most_bytes = 4 * math.prod(scan.grid.shape), HOST_SHARE * host_bytes()
        if volume_bytes > most_bytes:
            voxels = "×".join(map(str, scan.grid.shape[::-1]))
            found = f"{voxels} voxels (x y z), {volume_bytes / 2**30:.3g} GiB in one volume"
            raise OutOfMemoryError("memory of this machine", found, f"at most {most_bytes / 2**30:.3g} GiB")
        yield
    except OutOfMemoryError as error:
        if 0 < size < max(scan.grid.shape):
            error.remedy = "; ".join(part for part in (error.remedy, f"--size {size} fits") if part)
        if plan.preprocessing.margin_mm is not None:
            voxels = " × ".join(map(str, scan.grid.shape[::-1]))
            error.remedy += f", as by a narrower --margin-mm (with it the grid has {voxels} voxels)"
        raise


def _size_that_fits(rt: Runtime, scan: Scan, method: str, options: Any) -> int:
    """Returns for how many voxels along the grid's longest side the memory is enough; 0 if this is unknown or none."""
    free, held = HOST_SHARE * free_bytes(), _HELD.get(method)
    voxels = (free - scan.projections.nbytes) / (4 * _OF_OTHERS)
    states = min(getattr(options, "states", 1), scan.frames)
    if held is not None:
        free = min(free, _DEVICE_SHARE * rt.ledger.limit_bytes)
        if hasattr(options, "prior"):
            from phyradgs_cl.reconstructors.voxels.priors import kind_of  # here, as it loads SciPy

            held += kind_of(options.prior).volumes
        voxels = (free - _STACKS * scan.projections.nbytes) / (4 * held * states)
        voxels = min(voxels, rt.device.largest_allocation_bytes / (4 * _ONE_BUFFER * states))
    if not 0 < voxels < math.inf:
        return 0
    size = int(max(scan.grid.shape) * (voxels / math.prod(scan.grid.shape)) ** (1 / 3))
    return size - size % _ROUND if size > 2 * _ROUND else size
