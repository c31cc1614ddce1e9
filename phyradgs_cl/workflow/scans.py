"""Writes scan files: simulated ones of a phantom or a volume, and scans corrected for effects of panel and beam."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import Scan
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


def phantom_of(name: str) -> str | EllipsoidPhantom:
    """Reads a phantom from a TOML file; returns a built-in phantom's name unchanged. Raises InputError for other names."""
    if name.endswith(".toml"):
        return load_beads(Path(name))
    if name not in PHANTOMS:
        remedy = suggest_name(name, PHANTOMS, "or give the path of a .toml file; voxels of a file are --volume")
        raise InputError("--phantom", checks.short_repr(name), f"one of {', '.join(PHANTOMS)}", remedy)
    return name


@np.errstate(all="ignore")  # overflow is found in the result and gives one error instead of many warnings
def run_simulation(
    output: Path, scanner: Scanner, options: SimulationOptions, rt: Runtime, report: Callable[[int, int], None], *,
    phantom: str | None = None, volume: Path | None = None, size: int | None = None, pixel_samples: int = 0,
    inputs: Sequence[Path] = (),
) -> Scan:  # fmt: skip
    """Simulates a scan, writes its file and returns it. phantom: a name or a TOML file. volume: a file to project instead
    of a phantom. size, pixel_samples: as in ``simulated_scan``. inputs: other files that must not be overwritten. Raises
    InputError and OutputError before any work."""
    if volume is not None and phantom is not None:
        raise InputError("--volume", f"given together with --phantom {phantom}", "one of the two")
    check_output(output, volume, *inputs, Path(phantom) if phantom and phantom.endswith(".toml") else None)
    with only_run(output):
        of: str | Volume | EllipsoidPhantom = phantom_of(phantom or "foot")
        if volume is not None:
            with expecting(volume, "plain-volume", "volume"):
                of = load_attenuation(volume)
        name = f"volume {volume}"
        scan = simulated_scan(
            rt, of, scanner, options, size=size, pixel_samples=pixel_samples, name=name, report=report
        )
        with finish_despite_interrupt():
            write_scan(output, scan)
        return scan


@np.errstate(all="ignore")
def run_preparation(
    source: Path, output: Path, options: Preprocessing, make_runtime: Callable[[], Runtime], config: Path | None = None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Applies the steps of ``options`` to the scan ``source``, and writes line integrals with bad pixels masked and
    interpolated. Returns what each step did, in order, which is in the file's provenance too, and the names of steps that
    had been applied before. Raises InputError and OutputError."""
    if not options.chosen and options.flats == "auto":
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
    before: Any = scan.provenance.get(PREPARED_KEY) or []
    done: Any = clean.provenance.get(PREPARED_KEY) or []
    return done[len(before) :], [step["step"] for step in before]
