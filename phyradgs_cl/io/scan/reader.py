"""Reads scan files, which are NeXus NXtomo entries in HDF5, into a Scan of line integrals."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, PoseTable, Scan
from phyradgs_cl.acquisition.plausible import blur_facts
from phyradgs_cl.acquisition.scan import APPLIED, applied_facts
from phyradgs_cl.acquisition.slabs import slab
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Metal
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.deformation import read_moving_truth, read_reference
from phyradgs_cl.io.files import sha256_of
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.hdf5.datasets import ATTENUATION, read_array, read_grid, read_values
from phyradgs_cl.io.scan.header import ScanHeader, read_header

LARGEST_LINE_INTEGRAL = 1e6  # larger line integrals cannot be measured: a scan file must have none, and an import masks them
# Takes data (F, v, u), image_key (F,), quantity, and times or numbers of the frames (F,); returns line integrals (P, v, u)
# and a mask of bad pixels or None.
ToAttenuation = Callable[[np.ndarray, np.ndarray, str, np.ndarray], tuple[np.ndarray, np.ndarray | None]]


def read_scan_header(path: str | Path) -> Scan:
    """Reads and checks a scan file as ``read_scan``, but not its large arrays: projections are zeros that take no memory."""
    with open_hdf5(path) as source:
        return read_header(source).scan


def read_scan(path: str | Path, to_attenuation: ToAttenuation, rows: tuple[int, int] | None = None) -> Scan:
    """Reads a scan file. rows: the detector rows [first, stop) to read, of a parallel-beam scan only, whose grid stays
    whole; None reads all.

    to_attenuation: takes (data (F, v, u), image_key (F,), quantity, at (F,)) and returns line integrals (P, v, u) of the P
    projections. at: when frames were taken, see ``header.taken_at``. It also returns a mask (v, u) or (P, v, u) of unusable
    values, or None. It leaves flat, dark and invalid frames out. The scan has projections (P, v, u) float32 and a bool
    ``pixel_mask`` or None, from the file and the conversion; values that are not finite must be masked.

    Everything else is checked before the pixels are read. Raises InputError for a missing, damaged or incomplete file; its
    subject is "FILE:/hdf5/path"."""
    with open_hdf5(path) as source:
        header = read_header(source)
        lines = None if rows is None else slice(*rows)
        if rows is not None:
            header = replace(header, scan=slab(header.scan, *rows))
        mask = _read_mask(source, header, lines)
        reference = read_reference(source, header.entry) if header.has_reference else None
        has_states = header.states > 0 and rows is None  # a reconstruction of some rows is compared with one volume only
        moving = read_moving_truth(source, header.entry) if has_states else None
        metal, where = None, f"{header.entry}/{schema.METAL}"
        if source.optional_group(where) is not None:
            grid = read_grid(source, f"{where}/grid")
            metal = Metal(read_array(source, f"{where}/volume", grid.shape, ATTENUATION).astype(np.float32), grid)
        data = _read_frames(source, header, mask, lines)
    projections, bad = _convert(source.name(f"{header.entry}/{schema.DATA}"), header, data, to_attenuation)
    used = header.image_key == schema.PROJECTION
    stored_mask = mask[used] if mask is not None and mask.ndim == 3 else mask
    provenance = header.scan.provenance
    if header.quantity == "counts":
        stored = (int(np.count_nonzero(header.image_key == kind)) for kind in (schema.FLAT, schema.DARK))
        provenance = {**provenance, **applied_facts(*stored)}
    mask = united(stored_mask, bad)
    scan = replace(header.scan, projections=projections, pixel_mask=mask, provenance=provenance)
    return replace(scan, reference=reference, moving_truth=moving, metal=metal)


def scan_summary(path: str | Path, sha256: str | None = None) -> dict[str, object]:
    """Returns what 'phyradgs info' prints about a scan file. Checks all but its pixels. sha256: the file's, if known."""
    with open_hdf5(path) as source:
        header = read_header(source)
    scan, key = header.scan, header.image_key
    kinds = ("projections", "flats", "darks", "invalid")
    counts = {name: int(np.count_nonzero(key == number)) for number, name in enumerate(kinds)}
    if header.quantity == "attenuation":  # flats and darks have been applied, and the file has only their numbers
        applied = {name: scan.provenance.get(name) for name in APPLIED}
        counts |= {name: count for name, count in applied.items() if isinstance(count, int)}
    pulse: dict[str, object] = {}
    if scan.shutter.pulse_s is not None:
        pulse = dict(zip(("pulse_start_s", "pulse_length_s"), scan.shutter.pulse_s, strict=True))
        pulse["dark_lines"] = int(np.count_nonzero(scan.shutter.lit_share(scan.lines) == 0))
    return {
        "title": scan.title, **counts, "data": f"{header.data_type} {header.quantity}",
        "fly_scan": scan.is_fly, "trajectory": _trajectory_word(scan),
        **({"geometry": "parallel beam"} if scan.is_parallel else {}), **vars(scan.geometry),
        **_timing_facts(scan), "detector_model": scan.detector_model, **pulse,
        **({"lag": scan.lag} if scan.lag > 0 else {}),
        "pixel_mask": header.mask_shape is not None, "grid_shape": scan.grid.shape,
        "grid_voxel_size_mm": scan.grid.voxel_size_mm, "grid_stored": header.has_grid,
        "reference": header.has_reference, **({"true_states": header.states} if header.states else {}),
        **({"gating": "a phase" if scan.gating.is_phase else "a signal"} if scan.gating else {}),
        "sha256": sha256 or sha256_of(path),
    }


def _timing_facts(scan: Scan) -> dict[str, object]:
    """Returns exposure, readout and blur and, for a circular orbit, angles and the first frame's arcs in degrees. A
    stop-and-shoot scan without an exposure has no times: the starts of its frames only give their order."""
    shutter = scan.shutter
    facts: dict[str, object] = {}
    if scan.is_fly or shutter.exposure_s > 0:
        facts |= {"exposure_s": shutter.exposure_s, "readout_s": shutter.readout_s}
    if scan.is_fly:
        facts |= {"readout_axis": shutter.axis, "readout_direction": shutter.direction}
        facts["scan_s"] = float(np.ptp(scan.frame_start_s)) + shutter.span_s
        facts |= blur_facts(scan)
    if isinstance(scan.trajectory, CircularOrbit):
        orbit, last = scan.trajectory, scan.frames - 1
        ends = [float(orbit.angle_rad(f, scan.frame_start_s[f : f + 1])[0]) for f in (0, last)]
        facts["first_gantry_angle_deg"], facts["last_gantry_angle_deg"] = np.rad2deg(ends).tolist()
    if scan.is_fly and isinstance(scan.trajectory, CircularOrbit):
        marks_s = scan.frame_start_s[0] + np.array([0.0, shutter.exposure_s, shutter.span_s])
        first, closed, done = np.rad2deg(scan.trajectory.angle_rad(0, marks_s)).tolist()
        facts["exposure_arc_deg"], facts["span_arc_deg"] = closed - first, done - first
    return facts


def _trajectory_word(scan: Scan) -> str:
    if isinstance(scan.trajectory, PoseTable):
        return "pose table"
    if isinstance(scan.trajectory, CircularOrbit) and isinstance(scan.trajectory.kinematics, EncoderTable):
        return "encoder table"
    return "constant speed in each frame" if scan.is_fly else "one angle per frame"


def _read_mask(source: Hdf5Source, header: ScanHeader, rows: slice | None) -> np.ndarray | None:
    if header.mask_shape is None:
        return None
    address = f"{header.entry}/{schema.MASK}"
    mask = read_values(source, address, source.dataset(address), "biu", rows) != 0
    used = mask if mask.ndim == 2 else mask[header.image_key == schema.PROJECTION]
    if used.all() and rows is None:
        raise source.error(address, "every pixel masked", "at least one zero", "non-zero means: do not use")
    return mask


def _read_frames(
    source: Hdf5Source, header: ScanHeader, mask: np.ndarray | None, rows: slice | None
) -> np.ndarray:
    """Reads all stored frames (F, v, u), or their ``rows``. Raises InputError for unmasked NaN or infinity in valid
    frames."""
    address = f"{header.entry}/{schema.DATA}"
    data = read_values(source, address, source.dataset(address), rows=rows)
    if data.dtype.kind == "f":
        for frame in np.flatnonzero(header.image_key != schema.INVALID):
            bad = ~np.isfinite(data[frame])
            if mask is not None:
                bad &= ~(mask if mask.ndim == 2 else mask[frame])
            if bad.any():
                row, column = np.unravel_index(int(np.argmax(bad)), bad.shape)
                found = (
                    f"NaN or infinity in frame {frame} at ({row}, {column}), {int(bad.sum())} in this frame"
                )
                raise source.error(address, found, "finite values", "set them, or mark them in pixel_mask")
    return data


def _convert(
    subject: str, header: ScanHeader, data: np.ndarray, to_attenuation: ToAttenuation
) -> tuple[np.ndarray, np.ndarray | None]:
    valid = header.image_key != schema.INVALID
    if not valid.all():
        data = data[valid]
    try:
        projections, bad = to_attenuation(data, header.image_key[valid], header.quantity, header.taken_at[valid])
    except InputError as error:
        raise InputError(f"{subject} ({error.subject})", error.found, error.expected, error.remedy) from error
    if projections.shape != header.scan.projections.shape:
        raise InputError(subject, f"line integrals {projections.shape}", str(header.scan.projections.shape))
    checks.finite(subject, projections)
    largest = float(np.abs(projections).max())
    if largest > LARGEST_LINE_INTEGRAL:
        expected = f"at most {LARGEST_LINE_INTEGRAL:g}: nothing shines through more than some tens"
        raise InputError(subject, f"a line integral of size {largest:.6g}", expected, "check the quantity")
    return np.ascontiguousarray(projections, dtype=np.float32), bad


def united(mask: np.ndarray | None, bad: np.ndarray | None) -> np.ndarray | None:
    """Returns the union of two masks, each (v, u), (P, v, u) or None; ``mask`` itself if ``bad`` masks no pixel."""
    if bad is None or not np.any(bad):
        return mask
    return np.asarray(bad, bool) if mask is None else mask | np.asarray(bad, bool)
