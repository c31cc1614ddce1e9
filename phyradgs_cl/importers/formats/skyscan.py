"""Scans of Bruker's SkyScan systems: a .log file and 16-bit TIFFs, flat-field corrected by the scanner.

The maker publishes no description of the log. Distances and pixels are read as in TIGRE. A pixel of the camera is Image
Pixel Size times the magnification; X/Y Ratio is its width over its height. The central ray falls on the row Optical Axis,
counted from the bottom. Row 0 is on top, column 0 on the right seen from the source. The log writes CC for a sample that
turns counterclockwise seen from above. The log does not state the column of the axis."""

import logging
import re
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers import text as settings
from phyradgs_cl.importers.assemble import RotaryStage, scan_on_stage
from phyradgs_cl.importers.files import SafeFolder, read_text
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.tiff import read_numbered
from phyradgs_cl.io.hdf5.datasets import LENGTH, TIME

_log = logging.getLogger(__name__)
_SEVERAL = ("Camera Offset", "Number of connected scans", "Number Of Horizontal Offset Positions")
_UNLIKE = 0.15  # Image Pixel Size may differ so much from Camera Pixel Size over the magnification: by 8 % in a SkyScan 1275
_RATIOS = ("Camera X/Y Ratio", "CameraXYRatio")
_NAMES = (
    *("Filename Prefix", "Number of Files", "Number of Rows", "Number of Columns", "Optical Axis (line)", *_RATIOS),
    *("Object to Source (mm)", "Camera to Source (mm)", "Image Pixel Size (um)", "Depth (bits)", "Exposure (ms)"),
    *("Rotation Step (deg)", "Rotation Direction", "Scanning Start Angle", "Scanning Trajectory", "Frame Averaging"),
    *("Reference Intensity", "Image Rotation", "Flat Field Correction", "Type of Detector Motion", "Type of Motion"),
    *("Random Movement", "Camera Pixel Size (um)", "Camera binning", *_SEVERAL),
)
_FIELDS = {
    "source_to_axis_mm": "Object to Source (mm)", "source_to_detector_mm": "Camera to Source (mm)",
    "exposure_s": "Exposure (ms)", "angles": "Rotation Step (deg)", "pixel_size_mm": "Image Pixel Size (um)",
}  # fmt: skip
recognises = settings.found_by((".log",), b"[system]", b"scanner=")
_OFF = re.compile(r"OFF( *\(.*\))?", re.I)  # the log may add the number that the setting would use: OFF (n)
_SENSES = {"CC": 1, "CCW": 1, "CW": -1, "C": -1}
_ASSUMED = {
    "Rotation Direction": "CC", "Optical Axis (line)": "the middle", "Scanning Start Angle": "0",
    "Exposure (ms)": "none", "Frame Averaging": "OFF", "Scanning Trajectory": "ROUND", "Flat Field Correction": "ON",
}  # fmt: skip


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one .log file and its TIFFs. ``path`` may also be the .log file in it."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.only("log of the scan", ".log")
    scan = settings.read_settings(description, _NAMES, sections=("System", "Acquisition"))
    sizes = ("Number of Files", "Number of Rows", "Number of Columns")
    count, rows, columns = (scan.count(name, 1_000_000) for name in sizes)
    if scan.word("Scanning Trajectory", default="ROUND").upper() != "ROUND":
        raise scan.error("Scanning Trajectory", scan.word("Scanning Trajectory")[:40], "ROUND, a circle")
    parts = scan.word("Filename Prefix"), (count, rows, columns), [scan.name(name) for name in sizes], options
    frames, at, said = read_numbered(folder, *parts, pattern=r"\d{4,8}")
    names = {field: scan.name(name) for field, name in _FIELDS.items()}
    geometry = _geometry(scan, (rows, columns), options, names)
    if options.detector_offset_mm is None:  # Postalignment is a setting of a reconstruction by the maker's program
        found = re.search(r"^Postalignment *= *(\S+)", read_text(description), re.M | re.I)
        place = f"not by Postalignment, {found[1][:20]}, whose sign is not documented; " if found else ""
        remedy = f"the middle of the panel; {place}check --fix-offset or calibrate find it"
        settings.say_missing(scan, {"place of the axis": remedy})
    if (sense := _SENSES.get(scan.word("Rotation Direction", default="CC").upper())) is None:
        raise scan.error("Rotation Direction", repr(scan.word("Rotation Direction")[:40]), "CC or CW")
    first_deg, step_deg = scan.number("Scanning Start Angle", 0.0), partial(scan.number, "Rotation Step (deg)")
    angle_rad = options.angle_rad(len(at), lambda: np.deg2rad(first_deg + step_deg() * at))
    angle_rad *= options.gantry_sign("sample") * sense
    settings.say_missing(scan, _ASSUMED)
    for name in [name for name in _SEVERAL if scan.has(name) and scan.word(name).upper() not in ("OFF", "0", "1")]:
        _log.warning("%s is %s: only the images of this log are read, as one scan", scan.name(name), scan.word(name)[:40])
    if not _OFF.fullmatch(movement := scan.word("Random Movement", default="OFF")):
        text = "%s is %s: the log states no shifts, so none are used; details blur where the scanner has not undone them"
        _log.warning(text, scan.name("Random Movement"), movement[:40])
    if roll_deg := scan.number("Image Rotation", 0.0):
        _log.warning("%s is %g° and not used: calibrate finds the panel's roll", scan.name("Image Rotation"), roll_deg)
    return scan_on_stage(
        RotaryStage(geometry), options, description, description.stem, frames, ("top", "right"), angle_rad, at, names, said,
        stored=_timing(scan, options), flat_value=_white(scan, frames, options),
    )  # fmt: skip


def _geometry(scan: settings.Settings, panel: tuple[int, int], options: ImportOptions, names: dict[str, str]) -> Geometry:
    to_axis_mm = options.taken("source_to_axis_mm", partial(scan.length, "Object to Source (mm)"))
    to_detector_mm = options.taken("source_to_detector_mm", partial(scan.length, "Camera to Source (mm)"))

    def stored_mm() -> tuple[float, float]:
        width_mm = scan.measured("Image Pixel Size (um)", LENGTH, "um") * (to_detector_mm / to_axis_mm)
        return width_mm / next((scan.length(name) for name in _RATIOS if scan.has(name)), 1.0), width_mm

    pitch_mm = options.taken("pixel_size_mm", stored_mm)
    if scan.has("Camera Pixel Size (um)") and options.pixel_size_mm is None:
        camera_mm = scan.measured("Camera Pixel Size (um)", LENGTH, "um")
        binned = re.match(r"\d+", scan.word("Camera binning", default="1"))
        if all(abs(pitch_mm[1] / (n * camera_mm) - 1) > _UNLIKE for n in (1, int(binned[0]) if binned else 1)):
            text = "%s and the distances make %.4g mm on the panel, where the camera's pixels are %.4g mm: else say %s"
            _log.warning(text, scan.name("Image Pixel Size (um)"), pitch_mm[1], camera_mm, options.named("pixel_size_mm"))
    # a cropped image may miss the central ray; a ray more than the image's height beyond its edge shows a wrong log
    up_mm = (panel[0] / 2 - scan.number("Optical Axis (line)", panel[0] / 2, -panel[0], 2 * panel[0])) * pitch_mm[0]
    return assemble.cone(options, to_axis_mm, to_detector_mm, panel, pitch_mm, (up_mm, 0.0), names)


def _timing(scan: settings.Settings, options: ImportOptions) -> assemble.StoredTiming:
    """Returns the log's exposure in s, summed over averaged frames. Leaves it out if the log has none, if an option replaces
    it, and if the scanner stopped for each frame and no option gives a frame time. Raises InputError for a Frame Averaging
    that is neither OFF nor ON with a count."""
    motion = next((scan.word(name) for name in ("Type of Detector Motion", "Type of Motion") if scan.has(name)), "")
    averaging = scan.word("Frame Averaging", default="OFF")
    averaged = re.fullmatch(r"ON *\(([1-9]\d{0,5})\)", averaging, re.I)
    if not averaged and not _OFF.fullmatch(averaging):
        raise scan.error("Frame Averaging", repr(averaging[:40]), "OFF, or ON and a count of frames, as ON (4)")
    stored_s = scan.measured("Exposure (ms)", TIME, "ms") if scan.has("Exposure (ms)") and not options.exposure_s else None
    if stored_s is None or ("STEP" in motion.upper() and options.frame_time_s is None):
        return assemble.StoredTiming()
    clock = f"a sample that never stopped ({motion}), but no time from frame to frame" if "CONT" in motion.upper() else ""
    return assemble.StoredTiming(exposure_s=stored_s * int(averaged[1] if averaged else 1), clock=clock)


def _white(scan: settings.Settings, frames: np.ndarray, options: ImportOptions) -> float | None:
    """Returns the counts of air: the option ``flat_value``, else Reference Intensity, else the largest that Depth (bits)
    allows; None if the options say that frames are no counts. Without ``flat_value``, raises InputError for frames (F, v, u)
    that are brighter than Reference Intensity, and for frames without flat-field correction."""
    remedy = f"say {options.named('flat_value')}"
    if options.quantity not in (None, "counts"):
        return None
    if not options.flat_value and scan.word("Flat Field Correction", default="ON").upper() == "OFF":
        raise scan.error("Flat Field Correction", "OFF", "frames that the scanner has corrected", remedy)
    if options.flat_value or scan.has("Reference Intensity"):
        return options.flat_value or settings.white_level(scan, "Reference Intensity", frames, f"correct it, or {remedy}")
    most = 2.0 ** int(scan.number("Depth (bits)", 16, 1, 32)) - 1
    settings.say_missing(scan, {"Reference Intensity": f"air at {most:.0f} counts; else {remedy}"})
    return most
