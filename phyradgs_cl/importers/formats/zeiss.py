"""Scans of Zeiss Xradia microscopes: a .txrm file, an OLE2 container with named streams of data.

As in the readers of DXchange, CIL and MBIRJAX, distances are in mm without their signs. Angles are in degrees; the sample
turns counterclockwise seen from above. Row 0 is the lowest, column 0 on the left. PixelSize in µm is a pixel's size at the
sample. Each image is divided by the reference image. Alignment shifts, in columns and rows, are meant for the images; here
they shift the panel instead. CenterShift is not used: calibrate finds the axis."""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.assemble import RotaryStage, scan_on_stage
from phyradgs_cl.importers.files import check_room, naming_damage
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.text import say_missing
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.io.tables import LARGEST, Fields

_log = logging.getLogger(__name__)
_INFO, _ONE, _SEVERAL = "ImageInfo", "ReferenceData", "MultiReferenceData"
_COUNTS = ("NoOfImages", "ImageHeight", "ImageWidth")
_REAL = ("PixelSize", "Angles", "StoRADistance", "DtoRADistance", "ExpTimes")
_EXPOSURES = f"{_INFO}/ExpTimes"
_STREAMS = {
    **{f"{_INFO}/{name}": "<i4" for name in (*_COUNTS, "DataType", "XrayGeometry", "ImagesTaken")},
    **{f"{_INFO}/{name}": "<f4" for name in _REAL},
    "Alignment/X-Shifts": "<f4", "Alignment/Y-Shifts": "<f4", "ReconSettings/CenterShift": "<f4",
    **{f"{kind}/{name}": dtype for kind in (_ONE, _SEVERAL) for name, dtype in (("DataType", "<i4"), ("ExpTime", "<f4"))},
}  # fmt: skip
_TYPES = {5: "<u2", 10: "<f4"}  # DataType's codes, as NumPy types
_PER_FOLDER = 100  # images in each of the container's folders ImageData1, ImageData2, …
_RESULT_BYTES = 5  # bytes of memory per pixel of the result: a line integral in float32, and its mask
_STEADY = 1e-3  # relative difference up to which a length counts as the same in all images


class Streams(Fields):
    """The streams of numbers in a .txrm file, by name. A stream may have room for more images than were taken."""

    def first_of(self, name: str, lowest: float = -LARGEST, highest: float = LARGEST) -> float:
        """Returns a stream's first number. Raises InputError for one outside [lowest, highest]."""
        return Fields(self.subject, {name: float(self.leading(name, 1)[0])}).number(name, lowest=lowest, highest=highest)

    def leading(self, name: str, count: int) -> np.ndarray:
        """Returns a stream's first numbers (count,). Raises InputError where it has fewer."""
        if len(values := self.numbers(name)) < count:
            raise self.error(name, f"{len(values)} numbers", f"{count}, one for each image")
        return values[:count]

    def steady(self, name: str) -> float:
        """Returns the size in mm of a length that all images share. Images in which the length is 0 do not count. Raises
        InputError if it differs between the others, or is 0 in all images."""
        lengths = np.abs(self.numbers(name))
        lengths = lengths[lengths > 0]
        if not len(lengths) or np.ptp(lengths) > _STEADY * lengths[0]:
            raise self.error(name, f"{np.ptp(lengths):g} between images" if len(lengths) else "0", "one length above 0 mm")
        return float(lengths[0])


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is a .txrm file."""
    return path.is_file() and path.suffix.lower() == ".txrm"


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a .txrm file. Images that were never taken are left out."""
    with open_ole(path) as ole:
        present = {name: dtype for name, dtype in _STREAMS.items() if ole.exists(name)}
        values = {name: read_stream(ole, path, name, dtype).tolist() for name, dtype in present.items()}
        scan = Streams(f"{path}:", values)
        count, rows, columns = (int(scan.first_of(f"{_INFO}/{name}", 1, path.stat().st_size)) for name in _COUNTS)
        taken = int(scan.first_of(f"{_INFO}/ImagesTaken", 0)) if scan.has(f"{_INFO}/ImagesTaken") else count
        taken = min(taken, count) or count  # of the planned images; all if the file states no number or 0
        if taken < count:
            _log.warning("%s: the scan stopped early: %d of %d images were taken", path, taken, count)
        names, panel = [f"ImageData{i // _PER_FOLDER + 1}/Image{i + 1}" for i in range(taken)], (rows, columns)
        there = [i for i, name in enumerate(names) if options.frames != "found" or ole.exists(name)]
        at = np.array(there or [0])  # without any image, reading the first one raises the error
        frames = read_images(ole, path, [names[i] for i in at], _type(scan, f"{_INFO}/DataType"), panel)
        exposures_s = _exposures_s(scan, _EXPOSURES, at)
        usual_s = float(np.median(exposures_s))
        flats = _references(ole, path, scan, panel, usual_s)
    light = None
    if np.ptp(exposures_s) > _STEADY * usual_s:
        light = exposures_s / usual_s
        text = "%s: %g to %g s: each image is divided by its own"
        _log.warning(text, scan.name(_EXPOSURES), exposures_s.min(), exposures_s.max())
    said = f"frames: {len(at)} of {count} images"
    angles = f"{_INFO}/Angles"
    angle_rad = options.gantry_sign("sample") * options.angle_rad(
        len(at), lambda: np.deg2rad(scan.leading(angles, int(at[-1]) + 1)[at])
    )
    in_file = {
        "source_to_axis_mm": scan.name(f"{_INFO}/StoRADistance"), "angles": scan.name(angles),
        "source_to_detector_mm": scan.name(f"{_INFO}/DtoRADistance"), "exposure_s": scan.name(_EXPOSURES),
        "pixel_size_mm": scan.name(f"{_INFO}/PixelSize"),
    }  # fmt: skip
    stored = assemble.StoredTiming()
    if scan.has(_EXPOSURES) and options.exposure_s is None:
        stored = assemble.StoredTiming(exposure_s=scan.first_of(_EXPOSURES, 0) or None)
    turned, stage = (frames, ("bottom", "left"), angle_rad, at, in_file, said), _stage(scan, at, panel, options)
    return scan_on_stage(stage, options, path, path.stem, *turned, stored=stored, flats=flats, light=light)


def _references(ole: Any, path: Path, scan: Streams, panel: tuple[int, int], usual_s: float) -> np.ndarray | None:
    """Returns the reference images (n, v, u) with the light of an exposure of ``usual_s``; as stored if the file does not
    state their own or ``usual_s`` is 0. As in xrmreader, ReferenceData comes first. None: the file has no reference."""
    stored = ["/".join(one) for one in ole.listdir()]
    for kind in (_ONE, _SEVERAL):
        if names := [name for name in stored if re.fullmatch(rf"{kind}/Image\d*", name)]:
            flats = read_images(ole, path, names, _type(scan, f"{kind}/DataType", 10), panel)
            flat_s = _exposures_s(scan, f"{kind}/ExpTime", np.arange(len(names)))
            if flat_s.min() > 0 and usual_s > 0 and np.abs(flat_s / usual_s - 1).max() > _STEADY:
                text = "%s is %g s, that of the images %g s: the reference is divided by their ratio, as in txrm2tiff"
                _log.warning(text, scan.name(f"{kind}/ExpTime"), np.median(flat_s), usual_s)
                flats = flats * np.float32(usual_s / flat_s)[:, None, None]
            return flats
    return None


def _exposures_s(scan: Streams, name: str, at: np.ndarray) -> np.ndarray:
    """Returns the exposures of the images with numbers ``at`` (F,): the first for all if the stream has fewer numbers, 0 for
    all if one is not above 0 or the stream is missing."""
    values = scan.numbers(name) if scan.has(name) else np.zeros(0)
    some = values[at] if len(values) > at[-1] else np.resize(values[:1], len(at))
    return some if np.all(some > 0) else np.zeros(len(at))


def _type(scan: Streams, name: str, default: float | None = None) -> str:
    """Returns the NumPy type of an image's pixels from the code in stream ``name``. default: the code if the stream is
    missing. Raises InputError for types other than 16 bits and float32."""
    number = scan.first_of(name) if default is None or scan.has(name) else default
    if number not in _TYPES:
        raise scan.error(name, f"{number:g}", "5 (16 bits) or 10 (float32)")
    return _TYPES[int(number)]


def _stage(scan: Streams, at: np.ndarray, panel: tuple[int, int], options: ImportOptions) -> RotaryStage:
    """Returns a stage whose panel is shifted in each image by the image's alignment shift. at (F,): the images' numbers."""
    beam, distances = f"{_INFO}/XrayGeometry", (f"{_INFO}/StoRADistance", f"{_INFO}/DtoRADistance")
    is_cone = not scan.has(beam) or scan.first_of(beam) == 1
    if not is_cone and all(map(scan.has, distances)):
        text = "%s is %g: a parallel beam, so %s and %s are not used; of a cone beam it is 1"
        _log.warning(text, scan.name(beam), scan.first_of(beam), *distances)

    def pixel_mm(magnification: float = 1.0) -> tuple[float, float]:
        return (scan.first_of(f"{_INFO}/PixelSize", 1e-6, 1e6) / 1000 * magnification,) * 2

    say_missing(scan, {"Alignment/X-Shifts": "0", "Alignment/Y-Shifts": "0", beam: "a cone",
                       _EXPOSURES: "none"})  # fmt: skip
    if scan.has("ReconSettings/CenterShift") and (shift := scan.first_of("ReconSettings/CenterShift")):
        text = "%s is %g pixels and not used, for its sign is not documented: check --fix-offset or calibrate find the axis"
        _log.warning(text, scan.name("ReconSettings/CenterShift"), shift)
    if is_cone:
        to_axis_mm = options.taken("source_to_axis_mm", lambda: scan.steady(distances[0]))
        to_detector_mm = options.taken("source_to_detector_mm", lambda: to_axis_mm + scan.steady(distances[1]))
        pitch_mm = partial(pixel_mm, to_detector_mm / to_axis_mm)
        geometry: Geometry = assemble.cone(options, to_axis_mm, to_detector_mm, panel, pitch_mm, (0.0, 0.0))
    else:
        geometry = assemble.parallel(options, panel, pixel_mm, (0.0, 0.0))
    names = ("Alignment/Y-Shifts", "Alignment/X-Shifts")
    last = int(at[-1]) + 1
    shifts = np.stack([scan.leading(name, last) if scan.has(name) else np.zeros(last) for name in names], -1)[at]
    return RotaryStage(geometry, shift_mm=shifts * geometry.pixel_size_mm if shifts.any() else None)


@contextmanager
def open_ole(path: Path) -> Iterator[Any]:
    """Yields the open OLE2 container. Errors of the library olefile, while it is open, become InputError."""
    regular_file(path, str(path))
    olefile = checks.package("olefile", "the package that reads .txrm", "phyradgs-cl[formats]")
    with naming_damage(path, "a container that cannot be read", "an OLE2 file"), olefile.OleFileIO(str(path)) as ole:
        yield ole


def read_stream(ole: Any, path: Path, name: str, dtype: str) -> np.ndarray:
    """Reads a stream as numbers (n,). Raises InputError for a missing stream, and for one that is larger than the file."""
    found, most = f"{ole.get_size(name)} bytes" if ole.exists(name) else "nothing", path.stat().st_size
    if found == "nothing" or ole.get_size(name) > most:
        raise InputError(f"{path}: {name}", found, f"numbers in at most {most} bytes")
    data = ole.openstream(name).read()
    return np.frombuffer(data, dtype, len(data) // np.dtype(dtype).itemsize)


def read_images(ole: Any, path: Path, names: list[str], dtype: str, panel: tuple[int, int]) -> np.ndarray:
    """Reads images (F, v, u), one per stream, row 0 as stored. Raises InputError for other numbers of pixels."""
    check_room(str(path), len(names) * panel[0] * panel[1] * (np.dtype(dtype).itemsize + _RESULT_BYTES))
    stack = np.empty((len(names), *panel), dtype)
    for image, name in zip(stack, names, strict=True):
        values = read_stream(ole, path, name, dtype)
        if len(values) != panel[0] * panel[1]:
            raise InputError(f"{path}: {name}", f"{len(values)} pixels", f"{panel[0]} × {panel[1]}")
        image[:] = values.reshape(panel)
    return stack
