"""From a phantom or volume to a scan file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import PROTOCOLS, Protocol, Scan, make_protocol
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import (
    Scanner,
    check_writable,
    load_scanner,
    only_run,
    with_detector_count,
    write_scan,
)
from phyradgs_cl.reconstructors.interrupt import (
    finish_despite_interrupt,
)
from phyradgs_cl.resources import resource
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import Scene, SimulationOptions, phantom_scene, simulate, volume_scene
from phyradgs_cl.workflow.files import expecting, refuse_overwriting

LARGEST_GRID, LARGEST_DETECTOR = 4096, 32_000


SMALLEST_PHANTOM = 2  # procedural phantoms are drawn on twice as many voxels, of which they need 4


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
    pixel_samples: int = 1


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


def refuse_noise_options(noise: str, given: Mapping[str, float | None]) -> None:
    """Photons and electronic noise that are stated mean something with a model of noise only."""
    stated = [f"{option} {value:g}" for option, value in given.items() if value is not None]
    if noise == "none" and stated:
        raise InputError(stated[0], "--noise none", "a model of noise with it", "add --noise tigre or beer")


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
        refuse_overwriting("-o", job.output, job.volume)
    if job.scanner.endswith(".toml"):
        refuse_overwriting("-o", job.output, Path(job.scanner))
    check_writable(job.output)
    with only_run(job.output):
        scene = _scene(job, scanner, options, rt)
        scene.warn_of_inverse_crime()
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
        scan.provenance.update(pixel_samples=job.pixel_samples)
        scan.provenance.update(
            noise=options.noise, dose=options.dose, electronic_noise=options.electronic_noise
        )
        with finish_despite_interrupt():
            write_scan(job.output, scan)
        return scan


def _scene(job: SimulationJob, scanner: Scanner, options: SimulationOptions, rt: Runtime) -> Scene:
    axis = options.readout_axis
    if job.size is not None:
        checks.within("--size", job.size, 1 if job.volume else SMALLEST_PHANTOM, LARGEST_GRID)
    if job.volume is not None and job.phantom is not None:
        raise InputError("--volume", f"given together with --phantom {job.phantom}", "one of the two")
    if job.volume is not None:
        where = (scanner.geometry, scanner.grid)
        with expecting(job.volume, "plain-volume", "volume"):
            return volume_scene(rt, str(job.volume), *where, job.size, axis, job.pixel_samples)
    size = max(scanner.grid.shape) if job.size is None else job.size
    where = (scanner.geometry, scanner.grid, size, axis, options.seed)
    return phantom_scene(rt, job.phantom or "foot", *where, job.pixel_samples)
