"""Scans of Zeiss Xradia microscopes: a .txrm file, whose streams an OLE2 container holds.

As in the readers of DXchange, CIL and MBIRJAX: distances in mm without their signs, angles in degrees of a sample that turns
counterclockwise seen from above, row 0 the lowest, column 0 on the left. PixelSize in µm is a pixel's at the sample. Each
image is divided by the reference image. Alignment shifts, in columns and rows, move the images, and here the panel instead.
CenterShift is not used: calibrate finds the axis."""

import logging
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.options import OF_BARE_FRAMES, ImportOptions
from phyradgs_cl.importers.reading.frames import gantry_sign, line_integrals, oriented
from phyradgs_cl.importers.reading.ole import open_ole, read_images, read_stream
from phyradgs_cl.importers.reading.settings import say_missing
from phyradgs_cl.importers.stage import RotaryStage
from phyradgs_cl.io.tables import LARGEST, Fields

_log = logging.getLogger(__name__)
_INFO, _REFERENCE = "ImageInfo", "ReferenceData/Image"
_COUNTS = ("NoOfImages", "ImageHeight", "ImageWidth")
_REAL = ("PixelSize", "Angles", "StoRADistance", "DtoRADistance", "ExpTimes")
_STREAMS = {
    **{f"{_INFO}/{name}": "<i4" for name in (*_COUNTS, "DataType", "XrayGeometry")},
    **{f"{_INFO}/{name}": "<f4" for name in _REAL},
    "Alignment/X-Shifts": "<f4", "Alignment/Y-Shifts": "<f4", "ReconSettings/CenterShift": "<f4",
    "ReferenceData/DataType": "<i4",
}  # fmt: skip
_TYPES = {5: "<u2", 10: "<f4"}
_MOST_VALUES, _PER_FOLDER = 1 << 22, 100
_STEADY = 1e-3  # relative: how far the distances of single images may differ


def recognises(path: Path) -> bool:
    """True for a .txrm file."""
    return path.is_file() and path.suffix.lower() == ".txrm"


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the images of a .txrm file."""
    options.refuse_unused("zeiss", OF_BARE_FRAMES)
    with open_ole(path) as ole:
        stored = {name: dtype for name, dtype in _STREAMS.items() if ole.exists(name)}
        values = {name: read_stream(ole, path, name, dtype, _MOST_VALUES).tolist() for name, dtype in stored.items()}
        scan = Fields(f"{path}:", values)
        counts = (_first(scan, f"{_INFO}/{name}", 1, path.stat().st_size) for name in _COUNTS)
        count, rows, columns = map(int, counts)
        names = [f"ImageData{i // _PER_FOLDER + 1}/Image{i + 1}" for i in range(count)]
        frames, white = read_images(ole, path, names, _type(scan, f"{_INFO}/DataType"), (rows, columns)), None
        if ole.exists(_REFERENCE):
            white = read_images(ole, path, [_REFERENCE], _type(scan, "ReferenceData/DataType", 10), (rows, columns))
    angles = f"{_INFO}/Angles"
    angle_rad = gantry_sign(options, "sample") * options.angle_rad(count, lambda: np.deg2rad(_numbers(scan, angles, count)))
    in_file = assemble.names_in_file(options, {
        "source_to_axis_mm": scan.name(f"{_INFO}/StoRADistance"), "angles": scan.name(angles),
        "source_to_detector_mm": scan.name(f"{_INFO}/DtoRADistance"), "exposure_s": scan.name(f"{_INFO}/ExpTimes"),
        "pixel_size_mm": scan.name(f"{_INFO}/PixelSize"),
    })  # fmt: skip
    exposure_s = _first(scan, f"{_INFO}/ExpTimes", 0) if scan.has(f"{_INFO}/ExpTimes") else None
    timing = assemble.make_timing(str(path), count, options, assemble.StoredTiming(exposure_s=exposure_s or None))
    trajectory, geometry = _stage(scan, (count, rows, columns), options).turned(angle_rad, timing, str(path))
    flats = None if white is None else oriented(white, options, "bottom")
    turned = oriented(frames, options, "bottom")
    integrals = line_integrals(str(path), turned, options, flats=flats, convention="counts", is_corrected=True)
    parts = integrals, trajectory, geometry, timing, options
    return assemble.assemble_scan(*parts, title=path.stem, source=str(path), names=in_file)


def _type(scan: Fields, name: str, default: float | None = None) -> str:
    """Returns the type of an image's pixels; without a default the stream must be there."""
    number = _first(scan, name) if default is None or scan.has(name) else default
    if number not in _TYPES:
        raise scan.error(name, f"{number:g}", "5 (16 bits) or 10 (float32)")
    return _TYPES[int(number)]


def _stage(scan: Fields, shape: tuple[int, int, int], options: ImportOptions) -> RotaryStage:
    """Returns a stage whose panel is shifted in every image as the alignment says."""
    to_axis_mm, behind_mm = (_steady(scan, f"{_INFO}/{name}") for name in ("StoRADistance", "DtoRADistance"))
    is_cone = not scan.has(f"{_INFO}/XrayGeometry") or _first(scan, f"{_INFO}/XrayGeometry") == 1
    pixel_mm = _first(scan, f"{_INFO}/PixelSize", 1e-6, 1e6) / 1000
    say_missing(scan, {"Alignment/X-Shifts": "0", "Alignment/Y-Shifts": "0", f"{_INFO}/XrayGeometry": "a cone",
                       f"{_INFO}/ExpTimes": "none"})  # fmt: skip
    if scan.has("ReconSettings/CenterShift") and (shift := _first(scan, "ReconSettings/CenterShift")):
        text = "%s is %g pixels and not used, for its sign is not documented: check --fix-offset or calibrate find the axis"
        _log.warning(text, scan.name("ReconSettings/CenterShift"), shift)
    if is_cone:
        pitch_mm = pixel_mm * (to_axis_mm + behind_mm) / to_axis_mm
        lengths_mm = to_axis_mm, to_axis_mm + behind_mm, shape[1:], (pitch_mm, pitch_mm), (0.0, 0.0)
        geometry: Geometry = assemble.cone(options, *lengths_mm)
    else:
        geometry = assemble.parallel(options, shape[1:], (pixel_mm, pixel_mm), (0.0, 0.0))
    names = ("Alignment/Y-Shifts", "Alignment/X-Shifts")
    shifts = np.stack([_numbers(scan, name, shape[0]) if scan.has(name) else np.zeros(shape[0]) for name in names], -1)
    return RotaryStage(geometry, shift_mm=shifts * geometry.pixel_size_mm if shifts.any() else None)


def _numbers(scan: Fields, name: str, count: int) -> np.ndarray:
    """Returns the first ``count`` numbers (count,) of a stream, which may have room for more."""
    values = scan.numbers(name)
    if len(values) < count:
        raise scan.error(name, f"{len(values)} numbers", f"{count}, one for each image")
    return values[:count]


def _first(scan: Fields, name: str, lowest: float = -LARGEST, highest: float = LARGEST) -> float:
    """Returns the first number of a stream, which is between two bounds."""
    return Fields(scan.subject, {name: float(_numbers(scan, name, 1)[0])}).number(name, lowest=lowest, highest=highest)


def _steady(scan: Fields, name: str) -> float:
    """Returns a distance above 0 that is the same for all images, without its sign."""
    lengths = np.abs(scan.numbers(name))
    lengths = lengths[lengths > 0]  # streams may have room for more images than were taken
    if not len(lengths) or np.ptp(lengths) > _STEADY * lengths[0]:
        raise scan.error(name, f"{np.ptp(lengths):g} between images" if len(lengths) else "0", "one length above 0 mm")
    return float(lengths[0])
