"""A folder of TIFF or HDF5 frames with a TOML file that describes them. The TOML has the tables of a scanner file, and
[frames], [angles] and [timing]. Row 0 is the top, column 0 the left, seen from the source."""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.plausible import question_unit
from phyradgs_cl.acquisition.readout import frame_time_of, seconds_of
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import hdf5, tiff
from phyradgs_cl.importers.angles import read_angles_rad
from phyradgs_cl.importers.assemble import StoredTiming, assemble_scan, make_timing, turning, with_options
from phyradgs_cl.importers.files import SafeFolder, checked_name
from phyradgs_cl.importers.frames import LineIntegrals, line_integrals, oriented
from phyradgs_cl.importers.options import FIELDS, WORDS, ImportOptions
from phyradgs_cl.importers.series import Series, flat_places, series_of
from phyradgs_cl.importers.text import found_by
from phyradgs_cl.io.hdf5.datasets import ANGLE
from phyradgs_cl.io.scan.reader import united
from phyradgs_cl.io.scanner import TABLES, Scanner, scanner_from
from phyradgs_cl.io.tables import Fields, read_toml, refuse_unknown

OWN_TABLES = {
    "frames": (
        *(*hdf5.STACKS, "order", "image_key", "axes"), *("quantity", "flat_value", "row_0", "column_0")
    ),
    "angles": ("first_deg", "last_deg", "step_deg", "values_deg", "file", "unit", "rotates", "at"),
    "timing": ("exposure_s", "readout_s", "frame_time_s", "start_s", "detector_model"),
}
_PER_FRAME, _ANGLES = ("values_deg", "file"), ("step_deg", "last_deg", "values_deg", "file")
_KEYS = {  # for each import option: the TOML's key of the same value
    **{name: f"[timing] {name}" for name in ("exposure_s", "readout_s", "frame_time_s")},
    **{name: f"[readout] {name}" for name in ("first", "fps", "readout_ms")},
    **{name: f"[frames] {name}" for name in ("quantity", "flat_value", "row_0", "column_0")},
    **{"readout_axis": "[readout] axis", "readout_direction": "[readout] direction"},
    **{"angle_at": "[angles] at", "rotates": "[angles] rotates", "detector_model": "[timing] detector_model"},
    **{"source_to_axis_mm": "[source] to_axis_mm", "source_to_detector_mm": "[source] to_detector_mm"},
    "pixel_size_mm": "[detector] pixel_size_v_mm, pixel_size_u_mm",
}
recognises = found_by((".toml",))
_SCANNER = ("title", "source", "detector", "volume", "readout", "beam")


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one TOML file and its frames. ``path`` may also be the TOML file in it."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.only("description of the scan", ".toml")
    tables = _tables(description)
    # messages call a value by its key in the TOML, unless the user gave it as an option
    given, option = options.given(FIELDS), options.named
    options = replace(options, named=lambda field: (None if field in given else _KEYS.get(field)) or option(field))
    combined = _with_file(options, tables)
    stored = _in_hdf5(folder, tables["frames"], options)
    if stored is None:
        files = {name: _files(folder, tables["frames"], name) for name in ("flats", "darks", "mask")}
        series = _projections(folder, tables, options, {path for paths in files.values() for path in paths})
        frames, rows, columns = tiff.stack_shape(series.paths)
        used, said = np.ones(frames, bool), series.said
    else:
        (frames, rows, columns), used, said = stored.projections.shape, stored.used, ""
    scanner = _scanner(description, tables[""], (rows, columns), options)
    geometry = with_options(options, scanner.geometry)
    timing = make_timing(str(description), frames, options, _stored_timing(tables, scanner))
    angle_rad = options.angle_rad(frames, lambda: _angles_rad(folder, tables["angles"], used, options))
    question_unit(angle_rad, options.called("angles", {"angles": tables["angles"].subject}), "deg")
    if stored is None:
        integrals = _line_integrals(files, series, combined, tables["frames"], str(description))
    else:
        integrals = stored.line_integrals(str(description), combined, "top")
    readout_key = ("readout", "readout_ms") if tables["readout"].has("readout_ms") else ("timing", "readout_s")
    keys = {"exposure_s": ("timing", "exposure_s"), "readout_s": readout_key}
    names = {field: tables[table].name(key) for field, (table, key) in keys.items() if tables[table].has(key)}
    return assemble_scan(
        integrals, turning(geometry, combined.gantry_sign("gantry") * angle_rad, timing), geometry, timing, combined, path,
        title=tables[""].word("title", default=folder.root.resolve().name), said=said,
        grid=scanner.grid if tables[""].has("volume") else None, lag=scanner.lag,
        names={"grid": tables[""].name("[volume]"), "angles": tables["angles"].subject, **names},
    )


def _tables(path: Path) -> dict[str, Fields]:
    """Reads the TOML. Returns the tables [frames], [angles], [timing] and [readout] by name, and under "" all tables that a
    scanner file has too. Raises InputError for unknown names."""
    content = read_toml(path)
    for place in (content, content.get("frames")):  # angles = "FILE" is short for file = "FILE" in [angles]
        if isinstance(place, dict) and isinstance(place.get("angles"), str):
            text = place.pop("angles")
            content["angles"] = {**content.get("angles", {}), "file": text}
    refuse_unknown(str(path), content, (*_SCANNER, *OWN_TABLES), "a name")
    tables = {name: Fields(f"{path} [{name}]", content.get(name, {}), keys) for name, keys in OWN_TABLES.items()}
    tables["readout"] = Fields(f"{path} [readout]", content.get("readout", {}), TABLES["readout"])
    return {"": Fields(f"{path}:", {k: v for k, v in content.items() if k not in OWN_TABLES}), **tables}


def _with_file(options: ImportOptions, tables: dict[str, Fields]) -> ImportOptions:
    """Returns the options, completed by values of the TOML with the same names."""
    frames = tables["frames"]
    table_of = {**dict.fromkeys(("quantity", "row_0", "column_0"), frames), "rotates": tables["angles"]}
    table_of["detector_model"] = tables["timing"]
    combined: dict[str, Any] = {key: table.word(key, WORDS[key]) for key, table in table_of.items() if table.has(key)}
    if frames.has("flat_value"):
        combined["flat_value"] = frames.length("flat_value")
    return replace(options, **{key: value for key, value in combined.items() if not getattr(options, key)})


def _in_hdf5(folder: SafeFolder, frames: Fields, options: ImportOptions) -> hdf5.Stacks | None:
    """Reads the frames if the TOML gives the projections as an address in HDF5, else returns None."""
    stated = {name: frames.values[name] for name in (*hdf5.STACKS, "image_key", "axes") if frames.has(name)}
    lists = {name: value if isinstance(value, list) else [value] for name, value in stated.items()}
    if not all(map(hdf5.is_address, lists.get("projections", [None]))):
        return None
    return hdf5.Places(lists, frames.subject, options.linked_folder, folder=folder).stacks()


def _projections(folder: SafeFolder, tables: dict[str, Fields], options: ImportOptions, others: set[Path]) -> Series:
    """Returns the projections' files in order. others: files of flats, darks and mask, which are left out."""
    frames, angles = tables["frames"], tables["angles"]
    paths = [path for path in _files(folder, frames, "projections", "*.tif*") if path not in others]
    if not paths:
        expected = "files that flats, darks and mask do not name"
        raise frames.error("projections", "no file but those of flats, darks and mask", expected, "correct the patterns")
    has_own = options.angles is None and any(angles.has(key) for key in _PER_FRAME)
    remedy = "complete the frames, or give every one its angle: [angles] values_deg or file"
    order = frames.count("order", 99) if frames.has("order") else None
    return series_of(paths, str(folder.root), remedy, order=order, holes=has_own)


def _line_integrals(
    files: dict[str, list[Path]], series: Series, combined: ImportOptions, frames: Fields, subject: str
) -> LineIntegrals:
    turned = {
        name: oriented(tiff.read_tiffs(paths), combined, "top")
        for name, paths in {"projections": series.paths, **files}.items() if paths
    }  # fmt: skip
    stack, flats, darks, mask = (turned.get(name) for name in ("projections", "flats", "darks", "mask"))
    assert stack is not None
    names = {name: [path.name for path in paths] for name, paths in files.items() if len(paths) == len(turned.get(name, ()))}
    is_one_a_file = "flats" in names and len(stack) == len(series.paths)
    at = flat_places(files["flats"], files["darks"], series) if is_one_a_file else None
    integrals = line_integrals(subject, stack, combined, flats=flats, darks=darks, flats_at=at, names=names)
    if mask is None:
        return integrals
    if mask.shape not in (stack.shape, (1, *stack.shape[1:])):
        raise frames.error("mask", f"shape {mask.shape}", f"one image of {stack.shape[1:]}, or one per frame")
    return replace(integrals, mask=united(integrals.mask, (mask if mask.shape == stack.shape else mask[0]) != 0))


def _files(folder: SafeFolder, frames: Fields, name: str, default: str = "") -> list[Path]:
    """Returns the files that match the patterns under the key ``name`` of [frames], or ``default`` without that key."""
    value = frames.values.get(name) or default
    paths: list[Path] = []
    for one in value if isinstance(value, list) else [value] if value else []:
        pattern = checked_name(one, frames.name(name))
        if "**" in pattern or "*" in str(PurePosixPath(pattern).parent):
            raise frames.error(name, repr(pattern), "a pattern for files of one folder")
        found = folder.glob(pattern, *tiff.SUFFIXES)
        if not found:
            remedy = "correct the pattern, or leave it out"
            raise frames.error(name, f"no file that matches {pattern!r}", "at least one TIFF", remedy)
        paths += found
    return list(dict.fromkeys(paths))


def _scanner(path: Path, scanner: Fields, panel: tuple[int, int], options: ImportOptions) -> Scanner:
    """Returns the scanner of the TOML, with lengths of the options where given. panel: the images' (rows, columns). Raises
    InputError where the TOML states another panel."""
    content = {name: dict(value) if isinstance(value, dict) else value for name, value in scanner.values.items()}
    source, detector = content.setdefault("source", {}), content.setdefault("detector", {})
    given: dict[str, dict[str, float | None]] = {
        "source": {"to_axis_mm": options.source_to_axis_mm, "to_detector_mm": options.source_to_detector_mm},
        "detector": dict(zip(("pixel_size_v_mm", "pixel_size_u_mm"), options.pixel_size_mm or (), strict=False)),
    }
    for table, values in ((source, given["source"]), (detector, given["detector"])):
        if isinstance(table, dict) and table.get("beam") != "parallel":  # with_options refuses a parallel beam's distances
            table.update({key: value for key, value in values.items() if value is not None})
    if isinstance(detector, dict):
        content["detector"] = {"rows": panel[0], "columns": panel[1], **detector}
    described = scanner_from(path, content)
    if described.geometry.detector_shape != panel:
        found = f"{described.geometry.detector_shape} rows and columns"
        raise InputError(f"{path} [detector]", found, f"the images' {panel}", "leave both out")
    return described


def _stored_timing(tables: dict[str, Fields], scanner: Scanner) -> StoredTiming:
    timing, angles, readout = tables["timing"], tables["angles"], tables["readout"]
    exposure_s, readout_s = (
        timing.number(name, lowest=0.0) if timing.has(name) else None for name in ("exposure_s", "readout_s")
    )

    def named(field: str) -> str:
        return _KEYS[field] if field in OWN_TABLES["timing"] else readout.name(field)

    readout_s = seconds_of("readout", scanner.readout_ms, readout_s, named)
    if readout_s is None and exposure_s is not None and scanner.readout_ratio is not None:
        readout_s = scanner.readout_ratio * exposure_s
    frame_time_s = frame_time_of(scanner.fps, timing.length("frame_time_s") if timing.has("frame_time_s") else None, named)
    if scanner.fps is not None and timing.has("start_s"):
        raise readout.error("fps", f"{scanner.fps:g} with [timing] start_s", "one of the two", "leave fps out")
    stated = ((timing, "exposure_s"), (timing, "readout_s"), (readout, "readout_ms"), (angles, "at"))
    return StoredTiming(
        exposure_s=exposure_s, readout_s=readout_s, frame_time_s=frame_time_s,
        start_s=timing.numbers("start_s") if timing.has("start_s") else None,
        axis=scanner.readout_axis if readout.has("first") or readout.has("axis") else None,
        direction=scanner.readout_direction if readout.has("first") or readout.has("direction") else None,
        pulse=scanner.pulse, angle_at=angles.word("at", WORDS["angle_at"]) if angles.has("at") else None,
        written=tuple(table.name(key) for table, key in stated if table.has(key)),
    )


def _angles_rad(folder: SafeFolder, angles: Fields, used: np.ndarray, options: ImportOptions) -> np.ndarray:
    """Returns the angles in rad of the frames marked in ``used``, bool (F,). They come from a list, a file, an HDF5
    dataset, or from the first angle and the last or a step. Raises InputError unless exactly one of these is given."""
    frames = int(used.sum())
    given = [key for key in _ANGLES if angles.has(key)]
    if len(given) != 1:
        raise InputError(angles.subject, " and ".join(given) or "no angles", f"one of {', '.join(_ANGLES)}")
    if angles.has("unit") and not angles.has("file"):
        raise angles.error("unit", "no file beside it", "the unit of a file of angles", "leave it out")
    if angles.has("file"):
        unit = angles.word("unit") if angles.has("unit") else None
        if unit is not None and ANGLE.factor(unit) is None:
            raise angles.error("unit", repr(unit[:40]), f"one of {ANGLE.accepted}")
        if hdf5.is_address(text := angles.get("file")):
            places = hdf5.Places({"angles": [str(text)]}, angles.subject, options.linked_folder, folder=folder)
            return places.angles_rad(used, options, unit=unit or "deg")
        return read_angles_rad(folder.file(angles.get("file"), angles.name("file")), frames, unit)
    if angles.has("values_deg"):
        return np.deg2rad(angles.numbers("values_deg", frames))
    first = angles.number("first_deg", 0.0)
    if angles.has("step_deg"):
        return np.deg2rad(first + np.arange(frames) * angles.number("step_deg"))
    return np.deg2rad(np.linspace(first, angles.number("last_deg"), frames))


TEMPLATE = """\
# Fill in what says FILL IN. Remove the # of a line that applies.
# title = "a scan" # without it the folder's name

[frames]
# projections = "*.tif" # frames, in the order of the numbers in their names
# flats = "flat_*.tif" # frames without an object; with before and after in their names: interpolated
# darks = "dark_*.tif" # frames without a beam
# mask = "mask.tif" # non-zero: do not use the pixel
# order = 1 # the number in the names that gives the order, 1 the first; without it the import finds it
# image_key = "a.h5:/key" # of frames at an address in HDF5: 0 projection, 1 flat, 2 dark, 3 none of them
# axes = "v,frame,u" # order of such an array, here of sinograms; frame,v,u without it
# quantity = "counts" # or attenuation (line integrals), transmission
# flat_value = 50000.0 # counts without an object, in place of flats
# row_0 = "top" # or bottom: where the images' first row is
# column_0 = "left" # or right, seen from the source: where their first column is

[source]
to_axis_mm = 0.0 # mm, FILL IN: source to rotation axis
to_detector_mm = 0.0 # mm, FILL IN: source to detector
# beam = "parallel" # in place of both distances: a beam without a source at a distance

[detector]
# rows = 1 # of the images
# columns = 1 # of the images
pixel_size_v_mm = 0.0 # mm, FILL IN: height of a pixel, along the axis
pixel_size_u_mm = 0.0 # mm, FILL IN: width of a pixel
# offset_v_mm = 0.0 # mm, panel's middle above the central ray
# offset_u_mm = 0.0 # mm, panel's middle to the right of it, seen from the source
# lag = 0.0 # share of a frame that comes from the frames before

[angles]
# first_deg = 0.0 # degrees, angle of the first frame
# step_deg = 1.0 # degrees from frame to frame; FILL IN this, last_deg, values_deg or file
# last_deg = 359.0 # degrees, angle of the last frame
# values_deg = [0.0, 1.0] # degrees, one for each frame
# file = "angles.txt" # one angle a line, or an index and an angle, or named columns
# unit = "deg" # or rad: of the file
# rotates = "gantry" # or sample: what turns, counterclockwise seen from above
# at = "start" # or middle of the exposure of the frame's first line

[timing]
# exposure_s = 0.06 # s, exposure of one line
# readout_s = 0.062 # s, in place of readout_ms
# frame_time_s = 0.0667 # s from frame to frame, in place of fps
# start_s = [0.0, 0.0667] # s, start of each frame, in place of fps
# detector_model = "intensity" # what an exposure averages: intensity, as real panels do, or log (line integrals)

[readout]
# fps = 15.0 # frames per second of a gantry that never stops; without it every frame is taken at rest
# readout_ms = 62.0 # ms from the first line's start to the last line's; 0: all lines at once
# first = "top" # or bottom, left, right, seen from the source: which line is read first
# axis = "rows" # or columns: what is read at one time, in place of first
# direction = -1 # 1: row 0 (lowest) or column 0 (left) first; -1: last; in place of first
# ratio = 1.0 # readout over exposure time, in place of readout_ms

# [beam]
# pulse_start = 0.0 # exposures after a frame's start: a beam that is not always on
# pulse_length = 1.0 # exposures

# [volume]
# shape = [256, 256, 256] # voxels z, y, x; without the table what a full turn sees
# size_mm = [200.0, 200.0, 200.0] # mm, z, y, x
# offset_mm = [0.0, 0.0, 0.0] # mm, z, y, x: the box's middle from the axis
"""
