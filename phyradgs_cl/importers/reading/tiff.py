"""Grey TIFF images, one or many per file, by tifffile; by Pillow where tifffile needs imagecodecs and that is missing."""

import logging
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageSequence

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.files import SafeFolder, check_room
from phyradgs_cl.importers.reading.series import series_of
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.io.hdf5.datasets import LENGTH

SUFFIXES = (".tif", ".tiff")
_MOST_PAGES = 100_000
_PLAIN = 1  # compression
_log = logging.getLogger(__name__)
_RESULT_BYTES = 5  # per pixel: a line integral in float32, and its mask
_NO_SPACE = {"C": "channels", "T": "times"}  # axes of a stack that are none of a volume
_OME_SIZES = re.compile(r'PhysicalSize([XYZ](?:Unit)?)="([^"]*)"')
_OF_SIZE = ("unit", "spacing")
_ORIENTATION = 274  # 1: row 0 at the top, column 0 on the left


@dataclass(frozen=True)
class _Header:
    images: int
    shape: tuple[int, int]
    dtype: np.dtype


def read_tiffs(paths: list[Path]) -> np.ndarray:
    """Reads all images of all files in order: frames (F, v, u) in their own type, row 0 as stored. All headers are read
    before any pixel, so that the frames are unpacked into one array of known size."""
    headers = [_header(path) for path in paths]
    first = headers[0]
    for path, header in zip(paths, headers, strict=True):
        if (header.shape, header.dtype) != (first.shape, first.dtype):
            expected = f"{first.shape} {first.dtype} as in {paths[0].name}"
            raise InputError(str(path), f"{header.shape} {header.dtype}", expected)
    frames = sum(header.images for header in headers)
    check_room(str(paths[0]), frames * math.prod(first.shape) * (first.dtype.itemsize + _RESULT_BYTES))
    stack = np.empty((frames, *first.shape), first.dtype)
    at = 0
    for path, header in zip(paths, headers, strict=True):
        images = stack[at : at + header.images]
        with _opened(path) as tiff:
            try:
                for page, image in zip(tiff.pages, _pages(images, tiff), strict=True):
                    page.asarray(maxworkers=1, out=image)
            except (ValueError, NotImplementedError) as error:
                if "imagecodecs" not in str(error):
                    raise
                with Image.open(path) as pillow:
                    images[:] = [np.asarray(page) for page in ImageSequence.Iterator(pillow)]
        at += header.images
    return stack


def _pages(images: np.ndarray, tiff: Any) -> Iterator[np.ndarray]:
    """Yields the part of a file's images that each of its pages fills, for a page may be a stack."""
    at = 0
    for page in tiff.pages:
        count = math.prod(page.shape[:-2])
        yield images[at : at + count].reshape(page.shape)
        at += count


def read_numbered(
    folder: SafeFolder, prefix: str, shape: tuple[int | None, ...], subject: str | Sequence[str], options: ImportOptions,
    first: int = 0, pattern: str = r"\d+",
) -> tuple[np.ndarray, np.ndarray, str]:
    """Reads the TIFFs of a folder whose names are ``prefix`` and a number: frames (F, v, u) of ``shape``, in the numbers'
    order; None is any size. Returns them with their places (F,) from 0 on, and what was taken, in words.

    ``pattern``: a number in the names; ``first``: the number of the first frame where that is missing; ``subject`` names
    what states the shape, or each of its three sizes. Files beyond the stated number are left out by name. InputError for
    fewer, unless the options ask for the frames that are found."""
    subjects = [subject] * 3 if isinstance(subject, str) else subject
    name = re.compile(re.escape(prefix) + pattern, re.I)
    paths = [path for path in folder.matching(*SUFFIXES) if name.fullmatch(path.stem)]
    stated, is_free = shape[0], options.frames == "found"
    remedy = f"copy the missing files, or say {options.named('frames')} found"
    if not paths or (stated is not None and len(paths) < stated and not is_free):
        found = f"{len(paths)} files {prefix[:60]}*.tif in {folder.root}"
        expected = f"{stated}, one for every projection" if stated else "at least one"
        raise InputError(subjects[0], found, expected, remedy if paths else "copy the missing files")
    numbers = np.array([int(path.stem[len(prefix) :]) for path in paths])
    order = np.argsort(numbers, kind="stable")
    paths, numbers = [paths[i] for i in order], numbers[order]
    is_from_first = stated is not None and len(paths) < stated and numbers[0] > first and numbers[-1] < first + stated
    numbers = numbers - (first if is_from_first else numbers[0])
    if stated is not None and len(paths) > stated:
        text = "%s: %d files, and %d are stated: left out: %s"
        _log.warning(text, subjects[0], len(paths), stated, ", ".join(path.name for path in paths[stated:][:8]))
        paths, numbers = paths[:stated], numbers[:stated]
    series = series_of(paths, str(folder.root), remedy, holes=is_free, skip=len(prefix))
    sizes = stack_shape(paths)
    wrong = [name for name, size, n in zip(subjects[1:], sizes[1:], shape[1:], strict=True) if n not in (None, size)]
    if wrong or sizes[0] != len(paths):
        found = f"{sizes[0]} images of {sizes[1]} × {sizes[2]} pixels"
        expected = " × ".join(str(n or "any") for n in (len(paths), *shape[1:]))
        raise InputError(str(paths[0]), found, expected, f"see {', '.join(dict.fromkeys(wrong or subjects[:1]))}")
    return read_tiffs(paths), numbers, series.said


def stack_shape(paths: list[Path]) -> tuple[int, int, int]:
    """Returns the shape (frames, rows, columns) that ``read_tiffs`` would read, from headers alone; rows and columns of the
    first file."""
    headers = [_header(path) for path in paths]
    rows, columns = headers[0].shape
    return sum(header.images for header in headers), rows, columns


def _header(path: Path) -> _Header:
    """Returns the images of one file, after a check of every page against the size of the file."""
    with _opened(path) as tiff:
        images = pages = 0
        for page in tiff.pages:
            if pages >= _MOST_PAGES:
                raise InputError(str(path), f"more than {_MOST_PAGES} pages", "fewer pages")
            _check_page(path, page, images * math.prod(page.shape[-2:]) * (page.dtype or np.dtype(np.uint8)).itemsize)
            if pages == 0:
                shape, dtype = page.shape[-2:], page.dtype
            if (page.shape[-2:], page.dtype) != (shape, dtype):
                raise InputError(str(path), "pages of several sizes or types", "one for all frames")
            pages, images = pages + 1, images + math.prod(page.shape[:-2])
        stated_images = int((tiff.imagej_metadata or {}).get("images", 0)) if tiff.is_imagej else 0
    if not pages:
        raise InputError(str(path), "no page", "at least one image")
    if stated_images > images:  # ImageJ writes such files beyond 4 GB
        found, expected = f"{stated_images} images and {images} of them in its directory", "a directory of all images"
        raise InputError(str(path), found, expected, "save it as BigTIFF, or as one file per image")
    return _Header(images, shape, dtype)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yields an open TIFF. Any error of the library in the body becomes InputError."""
    regular_file(path, str(path))
    tifffile = checks.package("tifffile", "the package that reads TIFF", "phyradgs-cl[formats]")
    try:
        with _quiet("tifffile"), tifffile.TiffFile(path) as tiff:
            yield tiff
    except (InputError, MemoryError):
        raise
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable TIFF") from error
    except Exception as error:  # damage raises any exception
        found = f"a TIFF that cannot be read ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(str(path), found, "grey images", "save it uncompressed") from error


def calibration(path: Path) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """Returns the voxel sizes (x, y, z) in mm, the origin's place (x, y, z) in voxels and the text "Info" of a stack. ImageJ
    wrote the stack, or tifffile, which keeps the same values of a BigTIFF as JSON, or a program that writes OME-TIFF. None
    stands for missing values, which a warning names where the file has a part of them. InputError for a stack with several
    channels or times. Call ``read_tiffs`` first."""
    tifffile = checks.package("tifffile", "the package that reads TIFF", "phyradgs-cl[formats]")
    with _opened(path) as tiff:
        series = tiff.series[0]
        long = {axis: n for axis, n in zip(series.axes, series.shape, strict=False) if axis in _NO_SPACE and n > 1}
        ome, per_mm = dict(_OME_SIZES.findall(tiff.ome_metadata or "")), []
        with suppress(KeyError, TypeError, ValueError, ZeroDivisionError, tifffile.TiffFileError):
            per_mm = [np.divide(*tiff.pages[0].tags[f"{axis}Resolution"].value) for axis in "XY"]
        facts: dict[str, Any] = tiff.imagej_metadata or next(iter(tiff.shaped_metadata or ()), {})
    if long:
        found = " and ".join(f"{count} {_NO_SPACE[axis]}" for axis, count in long.items())
        raise InputError(str(path), f"a stack of axes {series.axes}, {found}", "one volume", "save one of them, as slices")
    units = [ome.get(f"{axis}Unit", "um") if ome else str(facts.get("unit", "")) for axis in "XYZ"]
    try:
        sizes = [float(ome[axis]) for axis in "XYZ"] if ome else [*(1 / n for n in per_mm), float(facts["spacing"])]
        factors = np.array([LENGTH.factor(unit) for unit in units], np.float64)
        size_mm = np.array(sizes, np.float64) * factors
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


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Stops a library from logging a line for every damaged tag, since one error names the file."""
    logger = logging.getLogger(name)
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def _check_page(path: Path, page: Any, before_bytes: int) -> None:
    """Compares the size of a page with the file before anything is decoded. One page may be a stack (n, v, u)."""
    shape, dtype = page.shape, page.dtype
    grey = len(shape) == 2 or (len(shape) == 3 and page.axes.endswith("YX"))
    if not grey or min(shape) < 1 or dtype is None or dtype.kind not in "iuf":
        found = f"a page of shape {shape}, type {dtype}"
        raise InputError(str(path), found, "grey images (rows, columns), or a stack of them")
    tag = page.tags.get(_ORIENTATION)
    if tag is not None and tag.value != 1:
        expected = "1 (row 0 at the top, column 0 on the left)"
        raise InputError(f"{path} tag Orientation", str(tag.value), expected, "turn the images")
    needed = math.prod(shape) * page.bitspersample // 8
    left = min(sum(page.databytecounts), path.stat().st_size - before_bytes * page.bitspersample // (8 * dtype.itemsize))
    if page.compression == _PLAIN and needed > left:
        found = f"a page of shape {shape}, {needed} bytes, in {max(left, 0)} bytes of data"
        raise InputError(str(path), found, "a size that the file can hold", "copy the file again")
