"""A method on a scan: what is done to the frames first, its start, its margin, and what is said of the result."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.motion import check_own_motion
from phyradgs_cl.errors import InputError, OutOfMemoryError, naming_host_memory
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.metrics import resampled, shared_slices
from phyradgs_cl.prepare import TOLD
from phyradgs_cl.prepare.masked import with_masked
from phyradgs_cl.reconstructors.frames.holdout import held_out, holdout_errors
from phyradgs_cl.reconstructors.frames.preprocess import InputOptions, prepared
from phyradgs_cl.reconstructors.options import method_options
from phyradgs_cl.reconstructors.registry import METHODS, method_name, method_of
from phyradgs_cl.reconstructors.result import (
    HELD_OUT,
    MARGIN_MM,
    Progress,
    ProgressReport,
    Reconstruction,
    ignore_progress,
)
from phyradgs_cl.reconstructors.room import naming_size_that_fits
from phyradgs_cl.reconstructors.tune.trials import tuned
from phyradgs_cl.runtime import Runtime


def reconstruct(
    scan: Scan,
    method: object,
    rt: Runtime,
    options: Any = None,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    before: InputOptions | None = None,
    initial: tuple[np.ndarray, Grid] | None = None,
    **extra: Any,
) -> Reconstruction:
    """Runs a method, by its name or a function of one's own; ``options`` as from ``method_options``, its default when None.

    ``before`` says what is done to the frames first; None undoes the scan's lag and filters nothing. ``initial``: a volume
    in 1/mm and its grid, from which a method starts that can; it is resampled onto the scan's.
    """
    asked = InputOptions() if before is None else before
    chosen = method_options(method, tune=asked.tune) if options is None else options
    if rt.ranks.size > 1:
        _check_ranks(method_name(method), rt)
    if asked.margin_mm is not None:
        _check_margin(method, chosen)
    ready = prepared(scan, asked, rt)
    ready.check_sight()
    check_own_motion(getattr(chosen, "motion", None), ready)
    if initial is not None:
        extra["initial"] = _initial(method, *initial, ready.grid)
    held = held_out(ready, asked.holdout) if asked.holdout else None
    seen = ready if held is None else with_masked(ready, held)
    run = partial(method_of(method).run, rt=rt, seed=seed)
    if asked.margin_mm is not None:
        report = _showing(asked.of(scan.grid), report)
    fitting = naming_size_that_fits(rt, ready, method_name(method), chosen)
    with _naming_margin(asked, ready.grid), fitting, naming_host_memory():
        if asked.tune:
            result = tuned(asked.tune, run, seen, chosen, rt, report, **extra)
        else:
            result = run(seen, chosen, report=report, **extra)
    if held is not None and rt.ranks.rank == 0:
        result.facts[HELD_OUT] = holdout_errors(rt, ready, held, result)
    if TOLD in ready.provenance:
        result.facts[TOLD] = ready.provenance[TOLD]
    if asked.margin_mm is None:
        return result
    result.facts[MARGIN_MM] = asked.margin_mm
    return result.within(asked.of(scan.grid))


def _initial(method: object, volume: np.ndarray, grid: Grid, onto: Grid) -> np.ndarray:
    """A first volume on the grid of the scan; InputError for a method that starts from none."""
    if not method_of(method).takes_initial:
        taking = ", ".join(name for name, one in METHODS.items() if one.takes_initial)
        raise InputError("--initial", f"--method {method_name(method)}", f"one of {taking}", "leave --initial out")
    if grid == onto:
        return volume
    first, share = resampled(volume, grid, onto)
    if share == 0:
        box_mm = np.round(grid.box_mm, 3).tolist()
        raise InputError("--initial", f"a volume in {box_mm} mm (z, y, x)", "one that meets the scan's grid")
    return first


def _check_margin(method: object, options: Any) -> None:
    """InputError where a method would do nothing with voxels beyond the box."""
    if (way := getattr(options, "extrapolate", None)) not in (None, "reprojected"):
        found = f"--method {method_name(method)} with extrapolate={way}, whose voxels do not depend on each other"
        remedy = "add --set extrapolate=reprojected, or leave it out"
        raise InputError("--margin-mm", found, "a method that explains frames by what is in the box", remedy)


def _showing(box: Grid, report: ProgressReport) -> ProgressReport:
    """A report whose volumes on the way are those of the box, as the result is."""

    def told(progress: Progress) -> None:
        volume = progress.volume
        report(progress if volume is None else replace(progress, volume=lambda: _within(*volume(), box)))

    return told


def _within(volume: np.ndarray, grid: Grid, box: Grid) -> tuple[np.ndarray, Grid]:
    """The voxels of a volume (nz, ny, nx), which may be coarser than the box, that lie in it."""
    if (part := shared_slices(grid, box)) is None:
        return volume, grid
    inner = volume[part]
    return inner, grid.part(triple(one.start for one in part), triple(inner.shape))


@contextmanager
def _naming_margin(asked: InputOptions, grid: Grid) -> Iterator[None]:
    """Where memory does not do, the body's error says what the margin has made of the grid."""
    try:
        yield
    except OutOfMemoryError as error:
        if asked.margin_mm is not None:
            voxels = " × ".join(map(str, grid.shape[::-1]))
            error.remedy += f", as by a narrower --margin-mm (with it the grid has {voxels} voxels)"
        raise


def _check_ranks(method: str, rt: Runtime) -> None:
    """InputError where the method has no work for several ranks, or ranks would not come to the same numbers."""
    if method not in METHODS or not METHODS[method].is_shared:
        sharing = ", ".join(name for name, one in METHODS.items() if one.is_shared)
        found = f"{rt.ranks.size} ranks"
        raise InputError(f"--method {method}", found, f"one, or one of {sharing}", "start it without mpiexec")
    device, first = rt.device.name, rt.ranks.bcast(rt.device.name)
    if device != first:
        subject = f"device of rank {rt.ranks.rank}"
        raise InputError(
            subject, device, f"that of rank 0, {first}", "choose devices of one kind with --device"
        )
