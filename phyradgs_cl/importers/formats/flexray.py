"""Scans of TESCAN's FleX-ray scanners: "scan settings.txt" with TIFFs of counts, flats (io*) and darks (di*).

Offsets in mm have the signs of the package flexdata: ver_ up, tra_ to the right seen from the source. A window of the panel,
ROI (left, top, right, bottom), shifts the image's middle. The sample turns clockwise seen from above, row 0 is on top,
column 0 on the left. flexdata's corrections are not applied: they hold for one scanner, at CWI, and for certain dates."""

import logging
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.importers.assemble import RotaryStage, StoredTiming, cone, scan_on_stage
from phyradgs_cl.importers.files import SafeFolder
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.text import Settings, head_has, read_settings, say_missing
from phyradgs_cl.importers.tiff import read_numbered
from phyradgs_cl.io.hdf5.datasets import LENGTH, TIME

_log = logging.getLogger(__name__)
_FILE = "scan settings.txt"
_PLACES = ("ver_tube", "tra_tube", "ver_det", "tra_det", "tra_obj")
_NAMES = (
    *("SOD", "SDD", *_PLACES, "Start angle", "Last angle", "ROI (LTRB)", "Binned pixel size", "Voxel size"),
    *("Exposure time (ms)", "Number of averages"),
)
_WHOLE_MIDDLE = (971, 767)  # (column, row) of the panel's middle without binning, as in flexdata
_DISAGREE = 0.01  # a binned pixel size that is off by more than this fraction of the voxel size's pixel is not used
_WHOLE_PITCH_MM = 0.0748  # pixel pitch of the panel without binning


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is a folder with "scan settings.txt", or that file."""
    file = path / _FILE if path.is_dir() else path
    return file.name.lower() == _FILE and head_has(file, b"sod", b"sdd")


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder of settings and frames. ``path`` may also be the settings file in it."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.file(_FILE, str(path / _FILE))
    scan = read_settings(description, _NAMES, ":")
    frames, _, said = read_numbered(folder, "scan_", (None, None, None), str(folder.root / "scan_*.tif"), options)
    panel = (frames.shape[1], frames.shape[2])
    flats, darks = (
        read_numbered(folder, name, (None, *panel), str(folder.root / f"{name}*.tif"), options)[0] for name in ("io", "di")
    )
    if len(flats) > 1 and options.flats is None:
        text = "%s: the %d flats count as of one time; say %s time if the second half was taken after the scan"
        _log.warning(text, path, len(flats), options.named("flats"))
    names = {
        "source_to_axis_mm": scan.name("SOD"), "source_to_detector_mm": scan.name("SDD"),
        "pixel_size_mm": scan.name("Voxel size" if scan.has("Voxel size") else "Binned pixel size"),
        "angles": scan.name("Last angle"), "exposure_s": scan.name("Exposure time (ms)"),
    }  # fmt: skip
    stage = _stage(scan, panel, options, names)
    first_deg = scan.number("Start angle", 0.0)
    angle_rad = options.angle_rad(
        len(frames), lambda: np.deg2rad(np.linspace(first_deg, scan.number("Last angle"), len(frames)))
    )
    exposure_s = None
    if scan.has("Exposure time (ms)") and options.exposure_s is None:
        exposure_s = scan.number("Number of averages", 1.0, 1) * scan.measured("Exposure time (ms)", TIME, "ms")
    stored, places = StoredTiming(exposure_s=exposure_s), np.arange(len(frames))
    angle_rad = options.gantry_sign("gantry") * angle_rad
    turned, title = (frames, ("top", "left"), angle_rad, places, names, said), folder.root.resolve().name
    return scan_on_stage(stage, options, description, title, *turned, stored=stored, flats=flats, darks=darks)


def _stage(scan: Settings, panel: tuple[int, int], options: ImportOptions, names: dict[str, str]) -> RotaryStage:
    """Returns the stage that the settings describe. Heights in the scan count from the source, which is at z = 0."""
    to_axis_mm = options.taken("source_to_axis_mm", partial(scan.length, "SOD"))
    to_detector_mm = options.taken("source_to_detector_mm", partial(scan.length, "SDD"))

    def pitch_mm() -> tuple[float, float]:
        binned_mm = scan.length("Binned pixel size") if scan.has("Binned pixel size") else None
        if binned_mm is not None and not scan.has("Voxel size"):
            return binned_mm, binned_mm
        is_stated = scan.has("SOD") and scan.has("SDD")  # the voxel size belongs to these distances, whatever options say
        ratio = scan.length("SDD") / scan.length("SOD") if is_stated else to_detector_mm / to_axis_mm
        size_mm = scan.measured("Voxel size", LENGTH, "um") * ratio
        if binned_mm is not None and abs(binned_mm - size_mm) <= _DISAGREE * size_mm:
            return binned_mm, binned_mm
        if binned_mm is not None:  # other readers do not trust it in all logs
            text = "%s Binned pixel size %.6g mm is not used, as Voxel size makes it %.6g mm; say %s to overrule both"
            _log.warning(text, scan.subject, binned_mm, size_mm, options.named("pixel_size_mm"))
        return size_mm, size_mm

    place_mm = {name: scan.position(name) for name in _PLACES}
    right_mm = up_mm = 0.0  # how far the middle of the panel's window lies to the right of and above the panel's middle
    if scan.has("ROI (LTRB)"):
        left, top, right, bottom = scan.listed("ROI (LTRB)", 4).tolist()
        right_mm = ((left + right) // 2 - _WHOLE_MIDDLE[0]) * _WHOLE_PITCH_MM
        up_mm = ((top + bottom) // 2 - _WHOLE_MIDDLE[1]) * _WHOLE_PITCH_MM
    off_v = place_mm["ver_det"] + up_mm - place_mm["ver_tube"]
    off_u = place_mm["tra_det"] + right_mm - place_mm["tra_tube"]
    assumed = {"Start angle": "0", "ROI (LTRB)": "the whole panel", "Exposure time (ms)": "none", "Number of averages": "1"}
    say_missing(scan, {**dict.fromkeys(_PLACES, "0"), **assumed})
    if options.detector_offset_mm is None:
        text = "%s places are as stated, without a correction profile of flexdata: say %s, or calibrate"
        _log.warning(text, scan.subject, options.named("detector_offset_mm"))
    geometry = cone(options, to_axis_mm, to_detector_mm, panel, pitch_mm, (off_v, off_u), names)
    return RotaryStage(geometry, place_mm["tra_obj"] - place_mm["tra_tube"])
