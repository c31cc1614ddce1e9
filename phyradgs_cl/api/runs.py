"""Scans and volumes: read, written, simulated, reconstructed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan, make_protocol
from phyradgs_cl.api.devices import Device, runtime_of
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import (
    Scanner,
    load_scanner,
    read_scan,
    read_volume,
    with_detector_count,
    write_scan,
    write_volume,
)
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.reconstructors import (
    InputOptions,
    ProgressReport,
    Reconstruction,
    ignore_progress,
    input_options,
    method_options,
)
from phyradgs_cl.reconstructors import reconstruct as run_method
from phyradgs_cl.resources import resource
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, volume_scene
from phyradgs_cl.simulation import simulate as run_simulation

_PROTOCOL_KEYS = ("views", "exposure_deg", "readout_ratio", "start_deg", "pulse")


def load_scan(path: str | Path) -> Scan:
    """A scan file as line integrals; InputError names what is wrong by its HDF5 path."""
    return read_scan(path, counts_to_attenuation)


def save_scan(path: str | Path, scan: Scan) -> None:
    """Writes a scan file, whole or not at all."""
    write_scan(path, scan)


def load_volume(path: str | Path) -> Reconstruction:
    """A volume file: volume (nz, ny, nx) in 1/mm, its grid, Gaussians, record and facts."""
    stored = read_volume(path)
    facts = dict(stored.provenance)
    record: Any = facts.pop("record", [])
    return Reconstruction(stored.volume, stored.grid, stored.gaussians, record, facts)


def save_volume(
    path: str | Path, result: Reconstruction, metrics: Mapping[str, object] | None = None
) -> None:
    """Writes a volume file, whole or not at all; ``metrics`` as from ``compare`` are kept with it."""
    facts = {**result.facts, "program": f"phyradgs-cl {__version__}", "record": result.record}
    write_volume(path, result.volume, result.grid, facts, result.gaussians, metrics)


def simulate(
    phantom: str | Path = "foot",
    *,
    scanner: str = "r2",
    protocol: str = "rapid",
    size: int = 64,
    detector: int | None = None,
    device: Device = None,
    **options: Any,
) -> Scan:
    """A fly-scan (or, with ``protocol="static"``, a stop-and-shoot scan) of a phantom, with its truth as reference.

    phantom: a name, or the path of a volume file. size: voxels along the longest side of grid and reference.
    detector: columns, rows in proportion. options: those of ``phyradgs simulate`` with underscores (views,
    exposure_deg, readout_ratio, start_deg, pulse, readout_axis, noise, dose, detector_model, peak, lag, jitter_deg, seed …).

    Raises InputError for what there is not, or what is out of range.
    """
    checks.within("size", size, 1, 4096)
    described = load_scanner(scanner, resource("data"))
    geometry = _with_detector(described.geometry, detector)
    timing = {key: options.pop(key) for key in _PROTOCOL_KEYS if key in options}
    chosen = _simulation_options(described, _protocol(protocol, described, timing), options)
    rt, axis = runtime_of(device), chosen.readout_axis
    if phantom in PHANTOMS:
        scene = phantom_scene(rt, str(phantom), geometry, described.grid, size, axis, chosen.seed)
    else:
        scene = volume_scene(rt, str(phantom), geometry, described.grid, size, axis)
    scene.warn_of_inverse_crime()
    title = f"simulated scan of {scene.title}"
    return run_simulation(scene.source, geometry, scene.grid, chosen, reference=scene.reference, title=title)


def _with_detector(geometry: ConeGeometry, columns: int | None) -> ConeGeometry:
    if columns is None:
        return geometry
    checks.within("detector", columns, 1, 32_000)
    rows, present = geometry.detector_shape
    return with_detector_count(geometry, max(1, round(columns * rows / present)), columns)


def _protocol(name: str, scanner: Scanner, timing: Mapping[str, Any]) -> Protocol:
    """A named protocol; readout and pulse are the scanner's where nothing else is said."""
    own = {"readout_ratio": scanner.readout_ratio, "pulse": scanner.pulse}
    return make_protocol(name, **{**own, **timing})


def _simulation_options(scanner: Scanner, protocol: Protocol, given: Mapping[str, Any]) -> SimulationOptions:
    own = {name: getattr(scanner, name) for name in ("readout_axis", "readout_direction", "lag")}
    known = {f.name for f in fields(SimulationOptions)} - {"protocol"}
    if unknown := sorted(set(given) - known):
        names = ", ".join(sorted({*known, *_PROTOCOL_KEYS}))
        raise InputError(f"simulate: option {unknown[0]}", "no such option", f"one of {names}")
    return SimulationOptions(protocol=protocol, **{**own, **given})


def reconstruct(
    scan: Scan,
    method: str = "phyradgs",
    *,
    preset: str | None = None,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    device: Device = None,
    **options: Any,
) -> Reconstruction:
    """The volume of a scan, by any method of docs/methods.md; ``options`` are the method's own, by name.

    ``motion``, ``strips``, ``sub_intervals`` and so on choose the motion model; nested options are dicts
    (``control={"every": 50}``). The result has the volume (nz, ny, nx) in 1/mm and, of splats, the Gaussians in mm.

    Raises InputError for options that the method does not have, NumericalError where numbers overflow.
    """
    scan.check_timing()
    given = {f.name: options.pop(f.name) for f in fields(InputOptions) if f.name in options}
    chosen = method_options(method, preset, options)
    before = input_options(given)
    return run_method(scan, method, runtime_of(device), chosen, seed=seed, report=report, before=before)
