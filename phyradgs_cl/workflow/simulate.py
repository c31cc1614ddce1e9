"""From a phantom or volume to a scan file."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import PROTOCOLS, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import load_attenuation, load_beads
from phyradgs_cl.io import Scanner, Volume, check_writable, only_run, write_scan
from phyradgs_cl.phantoms import PHANTOMS, EllipsoidPhantom
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.simulation import SimulationOptions, simulated_scan
from phyradgs_cl.text import suggest_name
from phyradgs_cl.workflow.files import expecting, refuse_foreign_suffix, refuse_overwriting

_TOML = ".toml"


@dataclass(frozen=True)
class SimulationJob:
    """What to simulate, a phantom by name or TOML file or a volume file, on which scanner; voxels and rays per pixel."""

    output: Path
    phantom: str | None = None
    volume: Path | None = None
    scanner: str = "r2"
    size: int | None = None
    pixel_samples: int = 1


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
        remedy = suggest_name(name, PHANTOMS, "or give the path of a .toml file")
        raise InputError("--phantom", checks.short_repr(name), f"one of {', '.join(PHANTOMS)}", remedy)
    return name


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
        if job.phantom is not None:
            raise InputError("--volume", f"given together with --phantom {job.phantom}", "one of the two")
        refuse_overwriting("-o", job.output, job.volume)
    for described in (job.scanner, job.phantom or ""):
        if described.endswith(_TOML):
            refuse_overwriting("-o", job.output, Path(described))
    refuse_foreign_suffix(job.output)
    check_writable(job.output)
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
