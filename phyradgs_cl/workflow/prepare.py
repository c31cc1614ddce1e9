"""From a scan file to a scan file without what the panel and the beam did to it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import check_writable, hashing, only_run, write_scan
from phyradgs_cl.prepare import PREPARED_KEY, STEPS
from phyradgs_cl.reconstructors import Preprocessing
from phyradgs_cl.reconstructors.frames.preprocess import prepared
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import load_scan, refuse_foreign_suffix, refuse_overwriting


@np.errstate(all="ignore")
def run_preparation(
    source: Path, output: Path, options: Preprocessing, make_runtime: Callable[[], Runtime], config: Path | None = None
) -> list[dict[str, Any]]:
    """Writes the scan ``source`` after the steps of ``options`` as line integrals; says what each did, in order. The file
    says the same, and of which scan. Bad pixels are masked and filled in. Raises InputError and OutputError as any run."""
    if not options.chosen and options.flats == "mean":
        raise InputError("--steps", "none", f"some of {', '.join(STEPS)}", "leave it out for the usual ones")
    options.check_written()
    refuse_foreign_suffix(output)
    refuse_overwriting("-o", output, source, *([config] if config else []))
    check_writable(output)
    with only_run(output):
        with hashing(source) as hash_of:
            scan = load_scan(source, options.flats)
            known = hash_of()
        clean = _named(prepared(scan, options, make_runtime()), source, known)
        with finish_despite_interrupt():
            write_scan(output, clean)
    told: Any = clean.provenance.get(PREPARED_KEY, [])
    return list(told)


def _named(scan: Scan, source: Path, known: str) -> Scan:
    """The scan with where it comes from."""
    origin = {"prepared_from": str(source), "prepared_from_sha256": known, "prepared_by": f"phyradgs-cl {__version__}"}
    return replace(scan, provenance={**scan.provenance, **origin})
