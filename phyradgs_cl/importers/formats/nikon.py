"""Scans of Nikon's XT H systems: a .xtekct file and 16-bit TIFFs of counts, corrected for darks and flats by the scanner.

Signs are as in the readers of CIL and TIGRE: row 0 on top, column 0 on the right seen from the source, a sample that turns
clockwise seen from above. ObjectOffsetX and DetectorOffsetX above 0 put the axis and the panel to the left, DetectorOffsetY
puts the panel up. Without it, the mean of CentreOfRotationTop and
CentreOfRotationBottom, measured on the panel, takes its place. ObjectRoll above 0 leans the axis' top to the right,
ObjectTilt above 0 towards the panel. Lengths are in mm, angles in degrees."""

import logging
import math
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.importers.angles import file_of_angles, measured_angles_rad, read_angles_rad
from phyradgs_cl.importers.assemble import RotaryStage, cone, scan_on_stage
from phyradgs_cl.importers.files import SafeFolder, checked_name
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.text import Settings, found_by, read_settings, say_missing, white_level
from phyradgs_cl.importers.tiff import read_numbered
from phyradgs_cl.io.hdf5.datasets import LENGTH

_log = logging.getLogger(__name__)
_ENDS = ("CentreOfRotationTop", "CentreOfRotationBottom")
_NAMES = (
    *("Name", "InputSeparator", "InputFolderName", "Projections", "WhiteLevel", "SrcToObject", "SrcToDetector"),
    *("DetectorPixelsX", "DetectorPixelsY", "DetectorPixelSizeX", "DetectorPixelSizeY", "DetectorOffsetX"),
    *("DetectorOffsetY", "InitialAngle", "AngularStep", "ObjectOffsetX", "ObjectRoll", "ObjectTilt", "Units", *_ENDS),
)
recognises = found_by((".xtekct",))
_MOST_FRAMES = 1_000_000  # a file that states more frames, rows or columns is damaged


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one .xtekct file and its TIFFs. ``path`` may also be the .xtekct file."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.only("description of the scan", ".xtekct")
    scan = read_settings(description, _NAMES)
    if LENGTH.factor((unit := scan.word("Units", default="mm")).lower()) != 1.0:
        raise scan.error("Units", repr(unit[:40]), "mm", "convert the lengths to mm")
    sizes = ("Projections", "DetectorPixelsY", "DetectorPixelsX")
    count, *panel = (scan.count(name, _MOST_FRAMES) for name in sizes)
    prefix = scan.word("Name", default="") + scan.word("InputSeparator", default="_")
    place, inside = folder, scan.word("InputFolderName", default="")  # ``inside`` is often on the scanner's disk only
    if (first := inside.replace("\\", "/").split("/")[0]) and folder.exists(first):
        place = SafeFolder(folder.root / checked_name(inside, scan.name("InputFolderName")))
    frames, at, said = read_numbered(place, prefix, (count, *panel), [*map(scan.name, sizes)], options, first=1)
    measured = file_of_angles(folder, description.stem, ".ang", "_ctdata.txt")
    names = {
        "source_to_axis_mm": scan.name("SrcToObject"), "source_to_detector_mm": scan.name("SrcToDetector"),
        "pixel_size_mm": f"{scan.name('DetectorPixelSizeX')}, DetectorPixelSizeY",
        "angles": str(measured or scan.name("AngularStep")),
    }  # fmt: skip
    stage = _stage(scan, (panel[0], panel[1]), options, names)
    angle_rad = options.gantry_sign("gantry") * options.angle_rad(len(at), lambda: _angles(scan, measured, count)[at])
    say_missing(scan, {"InitialAngle": "0", "ObjectTilt": "0", "Units": "mm"})
    remedy = f"correct it, or say {options.named('flat_value')}"
    is_stated = options.flat_value or options.quantity not in (None, "counts")
    white = None if is_stated else white_level(scan, "WhiteLevel", frames, remedy)
    turned = frames, ("top", "right"), angle_rad, at, names, said
    return scan_on_stage(stage, options, description, description.stem, *turned, flat_value=white)


def _angles(scan: Settings, measured: Path | None, count: int) -> np.ndarray:
    """Returns angles (count,) in rad, from the file ``measured`` if there is one, else in equal steps."""
    if measured is not None and not scan.has("AngularStep"):
        return read_angles_rad(measured, count, column=1)
    steps_rad = np.deg2rad(scan.number("InitialAngle", 0.0) + scan.number("AngularStep") * np.arange(count))
    return steps_rad if measured is None else measured_angles_rad(measured, steps_rad)


def _stage(scan: Settings, panel: tuple[int, int], options: ImportOptions, names: dict[str, str]) -> RotaryStage:
    lengths = partial(scan.length, "SrcToObject"), partial(scan.length, "SrcToDetector")

    def pitch_mm() -> tuple[float, float]:
        return scan.length("DetectorPixelSizeY"), scan.length("DetectorPixelSizeX")

    offset_mm = scan.position("DetectorOffsetY"), 0.0 - scan.position("DetectorOffsetX")
    geometry = cone(options, *lengths, panel, pitch_mm, offset_mm, names)
    if any(offset_mm) and options.detector_offset_mm is None:
        text = "%s %g, DetectorOffsetY %g: the panel's middle is %g mm right of the central ray and %g mm above; else say %s"
        stated = -offset_mm[1], offset_mm[0], offset_mm[1], offset_mm[0]
        _log.warning(text, scan.name("DetectorOffsetX"), *stated, options.named("detector_offset_mm"))
    top_mm, bottom_mm = (scan.position(name) for name in _ENDS)
    axis_mm, name = (top_mm + bottom_mm) / 2 / geometry.magnification, _ENDS[0]
    if scan.has("ObjectOffsetX"):
        axis_mm, name = scan.position("ObjectOffsetX"), "ObjectOffsetX"
    elif not any(map(scan.has, _ENDS)):
        say_missing(scan, {"ObjectOffsetX": f"the axis in the middle: {options.named('detector_offset_mm')}, or calibrate"})
    height_mm, width_mm = np.multiply(panel, geometry.pixel_size_mm)
    if abs(axis_mm * geometry.magnification + geometry.detector_offset_mm[1]) > width_mm / 2:
        found = f"{axis_mm:g} mm, {abs(axis_mm * geometry.magnification):.4g} mm from the middle of the panel"
        raise scan.error(name, found, f"an axis that the panel of {width_mm:.4g} mm sees")
    usual_deg = -math.degrees(math.atan2(top_mm - bottom_mm, height_mm))
    roll_deg, tilt_deg = (
        scan.number(name, usual, lowest=-45, highest=45) for name, usual in (("ObjectRoll", usual_deg), ("ObjectTilt", 0.0))
    )
    return RotaryStage(geometry, -axis_mm, math.radians(roll_deg), math.radians(tilt_deg))
