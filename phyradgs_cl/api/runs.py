"""Scans and volumes: read, written, simulated, reconstructed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api.devices import Device, runtime_of
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.io import read_scan, read_volume, write_scan, write_volume
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.prepare import DEFAULT_STEPS, flat_correction
from phyradgs_cl.reconstructors import (
    InputOptions,
    ProgressReport,
    Reconstruction,
    ignore_progress,
    input_options,
    method_options,
)
from phyradgs_cl.reconstructors import reconstruct as run_method
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.simulation import scanner_for, scanner_options, simulated_scan


def load_scan(path: str | Path, flats: str = "mean") -> Scan:
    """A scan file as line integrals, with the mean of its flats, or flats by ``time`` or ``pca`` (docs/prepare.md);
    InputError names what is wrong by its HDF5 path."""
    scan = read_scan(path, flat_correction(flats))
    return scan if flats == "mean" else replace(scan, provenance={**scan.provenance, "flats": flats})


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

    phantom: a name, or the path of a volume file (docs/formats.md). size: voxels along the longest side of grid and
    reference.
    detector: columns, rows in proportion. options: those of ``phyradgs simulate`` with underscores (views,
    exposure_deg, readout_ratio, start_deg, pulse, readout_axis, noise, dose, detector_model, peak, lag, jitter_deg, seed …).

    Raises InputError for what there is not, or what is out of range.
    """
    described = scanner_for(scanner, detector)
    chosen = scanner_options(described, protocol, **options)
    of = str(phantom) if phantom in PHANTOMS else load_attenuation(phantom)
    name = f"volume {phantom}"
    return simulated_scan(runtime_of(device), of, described, chosen, size=size, name=name)


def prepare(scan: Scan, steps: str = DEFAULT_STEPS, *, device: Device = None, **options: Any) -> Scan:
    """The scan without what the panel and the beam did to it, by the steps of docs/prepare.md, names with commas between.

    options: tables of the steps' own (``rings={"window": 11}``), and what else comes before every method. What each step did
    stands in the scan's provenance, under ``prepared``. Raises InputError for what is no step or option, or a scan that does
    not show what a step looks for.
    """
    return prepared(scan, input_options({"steps": steps, **options}), runtime_of(device))


def reconstruct(
    scan: Scan,
    method: str = "phyradgs",
    *,
    preset: str | None = None,
    grid: Grid | None = None,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    device: Device = None,
    **options: Any,
) -> Reconstruction:
    """The volume of a scan, by any method of docs/methods.md; ``options`` are the method's own, by name.

    ``grid``: its voxels, in place of the scan's; or ``size``, ``voxel_mm`` and ``roi_mm`` say what is to be different
    (docs/methods.md#the-grid).

    ``motion``, ``strips``, ``sub_intervals`` and so on choose the motion model; nested options are dicts
    (``control={"every": 50}``). The result has the volume (nz, ny, nx) in 1/mm and, of splats, the Gaussians in mm.

    Raises InputError for options that the method does not have, NumericalError where numbers overflow.
    """
    scan.check_timing()
    scan = scan if grid is None else scan.on_grid(grid)
    given = {f.name: options.pop(f.name) for f in fields(InputOptions) if f.name in options}
    chosen = method_options(method, preset, options)
    before = input_options(given)
    return run_method(scan, method, runtime_of(device), chosen, seed=seed, report=report, before=before)
