"""Reads, writes, simulates, prepares and reconstructs scans; reads and writes volumes and deformations."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from inspect import signature
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.exporters import CLOUDS, export_stored, foreign_suffix, format_of
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.importers import foreign_volume, load_attenuation, load_beads
from phyradgs_cl.importers import load_volume as load_voxels
from phyradgs_cl.io import read_deformation, write_deformation, write_scan
from phyradgs_cl.io.attenuation import attenuation_of, words_of_hu
from phyradgs_cl.io.volume import Volume, read_state, read_volume, write_volume
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.prepare import DEFAULT_STEPS
from phyradgs_cl.prepare.light import read_corrected
from phyradgs_cl.progress import Ticker, has_reader
from phyradgs_cl.reconstructors import DEFAULT_METHOD, ObjectMotion, Reconstruction, State, preprocessing_of
from phyradgs_cl.reconstructors import reconstruct as run_method
from phyradgs_cl.reconstructors.plan import InitialVolume, plan_run
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.reconstructors.result import ProgressReport, ignore_progress, interrupted
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import keep_finished_work
from phyradgs_cl.simulation import OPTION_NAMES, scanner_for, scanner_options, simulated_scan
from phyradgs_cl.text import suggest_name

Device = str | Runtime | None
"""The argument ``device`` of the API: what ``--device`` takes, or a Runtime."""


def runtime_of(device: Device) -> Runtime:
    """Returns the Runtime for the argument ``device``. None takes the device that ``--device`` takes by default."""
    if isinstance(device, Runtime):
        return device
    with _opening:
        return _runtime_by_name(None if device is None else str(device))


_opening = Lock()  # without it, threads that start together open a Runtime each, which refuse arrays of each other
_runtime_by_name = lru_cache(maxsize=4)(Runtime)  # keeps the Runtimes of four devices, so that kernels are built once


@naming_arguments()
def load_scan(path: str | Path, flats: str = "auto") -> Scan:
    """Reads a scan file (docs/formats.md): line integrals (F, rows, columns), lengths in mm, times in s.

    path: the HDF5 file. flats: how flat fields correct a frame, ``auto``, by their ``mean``, by ``time`` or by
    ``pca`` (docs/prepare.md). Raises InputError, which names the HDF5 path of the wrong value."""
    return read_corrected(_checked_path(path), flats)


def save_scan(path: str | Path, scan: Scan) -> None:
    """Writes a scan file, completely or not at all: line integrals (F, rows, columns), lengths in mm, times in s.

    path: the HDF5 file; an existing one is replaced. scan: a trajectory of your own class is sampled into a table of poses.
    Raises InputError for anything but a Scan, and a scan that the format cannot express; OutputError if writing fails."""
    check_scan(scan)
    write_scan(_checked_path(path), scan)


@naming_arguments()
def load_volume(path: str | Path, mu_water_per_mm: float | None = None) -> Reconstruction:
    """Reads a volume file: volume (nz, ny, nx) in 1/mm, grid, Gaussians, record, facts, state, deformation, states, doubt.
    Only an interrupted run has a state.

    path: the HDF5 file, or a file of ``phyradgs export`` (docs/export.md), which has only a volume and a grid.
    mu_water_per_mm: water's attenuation, for an exported file in Hounsfield units that does not state it. Raises InputError
    for a wrong value, which it names by its HDF5 path, for Hounsfield units without a scale, and for ``mu_water_per_mm``
    with a volume file, which is in 1/mm."""
    file = _checked_path(path)
    if foreign_volume(file) is not None:
        volume = attenuation_of(str(file), load_voxels(file, mu_water_per_mm))
        if volume.grid is None:
            raise InputError(str(file), "values without voxel sizes", "a volume with its grid in mm")
        words_of_hu({file: volume}, mu_water_per_mm)
        return Reconstruction(volume.values, volume.grid, facts={} if volume.scale is None else volume.scale.facts())
    if mu_water_per_mm is not None:
        raise InputError("--mu-water-per-mm", f"given for {file}, which is in 1/mm", "a file in Hounsfield units")
    stored = read_volume(file)
    facts = dict(stored.provenance)
    record: Any = facts.pop("record", [])
    of_file = stored.gaussians, record, facts, read_state(file), stored.deformation, stored.states, stored.doubt
    return Reconstruction(stored.values, stored.required_grid, *of_file)


@naming_arguments()
def load_deformation(path: str | Path) -> Deformation:
    """Reads the motion of an object from a deformation file (docs/formats.md), or from a scan that was simulated with one.

    path: the HDF5 file. Raises InputError, which names the HDF5 path, for a wrong value and for a motion that folds
    matter."""
    return read_deformation(_checked_path(path))


@naming_arguments()
def save_deformation(path: str | Path, deformation: Deformation) -> None:
    """Writes ``deformation``, how an object moves, to a file, completely or not at all.

    path: an HDF5 file, new or replaced. Raises InputError for anything but a Deformation, OutputError if writing fails."""
    checks.kind("deformation", deformation, Deformation, "a Deformation")
    write_deformation(_checked_path(path), deformation)


@naming_arguments()
def save_volume(
    path: str | Path, result: Reconstruction, metrics: Mapping[str, object] | None = None, hu: bool = False
) -> None:
    """Writes a volume file, completely or not at all: volume (nz, ny, nx) in 1/mm, lengths in mm.

    path: the HDF5 file; an existing one is replaced. The suffixes .nii, .mha, .nrrd, .tif and .npy write only the volume,
    .ply and .npz only the Gaussians, as ``phyradgs export`` does. result: what ``reconstruct`` returns; an interrupted run
    can be resumed from its file. metrics: what ``compare`` returns, stored too. hu: writes Hounsfield units to another
    format, by the scale of ``Reconstruction.hounsfield``; a volume file keeps 1/mm and stores the scale.

    Raises InputError for anything but a result, a suffix that cannot be written, ``hu`` without a scale or for Gaussians,
    and metrics for another format; OutputError if the file cannot be written."""
    checks.kind("result", result, Reconstruction, "a Reconstruction", "for an array, Reconstruction(volume, grid)")
    checks.flag("hu", hu)
    file = _checked_path(path)
    if hu and result.scale is None:
        raise InputError("hu", "a result without a scale", "a scale", "result.hounsfield(air, water) fits one")
    if foreign_suffix(file) is not None:
        checks.finite("volume", result.volume)
        if metrics is not None:
            raise InputError("metrics", f"some for {file.name}", "a file that has a place for them, as volume.h5")
        stored, form = Volume(result.volume, result.grid, {}, result.gaussians), format_of(file, "path")
        if hu and form in CLOUDS:
            raise InputError("hu", f"given for {file.name}", "a format of voxels", "leave it out: Gaussians stay in 1/mm")
        export_stored(stored, form, file, "result", (lambda _: result.scale) if hu else None)
        return
    facts = {**result.facts, "program": f"phyradgs-cl {__version__}", "record": result.record}
    others = result.deformation, result.states, result.doubt
    write_volume(file, result.volume, result.grid, facts, result.gaussians, metrics, result.state, *others)


@naming_arguments()
def simulate(
    phantom: str | Path = "foot", *, scanner: str = "r2", protocol: str = "rapid", size: int = 64,
    detector: int | None = None, detector_offset_mm: tuple[float, float] | None = None,
    truncation: float = 0.0, pixel_samples: int = 0, device: Device = None, **options: Any,
) -> Scan:
    """Simulates a fly-scan of a phantom, or with ``protocol="static"`` a stop-and-shoot scan, with its true ``reference``.

    phantom: a name, or the path of a volume file (docs/formats.md), (z, y, x) in 1/mm, or of a .toml of beads and wires.
    scanner: a name, or a TOML file. protocol: "rapid", "standard" or "static".
    size: voxels along the longest side of the grid, which the true volume shares. detector: columns; rows in proportion.
    detector_offset_mm: position of the panel's centre (v, u). truncation: fraction of the columns that are cut off, half at
    each side. pixel_samples: rays along each side of a pixel; 0 chooses them by the voxels' size. device: what
    ``--device`` takes, or a Runtime. options: of ``phyradgs simulate``, with underscores (views, exposure_deg,
    readout_ratio, start_deg, pulse, readout_axis, noise, dose, detector_model, peak, lag, jitter_deg, seed …).
    motion_of_object: an ``ObjectMotion``, or the path of its TOML file. The scan then has ``moving_truth``, the true volume
    at several times.

    Raises InputError for unknown names and for values out of range."""
    checks.kind("phantom", phantom, str | Path, "a name, or the path of a volume file", "save_volume writes one")
    unknown = sorted(set(options) - OPTION_NAMES)
    if unknown:
        names = [*list(signature(simulate).parameters)[1:-1], *sorted(OPTION_NAMES)]
        remedy = suggest_name(unknown[0], names, "")
        expected = "" if remedy else f"one of {', '.join(names)}"
        raise InputError(f"simulate: option {unknown[0]}", "no such option", expected, remedy)
    described = scanner_for(scanner, detector, detector_offset_mm, truncation)
    settings = scanner_options(described, protocol, **options)
    if isinstance(phantom, str) and phantom not in PHANTOMS and not Path(phantom).exists():
        expected = f"one of {', '.join(PHANTOMS)}, or a volume's file"
        remedy = suggest_name(phantom, PHANTOMS, "check the path")
        raise InputError("phantom", f"{phantom}, which is no file", expected, remedy)
    of: Any = str(phantom)
    if phantom not in PHANTOMS:
        of = load_beads(Path(phantom)) if of.endswith(".toml") else load_attenuation(phantom)
    rt, name = runtime_of(device), f"volume {phantom}"
    return simulated_scan(rt, of, described, settings, size=size, pixel_samples=pixel_samples, name=name)


@naming_arguments()
def prepare(scan: Scan, steps: str = DEFAULT_STEPS, *, device: Device = None, **options: Any) -> Scan:
    """Corrects a scan's line integrals (F, rows, columns), dimensionless, for effects of panel and beam.

    steps: names of steps in docs/prepare.md, with commas. device: what ``--device`` takes, or a Runtime. options: a step's
    options as a table (``rings={"window": 11}``), and other options of preprocessing. The scan's provenance lists under
    ``prepared`` what each step did. Raises InputError for unknown steps or options and a scan that a step cannot correct."""
    check_scan(scan)
    before = preprocessing_of({"steps": steps, **options})
    before.check_written()
    return prepared(scan, before, runtime_of(device))


@naming_arguments()
def reconstruct(
    scan: Scan, method: "str | Callable[..., Reconstruction | np.ndarray]" = DEFAULT_METHOD, *,
    preset: str | None = None, grid: Grid | None = None, seed: int = 0,
    report: "ProgressReport | bool" = True, resume: Reconstruction | None = None,
    initial: "Reconstruction | np.ndarray | None" = None, object_motion: Deformation | None = None,
    on_interrupt: str = "raise", device: Device = None, **options: Any,
) -> Reconstruction:
    """Reconstructs the volume (nz, ny, nx) of a scan in 1/mm, and with splats the Gaussians in mm.

    method: a name of docs/methods.md, "package.module:name", or your own function ``(scan, options, rt, ...)``
    (docs/api.md). options: the method's options by name. ``motion``, ``strips``, ``sub_intervals`` and so on choose the
    motion model; nested options are dicts (``control={"every": 50}``). preset: the name of the values that options replace.

    grid: the voxel grid; None takes the scan's. The options ``size``, ``voxel_mm`` and ``roi_mm`` change parts of it, and
    ``margin_mm`` adds a margin that is reconstructed and discarded (docs/methods.md#the-grid).

    holdout: percentage of the pixels that the method does not see; the result's facts have the error there
    (docs/methods.md#quality-without-a-truth).

    doubt: True also reconstructs two scans made from this one, which give the error bar σ (nz, ny, nx) in 1/mm of every
    voxel, the result's ``doubt`` (docs/methods.md#error-bars).

    seed: the seed of all random numbers; the same seed on the same device gives the same bits.

    report: a function that is called with each ``Progress``: after every iteration of voxels, and every 50 iterations or
    ten seconds of splats. True shows a line with rate and remaining time, in a terminal or a notebook; False shows nothing.
    A function that raises KeyboardInterrupt ends the run like Ctrl-C.

    resume: the partial result of an interrupted run with the same scan, options, seed and first volume.

    initial: the volume from which an iterative or splatting method starts. It is a result, which is resampled to the grid,
    or an array (nz, ny, nx) in 1/mm on the scan's grid.

    object_motion: how the object moves, for methods of voxels and fdk, relative to the resulting volume (docs/moving.md).

    on_interrupt: what Ctrl-C or a notebook's stop button does after the present iteration. "raise": a KeyboardInterrupt
    whose attribute ``partial`` is the result so far, or None. "return": returns that result.
    device: what ``--device`` takes, or a Runtime.

    Raises:
        InputError: options that the method does not have, or anything but a scan, method, grid or partial result.
        NumericalError: numbers overflow.
        KeyboardInterrupt: see ``on_interrupt``."""
    check_scan(scan)
    checks.kind("grid", grid, Grid | None, "a Grid, or None for the scan's")
    checks.kind("report", report, bool | Callable, "a function, True or False")
    checks.one_of("on_interrupt", on_interrupt, ("raise", "return"))
    scan.check_timing()
    scan = scan if grid is None else scan.on_grid(grid)
    plan = plan_run(method, options, preset=preset, seed=seed)
    if initial is not None:
        plan = replace(plan, initial=_first_volume(initial, scan.with_grid(plan.preprocessing).grid))
    if object_motion is not None:
        checks.kind("object_motion", object_motion, Deformation, "a Deformation")
        plan = replace(plan, object_motion=ObjectMotion(object_motion))
    state = None if resume is None else _state_of(resume)
    result: Reconstruction | None = None
    try:
        with _reporting(report) as (tell, end), keep_finished_work():
            result = run_method(scan, plan, runtime_of(device), report=tell, resume=state)
            if result.early_stop:
                end(f"{plan.method_name}{result.early_stop}")
    except KeyboardInterrupt as error:
        if result is None or on_interrupt == "raise":
            raise interrupted(result) from (error if result is None else None)
    if on_interrupt == "raise" and result.facts.get("interrupted_at") is not None:
        raise interrupted(result)
    return result


def _first_volume(initial: Reconstruction | np.ndarray, grid: Grid) -> InitialVolume:
    if isinstance(initial, Reconstruction):
        return InitialVolume(initial.volume, initial.grid)
    checks.kind("initial", initial, np.ndarray, "a Reconstruction, or an array (nz, ny, nx) in 1/mm")
    return InitialVolume(checks.numbers("initial", initial, grid.shape), grid)


def _checked_path(path: object) -> Path:
    if not isinstance(path, str | Path) or not str(path):
        raise InputError("path", checks.short_repr(path), "the name of a file")
    return Path(path)


def check_scan(scan: object, subject: str = "scan") -> None:
    checks.kind(subject, scan, Scan, "a Scan", "read a file with load_scan, or make one with fly_scan or static_scan")


@contextmanager
def _reporting(report: ProgressReport | bool) -> Iterator[tuple[ProgressReport, Callable[[str], None]]]:
    """Yields two functions: one to call with each ``Progress``, and one that ends the progress line with a text. The latter
    does nothing if no line is shown: if ``report`` is False or a user's function, or stderr is a file or a pipe."""
    if not isinstance(report, bool):
        yield report, lambda text: None
    elif not (report and has_reader()):
        yield ignore_progress, lambda text: None
    else:
        with Ticker("iteration") as ticker:
            ticker.stage("building kernels")
            yield ticker.progress, ticker.end


def _state_of(partial: object) -> State:
    if not isinstance(partial, Reconstruction) or partial.state is None:
        found = "a result that is complete" if isinstance(partial, Reconstruction) else checks.short_repr(partial)
        raise InputError("resume", found, "the partial result of an interrupted run")
    return partial.state
