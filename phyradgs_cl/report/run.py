"""What a report is about: a stored volume, the scan that it comes from, and how the two compare."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.motion import motion_from_facts
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import StoredVolume, file_kind, read_scan, read_volume, scan_summary, sha256_of
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import InputOptions, input_options

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Run:
    """A reconstruction with what is known about it.

    scan, scan_path, scan_facts: where the scan was found. reference (nz, ny, nx) 1/mm: the truth on the volume's grid.
    metrics: numbers by name. notes: what a reader should know about the page itself, a sentence each.
    """

    path: Path
    stored: StoredVolume
    scan: Scan | None = None
    scan_path: Path | None = None
    scan_facts: Mapping[str, object] = field(default_factory=dict)
    reference: np.ndarray | None = None
    metrics: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

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
    def before(self) -> InputOptions:
        """What was done to the frames first; nothing but what is usual where the provenance does not say."""
        table = self.stored.provenance.get("input")
        try:
            return input_options(dict(table)) if isinstance(table, Mapping) else InputOptions()
        except InputError:
            return InputOptions()

    @property
    def record(self) -> list[dict[str, float]]:
        """The convergence record: finite numbers only."""
        lines = self.stored.provenance.get("record")
        lines = lines if isinstance(lines, list) else []
        return [
            {k: float(v) for k, v in line.items() if _is_number(v)}
            for line in lines
            if isinstance(line, dict)
        ]


def load_run(path: Path, scan_path: Path | None = None) -> Run:
    """Reads a volume file and its scan: ``scan_path``, or the one that the provenance names if it is still the same.

    Raises:
        InputError: not a volume file of ours; a scan that is named and cannot be read.
    """
    if (kind := file_kind(path)) != "volume":
        remedy = "reconstruct one with 'phyradgs reconstruct'"
        raise InputError(str(path), f"a {kind}", "a volume of phyradgs-cl", remedy)
    notes: list[str] = []
    run = _found(path, read_volume(path), scan_path, notes)
    for note in notes:
        log.warning("%s: %s", path, note)
    return run


def _found(path: Path, stored: StoredVolume, scan_path: Path | None, notes: list[str]) -> Run:
    """The run with its scan; what is missing is told in ``notes``."""
    found = scan_path or _scan_of(path, stored.provenance, notes)
    if found is None:
        return Run(path, stored, metrics=stored.metrics or {}, notes=tuple(notes))
    if scan_path is not None and (kind := file_kind(scan_path)) != "scan":
        raise InputError(f"--scan {scan_path}", f"a {kind}", "a scan")
    facts = scan_summary(found)
    known = stored.provenance.get("scan_sha256")
    if known is not None and facts["sha256"] != known:
        notes.append(
            "The scan shown here is not the file that this volume was reconstructed from: its hash differs."
        )
    scan = read_scan(found, counts_to_attenuation)
    reference = _reference_of(scan, stored, notes)
    metrics = dict(stored.metrics or (compare(stored.volume, reference) if reference is not None else {}))
    return Run(path, stored, scan, found, facts, reference, metrics, tuple(notes))


def _scan_of(path: Path, provenance: Mapping[str, object], notes: list[str]) -> Path | None:
    """The file that the provenance names, from here or from beside the volume, if it has the hash that is kept."""
    named = provenance.get("scan")
    if not isinstance(named, str) or not named or "\0" in named:
        notes.append("The volume file names no scan.")
        return None
    known = provenance.get("scan_sha256")
    for place in (Path(named), path.parent / named, path.parent / Path(named).name):
        if place.is_file() and sha256_of(place) == known:
            return place
    notes.append(f"The scan {named} was not found, or has changed since; --scan names it.")
    return None


def _reference_of(scan: Scan, stored: StoredVolume, notes: list[str]) -> np.ndarray | None:
    if scan.reference is None or not float(scan.reference.max()) > 0:
        return None
    if not _same_grid(scan.grid, stored.grid):
        notes.append("The scan's reference is on another grid than the volume and is not shown.")
        return None
    return scan.reference


def _same_grid(a: Grid, b: Grid) -> bool:
    near_mm = 1e-5 * max(a.size_mm)
    close = np.allclose(a.voxel_size_mm, b.voxel_size_mm, rtol=1e-5)
    return a.shape == b.shape and close and np.allclose(a.offset_mm, b.offset_mm, atol=near_mm)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(abs(value) < 1e300)
