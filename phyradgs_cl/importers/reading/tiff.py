"""Grey TIFF images, plain or deflated, one or many per file, of a size that the file can hold."""

import logging
import math
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.files import SafeFolder, check_numbering, check_room
from phyradgs_cl.io.files import regular_file

SUFFIXES = (".tif", ".tiff")
_MOST_EXPANSION = 1200  # of a compressed image: deflate reaches 1032
_MOST_PAGES = 100_000
_PLAIN, _DEFLATED = 1, (8, 32946)
_FREE_BYTES, _BLOCK_BYTES = 16 << 20, 16 << 20
_RESULT_BYTES = 5  # per pixel: a line integral in float32, and its mask
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
    for path in paths:
        with _opened(path) as tiff:
            for page in tiff.pages:
                images = math.prod(page.shape[:-2])
                if page.compression in _DEFLATED:
                    _check_inflation(path, page, _chunk(page))
                page.asarray(maxworkers=1, out=stack[at : at + images].reshape(page.shape))
                at += images
    return stack


def read_series(
    folder: SafeFolder, prefix: str, shape: tuple[int | None, ...], subject: str | Sequence[str], pattern: str = r"\d+"
) -> np.ndarray:
    """Reads the TIFFs of a folder whose names are ``prefix`` and a number: frames (F, v, u) of ``shape``, in the numbers'
    order; None is any size. ``pattern``: a number in the names; ``subject`` names what states the shape, or each of its
    three sizes."""
    subjects = [subject] * 3 if isinstance(subject, str) else subject
    name = re.compile(re.escape(prefix) + pattern, re.I)
    paths = [path for path in folder.matching(*SUFFIXES) if name.fullmatch(path.stem)]
    if not paths or shape[0] not in (None, len(paths)):
        found = f"{len(paths)} files {prefix[:60]}*.tif in {folder.root}"
        expected = f"{shape[0]}, one for every projection" if shape[0] else "at least one"
        raise InputError(subjects[0], found, expected, "copy the missing files")
    check_numbering(paths, "copy the missing files")
    sizes = stack_shape(paths)
    sides = zip(subjects, sizes, shape, strict=True)
    if wrong := [name for name, size, stated in sides if stated not in (None, size)]:
        found = f"{sizes[0]} images of {sizes[1]} × {sizes[2]} pixels"
        expected = " × ".join(str(n or "any") for n in shape)
        raise InputError(str(paths[0]), found, expected, f"see {', '.join(dict.fromkeys(wrong))}")
    return read_tiffs(paths)


def stack_shape(paths: list[Path]) -> tuple[int, int, int]:
    """Returns the shape (frames, rows, columns) that ``read_tiffs`` would read, from headers alone; rows and columns of the
    first file."""
    headers = [_header(path) for path in paths]
    rows, columns = headers[0].shape
    return sum(header.images for header in headers), rows, columns


def _header(path: Path) -> _Header:
    """Returns the images of one file, after a check of every page against the size of the file."""
    with _opened(path) as tiff:
        images = pages = total_bytes = 0
        for page in tiff.pages:
            if pages >= _MOST_PAGES:
                raise InputError(str(path), f"more than {_MOST_PAGES} pages", "fewer pages")
            _check_page(path, page, total_bytes)
            if pages == 0:
                shape, dtype = page.shape[-2:], page.dtype
            if (page.shape[-2:], page.dtype) != (shape, dtype):
                raise InputError(str(path), "pages of several sizes or types", "one for all frames")
            pages, images = pages + 1, images + math.prod(page.shape[:-2])
            total_bytes = images * math.prod(shape) * dtype.itemsize
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
        raise InputError(str(path), found, "grey images, uncompressed or deflated") from error


def imagej_calibration(path: Path) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """Returns the voxel sizes (x, y, z) in mm, the origin's place (x, y, z) in voxels and the text "Info" of a stack.
    ImageJ wrote the stack, or tifffile, which keeps the same values of a BigTIFF as JSON. None stands for missing values.
    Call ``read_tiffs`` first."""
    tifffile = checks.package("tifffile", "the package that reads TIFF", "phyradgs-cl[formats]")
    try:
        with _quiet("tifffile"), tifffile.TiffFile(path) as tiff:
            facts: dict[str, Any] = tiff.imagej_metadata or (tiff.shaped_metadata or ({},))[0]
            per_mm = [np.divide(*tiff.pages[0].tags[f"{axis}Resolution"].value) for axis in "XY"]
        sizes = np.array([1 / per_mm[0], 1 / per_mm[1], float(facts["spacing"])])
        if facts.get("unit") != "mm" or not np.all(np.isfinite(sizes) & (sizes > 0)):
            return None, None, ""
        origin = np.array([float(facts.get(f"{axis}origin", np.nan)) for axis in "xyz"])
        return sizes, origin if np.isfinite(origin).all() else None, str(facts.get("Info", ""))
    except (KeyError, TypeError, ValueError, ZeroDivisionError, tifffile.TiffFileError):
        return None, None, ""


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
    if page.compression not in (_PLAIN, *_DEFLATED):
        found = f"a page with compression {int(page.compression)}"
        raise InputError(str(path), found, "plain or deflated images", "save them uncompressed")
    needed = math.prod(shape) * dtype.itemsize
    size, here = path.stat().st_size, sum(page.databytecounts)
    most = 1 if page.compression == _PLAIN else _MOST_EXPANSION
    if needed > here * most or needed + before_bytes > size * most or _chunk(page) > 4 * needed + _FREE_BYTES:
        found = f"a page of shape {shape}, {needed} bytes, in {min(here, size)} bytes of data"
        raise InputError(str(path), found, "a size that the file can hold", "copy the file again")


def _chunk(page: Any) -> int:
    return math.prod(page.chunks) * page.dtype.itemsize


def _check_inflation(path: Path, page: Any, most: int) -> None:
    """Refuses a strip that unpacks to more than its pixels: the library would unpack all of it."""
    with open(path, "rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            packed, machine, left = file.read(count), zlib.decompressobj(), most
            while packed and left >= 0:
                left -= len(machine.decompress(packed, _BLOCK_BYTES))
                packed = machine.unconsumed_tail
            if left < 0:
                found = f"a strip of more than {most} bytes"
                raise InputError(str(path), found, "as many as its pixels take")
