"""From file to file: what the commands do between reading their options and printing their result."""

from __future__ import annotations

import hashlib
import json
import logging
import platform
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import PROTOCOLS, Protocol, Scan, make_protocol
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import (
    Scanner,
    check_writable,
    checkpoint_path,
    file_kind,
    load_scanner,
    read_checkpoint,
    read_scan,
    read_volume,
    scan_summary,
    sha256_of,
    volume_summary,
    with_detector_count,
    write_checkpoint,
    write_scan,
    write_volume,
)
from phyradgs_cl.metrics import compare, slices_png
from phyradgs_cl.phantoms import load_volume
from phyradgs_cl.reconstructors import (
    METHODS,
    InputOptions,
    ProgressReport,
    Reconstruction,
    State,
    method_options,
    reconstruct,
)
from phyradgs_cl.reconstructors.interrupt import InterruptedAfterwards, finish_despite_interrupt
from phyradgs_cl.resources import resource
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import Scene, SimulationOptions, phantom_scene, simulate, volume_scene

LARGEST_GRID, LARGEST_DETECTOR = 4096, 32_000
log = logging.getLogger(__name__)


def load_scan(path: str | Path) -> Scan:
    """A scan file as line integrals; see ``io.read_scan``."""
    return read_scan(path, counts_to_attenuation)


# --- simulate -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SimulationJob:
    """What to simulate: a phantom by name or a volume file, on which scanner, with how many pixels and voxels."""

    output: Path
    phantom: str | None = None
    volume: Path | None = None
    scanner: str = "r2"
    detector: int | None = None
    detector_offset_mm: tuple[float, float] | None = None
    size: int | None = None


def load_scanner_for(job: SimulationJob) -> Scanner:
    """The job's scanner with its own number of pixels and detector offset."""
    scanner = load_scanner(job.scanner, resource("data"))
    geometry = scanner.geometry
    if job.detector is not None:
        checks.within("--detector", job.detector, 1, LARGEST_DETECTOR)
        rows, columns = geometry.detector_shape
        other = max(1, round(job.detector * rows / columns))
        geometry = with_detector_count(geometry, other, job.detector)
    changes = {f.name: getattr(scanner, f.name) for f in fields(scanner)}
    if job.detector_offset_mm is not None:
        values = {f.name: getattr(geometry, f.name) for f in fields(geometry)}
        geometry = type(geometry)(**{**values, "detector_offset_mm": job.detector_offset_mm})
    return Scanner(**{**changes, "geometry": geometry})


def make_scan_protocol(name: str, scanner: Scanner, **changes: Any) -> Protocol:
    """A named protocol with the command's changes, and the scanner's readout and pulse where the command has none."""
    for key in ("readout_ratio", "pulse"):
        if changes.get(key) is None:
            changes[key] = getattr(scanner, key)
    return make_protocol(name, **changes)


def refuse_jitter(protocol: str, jitter_deg: float | None) -> None:
    """A gantry that stands does not wander. Arc and readout say which fly-scan's mid-window poses it stands at."""
    if jitter_deg and not PROTOCOLS[protocol].is_fly:
        remedy = "leave it out, or choose a fly-scan"
        raise InputError("--jitter-deg", f"{jitter_deg} with --protocol {protocol}", "0", remedy)


@np.errstate(all="ignore")  # what overflows is found in the result, and reported in one line
def run_simulation(
    job: SimulationJob,
    scanner: Scanner,
    options: SimulationOptions,
    rt: Runtime,
    report: Callable[[int, int], None],
) -> Scan:
    """Simulates and writes a scan file; everything is checked before any work."""
    if job.volume is not None:
        _refuse_overwriting("-o", job.output, job.volume)
    if job.scanner.endswith(".toml"):
        _refuse_overwriting("-o", job.output, Path(job.scanner))
    check_writable(job.output)
    scene = _scene(job, scanner, options, rt)
    scan = simulate(
        scene.source,
        scanner.geometry,
        scene.grid,
        options,
        reference=scene.reference,
        title=f"simulated scan of {scene.title}",
        report=report,
    )
    scan.provenance.update(program=f"phyradgs-cl {__version__}", simulated=scene.title, seed=options.seed)
    scan.provenance.update(noise=options.noise, dose=options.dose, electronic_noise=options.electronic_noise)
    with finish_despite_interrupt():
        write_scan(job.output, scan)
    return scan


def _scene(job: SimulationJob, scanner: Scanner, options: SimulationOptions, rt: Runtime) -> Scene:
    axis = options.readout_axis
    if job.size is not None:
        checks.within("--size", job.size, 1, LARGEST_GRID)
    if job.volume is not None and job.phantom is not None:
        raise InputError("--volume", f"given together with --phantom {job.phantom}", "one of the two")
    if job.volume is not None:
        return volume_scene(rt, str(job.volume), scanner.geometry, scanner.grid, job.size, axis)
    size = max(scanner.grid.shape) if job.size is None else job.size
    return phantom_scene(rt, job.phantom or "foot", scanner.geometry, scanner.grid, size, axis, options.seed)


# --- reconstruct --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReconstructionJob:
    """Which scan to reconstruct by which method into which file."""

    scan: Path
    output: Path
    method: str = "phyradgs"
    preset: str | None = None
    changes: Mapping[str, Any] | None = None
    seed: int = 0
    resume: bool = False
    config: Path | None = None
    before: InputOptions = InputOptions()


@np.errstate(all="ignore")
def run_reconstruction(
    job: ReconstructionJob, make_runtime: Callable[[], Runtime], report: ProgressReport
) -> tuple[Reconstruction, dict[str, float]]:
    """Reconstructs and writes a volume file; returns the result and its metrics where the scan has a reference.

    An interrupted run writes the volume as far as it got, and a checkpoint beside it that ``resume`` continues.
    """
    options = method_options(job.method, job.preset, job.changes)
    check_writable(job.output)
    _refuse_overwriting("-o", job.output, job.scan, *([job.config] if job.config else []))
    scan = load_scan(job.scan)
    scan.check_timing()
    if scan.detector_model == "intensity" and not hasattr(options, "detector_model"):
        log.warning(
            "%s averages intensity over an exposure; --method %s averages line integrals",
            job.scan,
            job.method,
        )
    if (largest := float(scan.projections.max())) <= 0:
        found = f"no line integral is above 0 (the largest is {largest + 0.0:g})"  # + 0.0 makes a 0 of a -0
        log.warning("%s: %s: there is no object in it, or the sign is wrong", job.scan, found)
    rt = make_runtime()
    scan_hash = sha256_of(job.scan)
    fingerprint = _fingerprint(scan_hash, job, options)
    extra: dict[str, Any] = {"before": job.before}
    if job.resume:
        extra["resume"] = _resumed(job, fingerprint)
    result = reconstruct(scan, job.method, rt, options, seed=job.seed, report=report, **extra)
    metrics = compare(result.volume, scan.reference) if scan.reference is not None else {}
    known = [InterruptedAfterwards] if result.state is not None else []  # told already, in the result
    with suppress(*known), finish_despite_interrupt():
        _write_result(job, result, metrics, _provenance(result, scan_hash, job, rt))
        _keep_checkpoint(job, result, fingerprint)
    return result, metrics


def _write_result(
    job: ReconstructionJob, result: Reconstruction, metrics: dict[str, float], provenance: dict[str, object]
) -> None:
    cloud = result.gaussians
    arrays = None
    if cloud is not None:
        names = ("mean", "scale", "quaternion", "density")
        arrays = {name: np.asarray(getattr(cloud, name), np.float32) for name in names}
    write_volume(job.output, result.volume, result.grid, provenance, arrays, metrics or None)


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
        "input": asdict(job.before),
        "scan": str(job.scan),
        "scan_sha256": scan_hash,
        "record": result.record,
    }


def _fingerprint(scan_hash: str, job: ReconstructionJob, options: object) -> str:
    text = json.dumps([scan_hash, job.method, repr(options), repr(job.before), job.seed])
    return hashlib.sha256(text.encode()).hexdigest()


def _resumed(job: ReconstructionJob, fingerprint: str) -> State:
    resumable = [name for name, method in METHODS.items() if method.is_resumable]
    if job.method not in resumable:
        raise InputError(
            "--resume", f"--method {job.method}", f"a method with checkpoints: {', '.join(resumable)}"
        )
    return read_checkpoint(checkpoint_path(job.output), fingerprint)


def _keep_checkpoint(job: ReconstructionJob, result: Reconstruction, fingerprint: str) -> None:
    path = checkpoint_path(job.output)
    if result.state is None:
        path.unlink(missing_ok=True)
    else:
        write_checkpoint(path, dict(result.state), fingerprint)


# --- evaluate -----------------------------------------------------------------------------------------------


@np.errstate(all="ignore")
def run_evaluation(volume_path: Path, reference_path: Path, picture: Path) -> dict[str, object]:
    """Compares a volume with a scan's reference or another volume and writes the picture of slices."""
    _refuse_overwriting("--picture", picture, volume_path, reference_path)
    if picture.suffix.lower() != ".png":
        raise InputError("--picture", str(picture), "a file name that ends in .png")
    check_writable(picture)
    stored = read_volume(volume_path)
    reference, grid = load_reference(reference_path)
    if grid is not None and not _same_grid(grid, stored.grid):
        raise InputError(str(reference_path), f"the grid {grid}", f"that of {volume_path}: {stored.grid}")
    if reference.shape != stored.volume.shape:
        raise InputError(
            str(reference_path), f"shape {reference.shape}", f"shape {stored.volume.shape} of {volume_path}"
        )
    metrics = compare(stored.volume, reference)
    title = f"{stored.provenance.get('method', 'volume')}: {volume_path.name}"
    with finish_despite_interrupt():
        slices_png(picture, stored.volume, reference, title)
    known = {
        key: stored.provenance[key] for key in ("method", "seconds", "gaussians") if key in stored.provenance
    }
    return {
        **metrics,
        **known,
        "volume": str(volume_path),
        "reference": str(reference_path),
        "picture": str(picture),
    }


def _refuse_overwriting(option: str, output: Path, *inputs: Path) -> None:
    """An output that is one of the inputs would destroy it."""
    for path in inputs:
        if Path(output).resolve() == Path(path).resolve():
            raise InputError(option, f"the input file {path} itself", "another file to write")


def load_reference(path: Path) -> tuple[np.ndarray, Grid | None]:
    """The reference in a scan, a volume file, or a bare /volume dataset (which has no grid)."""
    kind = file_kind(path)
    if kind == "scan":
        scan = load_scan(path)
        if scan.reference is None:
            raise InputError(
                f"{path}:/entry/phyradgs/reference/volume", "no reference", "a scan with a known truth"
            )
        return scan.reference, scan.grid
    if kind == "volume":
        stored = read_volume(path)
        return stored.volume, stored.grid
    from_file = _bare_volume(path)
    return from_file, None


def summary(path: Path) -> dict[str, object]:
    """Facts about a scan or volume file for people."""
    kind = file_kind(path)
    if kind == "scan":
        return {"kind": "scan", **scan_summary(path)}
    if kind == "volume":
        facts = volume_summary(path)
        provenance = dict(facts.pop("provenance", {}) or {})
        provenance.pop("record", None)
        options = provenance.pop("options", None)
        return {"kind": "volume", **facts, **_asked_for(options), **provenance}
    volume = _bare_volume(path)
    return {
        "kind": "bare volume",
        "shape": volume.shape,
        "minimum": float(volume.min()),
        "maximum": float(volume.max()),
    }


def _asked_for(options: object) -> dict[str, object]:
    """What a run was asked for, in words; the file has every option."""
    if not isinstance(options, Mapping):
        return {}
    told: dict[str, object] = {}
    motion = options.get("motion")
    if isinstance(motion, Mapping):
        strips, sub_intervals = motion.get("strips"), motion.get("sub_intervals")
        counts = {"micro-views": f" {strips} × {sub_intervals}", "per-row": f", {sub_intervals} times a line"}
        told["motion"] = f"{motion.get('name')}{counts.get(str(motion.get('name')), '')}"
    if "iterations" in options:
        told["iterations_asked"] = options["iterations"]
    return told


def _bare_volume(path: Path) -> np.ndarray:
    return load_volume(path).volume


def _same_grid(a: Grid, b: Grid) -> bool:
    close = np.allclose(a.voxel_size_mm, b.voxel_size_mm, rtol=1e-5)
    return a.shape == b.shape and close and np.allclose(a.offset_mm, b.offset_mm, atol=1e-5 * max(a.size_mm))
