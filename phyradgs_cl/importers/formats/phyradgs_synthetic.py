"""Synthetic folders of PhyRadGS: R2-Gaussian's layout, and for every frame the gantry angles of its first and last line. The
exposure takes ``exposure_s`` (1 s unless given). The gantry's speed is the arc of an exposure over that time."""

from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Scan, Shutter
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.assemble import Timing
from phyradgs_cl.importers.formats.r2_gaussian import META_WITH_TIMES, R2Folder, entries_of
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io.tables import Fields

OPTIONS = ("exposure_s", "readout_axis", "readout_direction", "unit_mm", "detector_model", "part")
_KEYS = ("first_line_start", "first_line_end", "last_line_end")
_SAME = 1e-3  # relative spread of arcs that still counts as one exposure and one readout


def recognises(path: Path) -> bool:
    """True for a folder with PhyRadGS's description, and for the description itself."""
    return (path / META_WITH_TIMES).exists() if path.is_dir() else path.name == META_WITH_TIMES


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder's ``simulate_train`` (or test, or all) frames, read out along columns unless the options differ."""
    options.refuse_unused("phyradgs", OPTIONS)
    opened = R2Folder.opened(path, META_WITH_TIMES, options.unit_mm)
    entries = entries_of(opened.meta, "simulate_", options.part)
    marks = np.array([[entry.number(key) for key in _KEYS] for entry in entries])
    timing = timing_of_marks(opened.meta, marks, options)
    sweeps = FrameSweeps(timing.start_s, timing.shutter.exposure_s, marks[:, 0], marks[:, 1])
    return opened.scan(path, entries, CircularOrbit(opened.geometry, sweeps), timing, options)


def timing_of_marks(subject: Fields, marks_rad: np.ndarray, options: ImportOptions) -> Timing:
    """Returns the timing from angles (F, 3): first line's start and end, last line's end. The first stored line is read
    first: column 0, or the top row in a readout along rows."""
    exposure_s = exposure_of_blurred_s(options)
    ratio = readout_ratio(subject.subject, marks_rad[:, 1] - marks_rad[:, 0], marks_rad[:, 2] - marks_rad[:, 1])
    axis = options.readout_axis or "columns"
    direction = options.readout_direction or (1 if axis == "columns" else -1)
    unstated = {"exposure": options.exposure_s, "axis": options.readout_axis, "first": options.readout_direction}
    assumed = tuple(name for name, value in unstated.items() if value is None)
    start_s = start_times_s(marks_rad[:, 0], marks_rad[:, 1], exposure_s)
    return Timing(Shutter(exposure_s, ratio * exposure_s, axis, direction), start_s, True, assumed=assumed)


def exposure_of_blurred_s(options: ImportOptions) -> float:
    """Returns the exposure in s of the options, or 1 s: the files do not state it."""
    exposure_s = 1.0 if options.exposure_s is None else options.exposure_s
    if exposure_s <= 0:
        raise InputError(options.named("exposure_s"), f"{exposure_s:g}", "a time above 0 s", "the frames are blurred")
    return exposure_s


def readout_ratio(subject: str, exposure_arc: np.ndarray, readout_arc: np.ndarray) -> float:
    """Returns T_ro/T_exp from the arcs (F,) of all frames. InputError where they differ."""
    if np.any(exposure_arc == 0) or np.any(np.sign(exposure_arc) != np.sign(exposure_arc[0])):
        found = f"arcs from {exposure_arc.min():.6g} to {exposure_arc.max():.6g} rad"
        raise InputError(f"{subject} exposure", found, "arcs that turn one way, none of them 0")
    ratio = readout_arc / exposure_arc
    if ratio.min() < 0 or np.ptp(ratio) > _SAME * max(1.0, ratio.max()):
        found = f"readout over exposure from {ratio.min():.6g} to {ratio.max():.6g}"
        raise InputError(f"{subject} readout", found, "one ratio of at least 0 for all frames")
    return float(np.median(ratio))


def start_times_s(first_rad: np.ndarray, closed_rad: np.ndarray, exposure_s: float) -> np.ndarray:
    """Returns opening times (F,) for a gantry that turns at the mean speed of its exposures."""
    speed_rad_per_s = float(np.mean(closed_rad - first_rad)) / exposure_s
    return (first_rad - first_rad[0]) / speed_rad_per_s
