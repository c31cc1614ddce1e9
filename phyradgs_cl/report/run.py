"""Collects the content of a report: a volume, its scan, their comparison, and what each preprocessing step changed."""

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.motion import motion_from_facts
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.io import Volume, file_kind, read_deformation, read_volume, scan_summary, sha256_of
from phyradgs_cl.metrics import METRICS, aligned, compare
from phyradgs_cl.prepare.light import read_corrected
from phyradgs_cl.prepare.step import Facts
from phyradgs_cl.reconstructors import Preprocessing, preprocessing_of
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.preprocess import prepared, stages
from phyradgs_cl.reconstructors.projected import FramePair, frame_pairs, spread_frames
from phyradgs_cl.removed import REMOVED
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import plain_text

log = logging.getLogger(__name__)
_BINS = 80  # number of bars in histograms of line integrals
_NO_SCAN = "The scan {} was not found, or has changed since; --scan names it."
_NO_MOTION = "The motion of the object {} was not found, or has changed since: there are no computed projections, and no "
_NO_MOTION += "motion."
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Run:
    """A reconstruction, read from its volume file and, if it is found, its scan.

    - scan: on the volume's grid. scan_path: its file. scan_facts: what ``scan_summary`` says about the file.
    - reference (nz, ny, nx) 1/mm: the true volume, if it is on the volume's grid. metrics: by name. compared: how volume and
      true volume came onto one grid, in words.
    - notes: remarks for the reader of the page. deformation: how the object moved, if the run knew or found it."""

    path: Path
    stored: Volume
    scan: Scan | None = None
    scan_path: Path | None = None
    scan_facts: Mapping[str, object] = field(default_factory=dict)
    reference: np.ndarray | None = None
    metrics: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    compared: str = ""
    deformation: Deformation | None = None

    @property
    def motion(self) -> Motion | None:
        """The run's motion model, with the number of segments that it used; None if the provenance lacks it."""
        options = self.stored.provenance.get("options")
        table = options.get("motion") if isinstance(options, Mapping) else None
        if not isinstance(table, Mapping):
            return None
        segments = self.stored.provenance.get("segments")
        if table.get("name") == "exact" and isinstance(segments, int):
            table = {**table, "segments": segments}
        with suppress(InputError, TypeError):  # another version or program may have written the provenance
            return motion_from_facts(table)
        return None

    @property
    def preprocessing(self) -> Preprocessing:
        """The run's preprocessing of frames, without options that this version lacks; the default if it is unknown."""
        table = self.stored.provenance.get("input")
        with suppress(InputError):
            return preprocessing_of(_kept(table) if isinstance(table, Mapping) else {})
        return Preprocessing()

    @property
    def record(self) -> list[dict[str, float]]:
        """The convergence record as a list, reduced to finite numbers."""
        lines: Any = self.stored.provenance.get("record") or []
        return [{k: float(v) for k, v in line.items() if checks.is_number(v)} for line in lines]


def _kept(table: Mapping[str, Any], of: str = "") -> dict[str, Any]:
    """Returns ``table`` without the options that this version no longer has. of: the prefix of a nested table's names."""
    return {
        name: _kept(value, f"{name}.") if isinstance(value, Mapping) else value
        for name, value in table.items() if f"{of}{name}" not in REMOVED
    }  # fmt: skip


def load_run(path: Path, scan_path: Path | None = None) -> Run:
    """Reads a volume file and its scan: ``scan_path``, else the file that the provenance names, if it is unchanged.

    Raises InputError for anything but a volume file of phyradgs-cl, and for a ``scan_path`` that cannot be read."""
    kind = file_kind(path)
    if kind != "volume":
        raise InputError(str(path), f"a {kind}", "a volume of phyradgs-cl", "make one with 'phyradgs reconstruct'")
    notes: list[str] = []
    stored = read_volume(path)
    deformation, where = stored.deformation, (path, stored.provenance)
    if deformation is None and (moved := _named_file(*where, "object_motion", notes, _NO_MOTION)) is not None:
        deformation = read_deformation(moved)
    run = Run(path, stored, metrics=stored.metrics or {}, deformation=deformation)
    if scan_path is None and not (isinstance(name := stored.provenance.get("scan"), str) and name):
        notes.append("The volume file names no scan.")
    named = scan_path or _named_file(*where, "scan", notes, _NO_SCAN)
    if named is not None:
        run = _with_scan(run, named, scan_path is not None, notes)
    for note in notes:
        log.warning("%s: %s", path, note)
    return replace(run, notes=tuple(notes))


def _with_scan(run: Run, path: Path, is_given: bool, notes: list[str]) -> Run:
    """Returns the run with a scan file, compared with its true volume. Appends remarks to ``notes``. is_given: whether the
    user named the file. Raises InputError for a given file that is no scan."""
    kind = file_kind(path) if is_given else "scan"
    if kind != "scan":
        raise InputError(f"--scan {path}", f"a {kind}", "a scan")
    stored, grid = run.stored, run.stored.required_grid
    sha256 = stored.provenance.get("scan_sha256")
    facts = scan_summary(path, None if is_given else str(sha256))
    if sha256 is not None and facts["sha256"] != sha256:
        notes.append("The scan shown here is not the file that this volume was reconstructed from: its hash differs.")
    if run.preprocessing.margin_mm is not None:
        notes.append("The filled margin around the box is discarded: frames computed from the volume lack it.")
    scan = read_corrected(path, run.preprocessing.flats)
    run = replace(run, scan=scan.on_grid(grid), scan_path=path, scan_facts=facts)
    if scan.reference is None:
        return run
    pair = aligned(stored.values, grid, scan.reference, scan.grid)
    if pair is None or not pair.reference.max() > 0:
        notes.append("Nothing of the scan's reference lies in the volume's box: there is no PSNR.")
        return run
    if not run.metrics.keys() >= METRICS.keys():
        run = replace(run, metrics={**compare(pair.volume, pair.reference), **run.metrics})
    if pair.grid is not grid:
        notes.append("The scan's reference is on another grid than the volume: its slices are not shown.")
    return replace(run, compared=pair.how, reference=pair.reference if pair.grid is grid else None)


def _named_file(path: Path, provenance: Mapping[str, object], key: str, notes: list[str], missing: str) -> Path | None:
    """Returns the file that the provenance names under ``key``, from the current or the volume's folder, if it has the
    stored hash. Else returns None and, if it names one, appends ``missing`` with this name in place of {} to ``notes``."""
    name, sha256 = provenance.get(key), provenance.get(f"{key}_sha256")
    if not isinstance(name, str) or not name:
        return None
    for place in (Path(name), path.parent / name, path.parent / Path(name).name):
        with suppress(InputError):  # there may be no such file
            if sha256_of(place) == sha256 and (key != "scan" or file_kind(place) == "scan"):
                return place
    notes.append(missing.format(plain_text(name)))
    return None


def computed_views(run: Run, rt: Runtime, count: int) -> list[FramePair]:
    """Returns ``count`` preprocessed frames and those computed from the volume; [] if scan or object motion is missing."""
    lacks_motion = run.deformation is None and "object_motion" in run.stored.provenance
    if run.scan is None or count < 1 or lacks_motion:
        return []
    scan, volume = prepared(run.scan, run.preprocessing, rt), run.stored
    chosen = spread_frames(scan.frames, count)
    return frame_pairs(rt, scan, volume.values, volume.required_grid, chosen, volume.states or run.deformation)


@dataclass(frozen=True, eq=False)
class Change:
    """The effect of a preprocessing step.

    - numbers: facts that the step reports.
    - pairs: images before and after, by name: the frame (rows, columns) and the sinogram (frames, columns) that changed
      most, and the middle slice (y, x) by FDK.
    - counts (2, n): histograms of all line integrals, before and after, between ``edges`` (n + 1,)."""

    step: str
    numbers: Facts
    pairs: dict[str, tuple[Image, Image]]
    edges: NDArray[np.float64]
    counts: NDArray[np.int64]


def step_changes(run: Run, rt: Runtime) -> list[Change]:
    """Repeats the run's preprocessing on its scan, and returns the effect of each step."""
    if run.scan is None or not run.preprocessing.chosen:
        return []
    changes: list[Change] = []
    former: tuple[np.ndarray, Image] | None = None
    for name, scan, numbers in stages(run.scan, run.preprocessing, rt):
        middle = Grid((1, *scan.grid.shape[1:]), scan.grid.voxel_size_mm, scan.grid.offset_mm)
        now = scan.projections, static_fdk(rt, scan.on_grid(middle))[0]
        if former is not None:
            changes.append(_change(name, numbers, former, now))
        former = now
    return changes


def _change(name: str, numbers: Facts, former: tuple[np.ndarray, Image], now: tuple[np.ndarray, Image]) -> Change:
    (before, slice_before), (after, slice_after) = former, now
    moved = np.stack([np.abs(b - a).mean(axis=1) for b, a in zip(before, after, strict=True)])
    frame, row = int(np.argmax(moved.mean(axis=1))), int(np.argmax(moved.mean(axis=0)))
    pairs = {
        f"frame {frame}": (before[frame], after[frame]),
        f"sinogram of row {row}": (before[:, row], after[:, row]),
        "middle slice by fdk": (slice_before, slice_after),
    }
    low, high = np.percentile(np.stack([before, after]), [0.01, 99.99])
    edges = np.linspace(low, high if high > low else low + 1, _BINS + 1)
    counts = np.stack([np.histogram(frames, edges)[0] for frames in (before, after)])
    return Change(name, numbers, pairs, edges, counts)
