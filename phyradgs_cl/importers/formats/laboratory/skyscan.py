"""Scans of Bruker's SkyScan systems: a .log file and 16-bit TIFFs, flat-field corrected by the scanner.

The log has no description by its maker. Distances and pixels are as in TIGRE's reader: a pixel of the camera is Image
Pixel Size times the magnification, X/Y Ratio is its width over its height, and the central ray falls on the line Optical
Axis, counted from the bottom. So are row 0 on top, and with it column 0 on the right seen from the source for a sample that
turns counterclockwise seen from above, which the log calls CC. The log states no place of the axis across the panel."""

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.importers.assemble import StoredTiming, assemble_scan, cone, make_timing, turning
from phyradgs_cl.importers.options import OF_BARE_FRAMES, ImportOptions
from phyradgs_cl.importers.reading.files import SafeFolder
from phyradgs_cl.importers.reading.frames import gantry_sign, line_integrals, oriented
from phyradgs_cl.importers.reading.settings import head_has, read_settings, say_missing
from phyradgs_cl.importers.reading.tiff import read_series
from phyradgs_cl.io.tables import Fields

_log = logging.getLogger(__name__)
_RATIOS = ("Camera X/Y Ratio", "CameraXYRatio")
_NAMES = (
    *("Filename Prefix", "Number of Files", "Number of Rows", "Number of Columns", "Optical Axis (line)", *_RATIOS),
    *("Object to Source (mm)", "Camera to Source (mm)", "Image Pixel Size (um)", "Depth (bits)", "Exposure (ms)"),
    *("Rotation Step (deg)", "Rotation Direction", "Scanning Start Angle", "Scanning Trajectory", "Frame Averaging"),
    *("Reference Intensity", "Image Rotation", "Flat Field Correction", "Type of Detector Motion", "Type of Motion"),
)
_MOST = 1_000_000


def recognises(path: Path) -> bool:
    """True for a .log file of a SkyScan, and for a folder with one."""
    paths = SafeFolder(path).plain(".log") if path.is_dir() else [path]
    return any(file.suffix.lower() == ".log" and head_has(file, b"[system]", b"scanner=") for file in paths)


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one .log and its TIFFs, or the .log with the TIFFs in its folder."""
    options.refuse_unused("skyscan", OF_BARE_FRAMES)
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.only("log of the scan", ".log")
    scan = read_settings(description, _NAMES, sections=("System", "Acquisition"))
    count, rows, columns = (scan.count(f"Number of {what}", _MOST) for what in ("Files", "Rows", "Columns"))
    if scan.word("Scanning Trajectory", default="ROUND").upper() != "ROUND":
        raise scan.error("Scanning Trajectory", scan.word("Scanning Trajectory")[:40], "ROUND, a circle")
    frames = read_series(
        folder, str(scan.get("Filename Prefix")), (count, rows, columns), scan.name("Number of Files"), r"\d{4,8}"
    )
    geometry = _geometry(scan, (rows, columns), options)
    step_deg, first_deg = scan.number("Rotation Step (deg)"), scan.number("Scanning Start Angle", 0.0)
    sense = -1 if scan.word("Rotation Direction", default="CC").upper() in ("CW", "C") else 1
    angle_rad = gantry_sign(options, "sample") * sense * np.deg2rad(first_deg + step_deg * np.arange(count))
    timing = make_timing(str(description), count, options, _timing(scan, options))
    say_missing(scan, {"Rotation Direction": "CC", "Optical Axis (line)": "the middle"})
    if roll_deg := scan.number("Image Rotation", 0.0):
        _log.warning("%s is %g° and not used: calibrate finds the panel's roll", scan.name("Image Rotation"), roll_deg)
    combined = replace(options, flat_value=options.flat_value or _white(scan, options))
    turned = oriented(frames, options, "top", "right")
    integrals = line_integrals(str(description), turned, combined, convention="counts", is_corrected=True)
    parts = integrals, turning(geometry, angle_rad, timing), geometry, timing, options
    return assemble_scan(*parts, title=description.stem, source=str(path))


def _geometry(scan: Fields, panel: tuple[int, int], options: ImportOptions) -> Geometry:
    to_axis_mm, to_detector_mm = scan.length("Object to Source (mm)"), scan.length("Camera to Source (mm)")
    width_mm = scan.length("Image Pixel Size (um)") / 1000 * (to_detector_mm / to_axis_mm)
    ratio = next((scan.length(name) for name in _RATIOS if scan.has(name)), 1.0)
    pitch_mm = (width_mm / ratio, width_mm)
    up_mm = (panel[0] / 2 - scan.number("Optical Axis (line)", panel[0] / 2, -_MOST, _MOST)) * pitch_mm[0]
    if options.detector_offset_mm is None:
        text = "%s no place of the axis across the panel: taken in the middle; check --fix-offset or calibrate find it"
        _log.warning(text, scan.subject)
    return cone(options, to_axis_mm, to_detector_mm, panel, pitch_mm, (up_mm, 0.0))


def _timing(scan: Fields, options: ImportOptions) -> StoredTiming:
    """Returns the exposure of all averaged frames; none for a scanner that stopped for each and options without a rate."""
    motion = next((scan.word(name) for name in ("Type of Detector Motion", "Type of Motion") if scan.has(name)), "")
    if not scan.has("Exposure (ms)") or ("STEP" in motion.upper() and options.frame_time_s is None):
        return StoredTiming()
    averaged = re.fullmatch(r"ON \((\d{1,6})\)", scan.word("Frame Averaging", default=""))
    return StoredTiming(exposure_s=scan.length("Exposure (ms)") / 1000 * int(averaged[1] if averaged else 1))


def _white(scan: Fields, options: ImportOptions) -> float:
    """Returns the counts of air: Reference Intensity, else the largest number of Depth (bits)."""
    if scan.word("Flat Field Correction", default="ON").upper() == "OFF":
        remedy = f"say {options.named('flat_value')}"
        raise scan.error("Flat Field Correction", "OFF", "frames that the scanner has corrected", remedy)
    if scan.has("Reference Intensity"):
        return scan.length("Reference Intensity")
    bits = int(scan.number("Depth (bits)", 16, 1, 32))
    say_missing(scan, {"Reference Intensity": f"air at {2**bits - 1} counts; else say {options.named('flat_value')}"})
    return float(2**bits - 1)
