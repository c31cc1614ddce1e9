"""To a scan file: from a phantom or a volume, and from a scan without the effects of panel and beam."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import PROTOCOLS, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import load_attenuation, load_beads
from phyradgs_cl.io import Scanner, Volume, hashing, only_run, write_scan
from phyradgs_cl.phantoms import PHANTOMS, EllipsoidPhantom
from phyradgs_cl.prepare import PREPARED_KEY, STEPS
from phyradgs_cl.reconstructors import Preprocessing
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.simulation import SimulationOptions, simulated_scan
from phyradgs_cl.text import suggest_name
from phyradgs_cl.workflow.files import check_output, expecting, load_scan

_TOML = ".toml"


@dataclass(frozen=True)
class SimulationJob:
    """What to simulate, a phantom by name or TOML file or a volume file, on which scanner; voxels and rays per pixel; the
    file of the object's motion, which must not be overwritten."""

    output: Path
    phantom: str | None = None
    volume: Path | None = None
    scanner: str = "r2"
    size: int | None = None
    pixel_samples: int = 0
    motion_of_object: Path | None = None


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


def phantom_of(name: str) -> str | EllipsoidPhantom:
    """A phantom from a TOML file; a name of one of ours as it is. InputError for neither."""
    if name.endswith(_TOML):
        return load_beads(Path(name))
    if name not in PHANTOMS:
        remedy = suggest_name(name, PHANTOMS, "or give the path of a .toml file; voxels of a file are --volume")
        raise InputError("--phantom", checks.short_repr(name), f"one of {', '.join(PHANTOMS)}", remedy)
    return name


@np.errstate(all="ignore")  # what overflows is found in the result, and reported in one line
def run_simulation(
    job: SimulationJob, scanner: Scanner, options: SimulationOptions, rt: Runtime,
    report: Callable[[int, int], None],
) -> Scan:
    """Simulates and writes a scan file; everything is checked before any work."""
    if job.volume is not None and job.phantom is not None:
        raise InputError("--volume", f"given together with --phantom {job.phantom}", "one of the two")
    described = [Path(name) for name in (job.scanner, job.phantom or "") if name.endswith(_TOML)]
    described += [] if job.motion_of_object is None else [job.motion_of_object]
    check_output(job.output, job.volume, *described)
    with only_run(job.output):
        of: str | Volume | EllipsoidPhantom = phantom_of(job.phantom or "foot")
        if job.volume is not None:
            with expecting(job.volume, "plain-volume", "volume"):
                of = load_attenuation(job.volume)
        name = f"volume {job.volume}"
        scan = simulated_scan(
            rt, of, scanner, options, size=job.size, pixel_samples=job.pixel_samples, name=name, report=report
        )
        with finish_despite_interrupt():
            write_scan(job.output, scan)
        return scan


@np.errstate(all="ignore")
def run_preparation(
    source: Path, output: Path, options: Preprocessing, make_runtime: Callable[[], Runtime], config: Path | None = None
) -> list[dict[str, Any]]:
    """Writes the scan ``source`` after the steps of ``options`` as line integrals; says what each did, in order. The file
    says the same, and of which scan. Bad pixels are masked and filled in. Raises InputError and OutputError as any run."""
    if not options.chosen and options.flats == "mean":
        raise InputError("--steps", "none", f"some of {', '.join(STEPS)}", "leave it out for the usual ones")
    options.check_written()
    check_output(output, source, config)
    with only_run(output):
        with hashing(source) as hash_of:
            scan = load_scan(source, options.flats)
            origin = {"prepared_from": str(source), "prepared_from_sha256": hash_of()}
        origin["prepared_by"] = f"phyradgs-cl {__version__}"
        clean = prepared(scan, options, make_runtime())
        with finish_despite_interrupt():
            write_scan(output, replace(clean, provenance={**clean.provenance, **origin}))
    step_facts: Any = clean.provenance.get(PREPARED_KEY, [])
    return list(step_facts)
