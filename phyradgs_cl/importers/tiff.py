"""Reads grey TIFF images, one or many per file, by tifffile; compressed ones by Pillow if imagecodecs is not installed."""

import logging
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageSequence

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.files import SafeFolder, check_room, naming_damage
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.series import series_of
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.io.hdf5.datasets import LENGTH

SUFFIXES = (".tif", ".tiff")
_log = logging.getLogger(__name__)
_RESULT_BYTES = 5  # bytes of memory per pixel of the result: a line integral in float32, and its mask
_NO_SPACE = {"C": "channels", "T": "times"}  # axes that TIFF stacks may have, but volumes must not
_OME_SIZES = re.compile(r'PhysicalSize([XYZ](?:Unit)?)="([^"]*)"')
_OF_SIZE = ("unit", "spacing")
_ORIENTATION = 274  # TIFF's tag Orientation; 1 means row 0 at the top, column 0 on the left


def read_tiffs(paths: list[Path]) -> np.ndarray:
    """Reads all images of all files in order: frames (F, v, u) in their own type, row 0 as stored. Reads all headers first,
    so that pixels go into one array and wrong files are found early. Raises InputError for damage, images of several sizes
    or types, and more than the machine's memory."""
    headers = [_header(path) for path in paths]
    frames, (shape, dtype) = sum(count for count, _ in headers), headers[0][1]
    for path, (_, kind) in zip(paths, headers, strict=True):
        if kind != (shape, dtype):
            raise InputError(str(path), "{} {}".format(*kind), f"{shape} {dtype} as in {paths[0].name}")
    check_room(str(paths[0]), frames * math.prod(shape) * (dtype.itemsize + _RESULT_BYTES))
    stack, at = np.empty((frames, *shape), dtype), 0
    for path, (count, _) in zip(paths, headers, strict=True):
        with _opened(path) as tiff:
            try:
                for page in tiff.pages:  # a page may hold a stack (n, v, u)
                    images = math.prod(page.shape[:-2])
                    page.asarray(maxworkers=1, out=stack[at : at + images].reshape(page.shape))
                    at += images
            except (ValueError, NotImplementedError) as error:
                if "imagecodecs" not in str(error):
                    raise
                with Image.open(path) as pillow:
                    stack[at : at + count] = [np.asarray(page) for page in ImageSequence.Iterator(pillow)]
                at += count
    return stack


def read_numbered(
    folder: SafeFolder, prefix: str, shape: tuple[int | None, ...], subject: str | Sequence[str], options: ImportOptions,
    first: int = 0, pattern: str = r"\d+",
) -> tuple[np.ndarray, np.ndarray, str]:
    """Reads a folder's TIFFs whose names are ``prefix`` and a number. Returns frames (F, v, u) in the numbers' order, their
    numbers (F,) from 0 on, and a text about which were taken. shape: the expected (F, v, u), None where any size fits.
    subject: what states the shape, or each of its sizes, for messages. first: the number of the first frame, needed if that
    frame is missing. pattern: the form of numbers. Files beyond the stated count are left out, with a warning. Raises
    InputError for such files if the numbers do not begin with ``first`` (any file may then be the surplus one); for fewer
    files than stated, unless the options say to take those found; and for images of another size."""
    subjects = [subject] * 3 if isinstance(subject, str) else subject
    name = re.compile(re.escape(prefix) + pattern, re.I)
    paths = [path for path in folder.matching(*SUFFIXES) if name.fullmatch(path.stem)]
    paths.sort(key=lambda path: int(path.stem[len(prefix) :]))
    stated, is_free = shape[0] or len(paths), options.frames == "found"
    remedy = f"copy the missing files, or say {options.named('frames')} found"
    if not paths or (len(paths) < stated and not is_free):
        found = f"{len(paths)} files {prefix[:60]}*.tif in {folder.root}"
        expected = f"{stated}, one for every projection" if stated else "at least one"
        raise InputError(subjects[0], found, expected, remedy if paths else "copy the missing files")
    if len(paths) > stated:
        if int(paths[0].stem[len(prefix) :]) != first:
            found = f"{len(paths)} files, {paths[0].name} to {paths[-1].name}"
            raise InputError(subjects[0], found, f"{stated}", "take those out that are no projections")
        text = "%s: %d files, and %d are stated: left out: %s"
        _log.warning(text, subjects[0], len(paths), stated, ", ".join(path.name for path in paths[stated:][:8]))
    numbers = np.array([int(path.stem[len(prefix) :]) for path in paths[:stated]])
    is_from_first = len(paths) < stated and numbers[0] > first and numbers[-1] < first + stated
    series = series_of(paths[:stated], str(folder.root), remedy, holes=is_free, skip=len(prefix))
    frames = read_tiffs(series.paths)
    wrong = [name for name, size, n in zip(subjects, frames.shape, shape, strict=True) if n not in (None, size)]
    if len(frames) != len(numbers) or wrong[1 if len(numbers) < stated else 0 :]:
        found, expected = " × ".join(map(str, frames.shape)), " × ".join(str(n or "any") for n in (len(numbers), *shape[1:]))
        raise InputError(str(paths[0]), f"images of {found}", expected, f"see {', '.join(wrong or subjects[:1])}")
    return frames, numbers - (first if is_from_first else numbers[0]), series.said


def stack_shape(paths: list[Path]) -> tuple[int, int, int]:
    """Returns the shape (frames, rows, columns) that ``read_tiffs`` would read. Reads only headers; rows and columns are the
    first file's."""
    headers = [_header(path) for path in paths]
    return sum(count for count, _ in headers), *headers[0][1][0]


def _header(path: Path) -> tuple[int, tuple[tuple[int, int], np.dtype]]:
    """Returns the number of images in one file, and their (shape, type). Raises InputError for no image, and for images
    that are not grey, differ, or have a tag Orientation other than 1."""
    images, kinds = 0, []
    with _opened(path) as tiff:
        for page in tiff.pages:  # a page may hold a stack (n, v, u)
            shape, dtype = page.shape[-2:], page.dtype
            grey = len(page.shape) == 2 or (len(page.shape) == 3 and page.axes.endswith("YX"))
            if not grey or min(page.shape) < 1 or dtype is None or dtype.kind not in "iuf":
                found = f"a page of shape {page.shape}, type {dtype}"
                raise InputError(str(path), found, "grey images (rows, columns), or a stack of them")
            if (tag := page.tags.get(_ORIENTATION)) is not None and tag.value != 1:
                expected = "1 (row 0 at the top, column 0 on the left)"
                raise InputError(f"{path} tag Orientation", str(tag.value), expected, "turn the images")
            kinds.append((shape, dtype))
            images += math.prod(page.shape[:-2])
        stated_images = int((tiff.imagej_metadata or {}).get("images", 0)) if tiff.is_imagej else 0
    if not images:
        raise InputError(str(path), "no page", "at least one image")
    if any(kind != kinds[0] for kind in kinds):
        raise InputError(str(path), "pages of several sizes or types", "one for all frames")
    if stated_images > images:  # ImageJ's files above 4 GB hold more images than their directory lists
        found, expected = f"{stated_images} images and {images} of them in its directory", "a directory of all images"
        raise InputError(str(path), found, expected, "save it as BigTIFF, or as one file per image")
    return images, kinds[0]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yields an open TIFF. Errors of tifffile, while it is open, become InputError. Pages beyond the file's end, which
    tifffile only logs and leaves out, raise InputError too."""
    regular_file(path, str(path))
    tifffile = checks.package("tifffile", "the package that reads TIFF", "phyradgs-cl[formats]")
    logger, said = logging.getLogger("tifffile"), list[str]()
    before = logger.filters[:]

    def collect(record: logging.LogRecord) -> bool:
        said.append(record.getMessage())
        return False

    logger.addFilter(collect)
    parts = "a TIFF that cannot be read", "grey images", "copy the file again, or save it uncompressed"
    try:
        with naming_damage(path, *parts), tifffile.TiffFile(path) as tiff:
            yield tiff
        if any("invalid page offset" in text for text in said):
            raise InputError(str(path), "pages behind the end of the file", "a whole TIFF", "copy the file again")
    finally:
        logger.filters = before


def calibration(path: Path) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """Returns a stack's voxel sizes (x, y, z) in mm, its origin (x, y, z) in voxels or None, and its text "Info". Reads
    ImageJ's tags, OME-TIFF, and tifffile's BigTIFF, which has ImageJ's values as JSON.

    Without valid sizes it returns (None, None, ""), with a warning if the file has some of them. Raises InputError for
    several channels or times. Call ``read_tiffs`` first, which checks the file."""
    with _opened(path) as tiff:
        series = tiff.series[0]
        long = {axis: n for axis, n in zip(series.axes, series.shape, strict=False) if axis in _NO_SPACE and n > 1}
        ome, per_mm = dict(_OME_SIZES.findall(tiff.ome_metadata or "")), []
        with suppress(KeyError, TypeError, ValueError, ZeroDivisionError):
            per_mm = [np.divide(*tiff.pages[0].tags[f"{axis}Resolution"].value) for axis in "XY"]
        facts: dict[str, Any] = tiff.imagej_metadata or next(iter(tiff.shaped_metadata or ()), {})
    if long:
        found = " and ".join(f"{count} {_NO_SPACE[axis]}" for axis, count in long.items())
        raise InputError(str(path), f"a stack of axes {series.axes}, {found}", "one volume", "save one of them, as slices")
    units = [ome.get(f"{axis}Unit", "um") if ome else str(facts.get("unit", "")) for axis in "XYZ"]
    try:
        sizes = [float(ome[axis]) for axis in "XYZ"] if ome else [*(1 / n for n in per_mm), float(facts["spacing"])]
        size_mm = np.array(sizes) * np.array([LENGTH.factor(unit) for unit in units], np.float64)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        size_mm = np.full(3, np.nan)
    if size_mm.shape != (3,) or not np.all(np.isfinite(size_mm) & (size_mm > 0)):
        if ome or "unit" in facts:
            stated = ome or {name: facts[name] for name in facts if name in _OF_SIZE}
            found = ", ".join(f"{name} {value}" for name, value in stated.items())
            _log.warning("%s: no voxel sizes can be made of %s: the scale is left out", path, found)
        return None, None, ""
    origin = np.array([float(facts.get(f"{axis}origin", np.nan)) for axis in "xyz"])
    return size_mm, origin if np.isfinite(origin).all() else None, str(facts.get("Info", ""))
