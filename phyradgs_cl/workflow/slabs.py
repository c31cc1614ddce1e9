"""Reconstructs a parallel-beam scan in slabs: some detector rows at a time are read, reconstructed and kept on disk.

A slab has the times of its rows: the motion model ``static`` takes the middle of their time, not of the whole frame's."""

import logging
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from phyradgs_cl import reconstructors as methods
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.slabs import (
    HALO_ROWS,
    check_has_slabs,
    check_rows,
    has_slabs,
    part_of,
    slices_of,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import read_scan_header
from phyradgs_cl.io.files import host_bytes
from phyradgs_cl.io.output import beside, written_beside
from phyradgs_cl.reconstructors.result import labelled, option_facts
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import each_warning_once
from phyradgs_cl.workflow.files import load_scan

log = logging.getLogger(__name__)
_HOST_SHARE = 0.5  # fraction of this machine's memory for a slab's frames and what methods compute from them
_COPIES = 4  # arrays of the frames' size that a method holds at a time


@dataclass(frozen=True)
class Slabs:
    """Which detector rows to reconstruct, and how many at a time. rows: [first, stop); None takes all. rows_at_a_time: 0
    takes stated ``rows`` at once; without stated ``rows`` it takes as many rows as fit into half of this machine's memory
    with four copies of their frames."""

    rows: tuple[int, int] | None = None
    rows_at_a_time: int = 0

    def of(self, scan: Scan) -> list[tuple[int, int]]:
        """Returns a scan's slabs [first, stop); [] reconstructs the whole scan at once. The scan's header is enough. Raises
        InputError for rows that the scan does not have, and for slabs of a cone beam."""
        rows, columns = scan.geometry.detector_shape
        first, stop = self.rows or (0, rows)
        at_a_time = self.rows_at_a_time
        if self.rows is None and not at_a_time:
            fit = int(_HOST_SHARE * host_bytes() / (_COPIES * 4 * scan.frames * columns))
            if fit >= rows or not has_slabs(scan):
                return []
            at_a_time = max(fit - 2 * HALO_ROWS, 1)
        if self.rows is None:
            check_has_slabs(scan, "--slab", str(at_a_time))
        check_rows(scan, first, stop)
        at_a_time = at_a_time or stop - first
        return [(a, min(a + at_a_time, stop)) for a in range(first, stop, at_a_time)]


def surely_fits(path: Path) -> bool:
    """Returns whether a file is so small that its frames surely fit into memory, even if its 2-byte counts become 4 bytes. A
    missing file counts as small, since reading it gives the right error."""
    return not path.is_file() or 2 * _COPIES * path.stat().st_size < _HOST_SHARE * host_bytes()


def rows_of(text: str) -> tuple[int, int]:
    """Parses detector rows [A, B) from "A:B". Raises InputError for other text."""
    first, colon, stop = text.partition(":")
    if not (colon and first.strip().isdigit() and stop.strip().isdigit()):
        raise InputError("--rows", repr(text), "A:B, the first detector row and the one after the last", "write 0:256")
    return int(first), int(stop)


@each_warning_once()
def reconstruct_slabs(
    plan: methods.RunPlan, path: Path, output: Path, slabs: list[tuple[int, int]], rt: Runtime,
    report: methods.ProgressReport, *, resume: bool,
) -> methods.Reconstruction:
    """Returns the volume of all slabs, memory-mapped from a file. Finished slabs are kept in a folder next to ``output``;
    with ``resume`` they are read from there. Raises InputError if these slabs are of another run, or see no slice of the
    grid, and KeyboardInterrupt if a slab is interrupted."""
    header = read_scan_header(path)
    grid = header.with_grid(plan.preprocessing).grid
    whole = header.on_grid(grid)
    plan = replace(plan, preprocessing=replace(plan.preprocessing, size=None, voxel_mm=None, roi_mm=None))
    store = _Store(output, f"{plan!r} {grid!r} {slabs!r} {path.resolve()} {path.stat().st_mtime_ns}", resume)
    parts: list[np.ndarray] = []
    facts: dict[str, object] = {}
    seconds, chosen = 0.0, []
    for number, (first, stop) in enumerate(slabs, 1):
        if (slices := slices_of(whole, first, stop)).start == slices.stop:
            continue
        chosen.append(slices)
        if (kept := store.slab(first, stop)) is None:
            label = f"slab {number} of {len(slabs)}, rows {first}:{stop}"
            result = _slab(plan, path, whole, (first, stop), rt, labelled(label, report))
            facts, seconds = result.facts, seconds + float(result.facts["seconds"])
            kept = store.keep(first, stop, result.volume)
        parts.append(kept)
    if not parts:
        raise InputError("--rows", f"{slabs[0][0]}:{slabs[-1][1]}", "rows that see a slice of the grid")
    of_rows = part_of(grid, slice(chosen[0].start, chosen[-1].stop))
    volume = store.joined(parts, of_rows.shape)
    about = {"method": plan.method_name, "options": option_facts(plan.options), "interrupted_at": None}
    return methods.Reconstruction(volume, of_rows, facts={**about, **facts, "seconds": seconds, "slabs": len(slabs)})


def _slab(
    plan: methods.RunPlan, path: Path, whole: Scan, rows: tuple[int, int], rt: Runtime, report: methods.ProgressReport
) -> methods.Reconstruction:
    """Reconstructs the slices that detector rows [first, stop) see, from these rows and ``HALO_ROWS`` more on each side."""
    count, (first, stop) = whole.geometry.detector_shape[0], rows
    near = max(first - HALO_ROWS, 0), min(stop + HALO_ROWS, count)
    scan = load_scan(path, plan.preprocessing.flats, near).on_grid(part_of(whole.grid, slices_of(whole, *rows)))
    if hasattr(plan.options, "iterations"):  # iterative methods need the slices of all rows that they read
        z_mm, *across_mm = np.broadcast_to(plan.preprocessing.margin_mm or 0.0, 3).tolist()
        margin_mm = (max(z_mm, HALO_ROWS * whole.geometry.pixel_size_mm[0]), *across_mm)
        plan = replace(plan, preprocessing=replace(plan.preprocessing, margin_mm=margin_mm))
    result = methods.reconstruct(scan, plan, rt, report=report)
    if result.facts.get("interrupted_at") is not None:
        log.warning("interrupted in rows %d:%d; the slabs before are kept: repeat with --resume to continue", first, stop)
        raise KeyboardInterrupt
    return result


class _Store:
    """The finished slabs of a run: .npy files in a folder next to the output. identity: a text about the run, stored with
    the slabs. Without ``resume``, earlier slabs are removed; with ``resume``, slabs of another run raise InputError."""

    def __init__(self, output: Path, identity: str, resume: bool) -> None:
        self.folder = beside(output, ".slabs")
        note = self.folder / "run.txt"
        if self.folder.exists() and not resume:
            shutil.rmtree(self.folder)
        self.folder.mkdir(exist_ok=True)
        if note.exists() and note.read_text(encoding="utf-8") != identity:
            expected = "slabs of the same scan, options and rows"
            raise InputError("--resume", f"other slabs in {self.folder}", expected, "leave --resume out to start anew")
        note.write_text(identity, encoding="utf-8")

    def slab(self, first: int, stop: int) -> np.ndarray | None:
        """Returns a slab (nz, ny, nx), memory-mapped from its file; None if it is not finished."""
        path = self.folder / f"{first}-{stop}.npy"
        return np.load(path, mmap_mode="r") if path.exists() else None

    def keep(self, first: int, stop: int, volume: np.ndarray) -> np.ndarray:
        """Writes a finished slab, and returns it memory-mapped, so that it takes no memory."""
        path = self.folder / f"{first}-{stop}.npy"
        with written_beside(path) as temporary, open(temporary, "wb") as file:
            np.save(file, volume)
        return np.load(path, mmap_mode="r")

    def joined(self, parts: list[np.ndarray], shape: tuple[int, int, int]) -> np.ndarray:
        """Joins all slabs to one volume (z, y, x), memory-mapped from a file."""
        volume = np.lib.format.open_memmap(self.folder / "volume.npy", "w+", np.float32, shape)
        return np.concatenate(parts, out=volume)


def remove_slabs(output: Path) -> None:
    """Removes a run's finished slabs; call it when the volume is written."""
    shutil.rmtree(beside(output, ".slabs"), ignore_errors=True)
