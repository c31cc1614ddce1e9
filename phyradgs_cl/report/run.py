"""What a report is about: a stored volume, the scan that it comes from, and how the two compare."""

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.motion import motion_from_facts
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import Volume, file_kind, read_scan, read_volume, scan_summary, sha256_of
from phyradgs_cl.metrics import METRICS, aligned, compare
from phyradgs_cl.prepare import flat_correction
from phyradgs_cl.reconstructors import Preprocessing, preprocessing_of
from phyradgs_cl.reconstructors.tune.trials import TUNED
from phyradgs_cl.reconstructors.tune.wish import is_told
from phyradgs_cl.text import plain_text

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Run:
    """A reconstruction and what is known of it. scan, scan_path, scan_facts: its scan, on the volume's grid, where found.
    reference (nz, ny, nx) 1/mm: the truth on that. metrics: by name. notes: what to know about the page itself. compared:
    how the metrics compare volume and truth; empty without a truth."""

    path: Path
    stored: Volume
    scan: Scan | None = None
    scan_path: Path | None = None
    scan_facts: Mapping[str, object] = field(default_factory=dict)
    reference: np.ndarray | None = None
    metrics: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    compared: str = ""

    @property
    def motion(self) -> Motion | None:
        """The motion model that the run used, with the segments that it chose, where its provenance says so."""
        options = self.stored.provenance.get("options")
        table = options.get("motion") if isinstance(options, Mapping) else None
        if not isinstance(table, Mapping):
            return None
        segments = self.stored.provenance.get("segments")
        known = {"segments": segments} if table.get("name") == "exact" and isinstance(segments, int) else {}
        try:
            return motion_from_facts({**table, **known})
        except (InputError, TypeError):  # of another version, or of another program
            return None

    @property
    def before(self) -> Preprocessing:
        """What was done to the frames first; nothing but what is usual where the provenance does not say."""
        return input_of(self.stored)

    @property
    def record(self) -> list[dict[str, float]]:
        """The convergence record: finite numbers only."""
        lines: Any = self.stored.provenance.get("record") or []
        return [{k: float(v) for k, v in line.items() if checks.is_number(v)} for line in lines]


    @property
    def tuned(self) -> Mapping[str, Any] | None:
        """How an option was chosen from the scan, where the provenance says it in numbers."""
        found: Any = self.stored.provenance.get(TUNED)
        return found if is_told(found) else None


def input_of(stored: Volume) -> Preprocessing:
    """What was done to the frames before a volume was made of them, as far as its provenance says."""
    table = stored.provenance.get("input")
    try:
        return preprocessing_of(dict(table)) if isinstance(table, Mapping) else Preprocessing()
    except InputError:
        return Preprocessing()


def load_run(path: Path, scan_path: Path | None = None) -> Run:
    """Reads a volume file and its scan: ``scan_path``, or the one that the provenance names if it is still the same.
    InputError: not a volume file of ours; a scan that is named and cannot be read."""
    if (kind := file_kind(path)) != "volume":
        remedy = "reconstruct one with 'phyradgs reconstruct'"
        raise InputError(str(path), f"a {kind}", "a volume of phyradgs-cl", remedy)
    notes: list[str] = []
    run = _found(path, read_volume(path), scan_path, notes)
    for note in notes:
        log.warning("%s: %s", path, note)
    return run


def _found(path: Path, stored: Volume, scan_path: Path | None, notes: list[str]) -> Run:
    found = scan_path or _scan_of(path, stored.provenance, notes)
    if found is None:
        return Run(path, stored, metrics=stored.metrics or {}, notes=tuple(notes))
    if scan_path is not None and (kind := file_kind(scan_path)) != "scan":
        raise InputError(f"--scan {scan_path}", f"a {kind}", "a scan")
    known = stored.provenance.get("scan_sha256")
    facts = scan_summary(found, str(known) if scan_path is None else None)
    if known is not None and facts["sha256"] != known:
        notes.append("The scan shown here is not the file that this volume was reconstructed from: its hash differs.")
    before = input_of(stored)
    if before.margin_mm is not None:
        notes.append("What the method filled beyond the box is discarded: frames computed from the volume lack it.")
    whole = read_scan(found, flat_correction(before.flats))
    whole = replace(whole, provenance={**whole.provenance, "flats": before.flats})
    scan = whole.on_grid(stored.required_grid)
    metrics: dict[str, object] = dict(stored.metrics or {})
    pair = None if whole.reference is None else aligned(stored.values, stored.required_grid, whole.reference, whole.grid)
    if whole.reference is not None and (pair is None or not pair.reference.max() > 0):
        notes.append("Nothing of the scan's reference lies in the volume's box: there is no PSNR.")
        pair = None
    if pair is None:
        return Run(path, stored, scan, found, facts, None, metrics, tuple(notes))
    if not metrics.keys() >= METRICS.keys():
        metrics = {**compare(pair.volume, pair.reference), **metrics}
    reference = pair.reference if pair.grid is stored.required_grid else None
    if reference is None:
        notes.append("The scan's reference is on another grid than the volume: its slices are not shown.")
    return Run(path, stored, scan, found, facts, reference, metrics, tuple(notes), pair.how)


def _scan_of(path: Path, provenance: Mapping[str, object], notes: list[str]) -> Path | None:
    """The file that the provenance names, from here or from beside the volume, if it has the hash that is kept."""
    named = provenance.get("scan")
    if not isinstance(named, str) or not named:
        notes.append("The volume file names no scan.")
        return None
    known = provenance.get("scan_sha256")
    for place in (Path(named), path.parent / named, path.parent / Path(named).name):
        with suppress(InputError):  # whatever else there is: it may be any file of this machine
            if file_kind(place) == "scan" and sha256_of(place) == known:
                return place
    notes.append(f"The scan {plain_text(named)} was not found, or has changed since; --scan names it.")
    return None
