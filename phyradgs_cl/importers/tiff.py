"""Grey TIFF images, plain or deflated, one a file or many in one, of a size that the file can hold."""

from __future__ import annotations

import logging
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.folder import regular_file

SUFFIXES = (".tif", ".tiff")
_MOST_EXPANSION = 1200  # of a compressed image: deflate reaches 1032
_MOST_PAGES = 100_000
_PLAIN, _DEFLATED = 1, (8, 32946)
_FREE_BYTES = 16 << 20
_ORIENTATION = 274  # 1: row 0 at the top, column 0 on the left


def read_tiffs(paths: list[Path]) -> np.ndarray:
    """Frames (F, v, u) in the files' own type, row 0 as stored; every page of every file, in order."""
    images = [image for path in paths for image in read_pages(path)]
    first = images[0]
    for path, image in zip(paths, images, strict=False):
        if image.shape != first.shape or image.dtype != first.dtype:
            found, expected = (
                f"{image.shape} {image.dtype}",
                f"{first.shape} {first.dtype} as in {paths[0].name}",
            )
            raise InputError(str(path), found, expected)
    if any(image.shape != first.shape for image in images):
        raise InputError(str(paths[0].parent), "images of several sizes", "one size for all frames")
    return np.stack(images)


def read_pages(path: Path) -> list[np.ndarray]:
    """The pages of one file, each (v, u)."""
    regular_file(path, str(path))
    tifffile = _library()
    try:
        with _quiet("tifffile"), tifffile.TiffFile(path) as tiff:
            pages, total_bytes = [], 0
            for page in tiff.pages:
                if len(pages) >= _MOST_PAGES:
                    raise InputError(str(path), f"more than {_MOST_PAGES} pages", "fewer pages")
                pages.append(_page(path, page, total_bytes))
                total_bytes += pages[-1].nbytes
    except InputError:
        raise
    except MemoryError:
        raise
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable TIFF") from error
    except Exception as error:  # damage shows as whatever the decoder stumbles over
        found = f"a TIFF that cannot be read ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(str(path), found, "grey images, uncompressed or deflated") from error
    if not pages:
        raise InputError(str(path), "no page", "at least one image")
    return pages


def imagej_calibration(path: Path) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """Voxel sizes (x, y, z) mm and the origin's place (x, y, z) in voxels, where a stack states them; and its "Info".

    Of ImageJ's own stacks, and of BigTIFF in which tifffile keeps the same words as JSON. Call ``read_pages`` first.
    """
    tifffile = _library()
    try:
        with _quiet("tifffile"), tifffile.TiffFile(path) as tiff:
            facts = tiff.imagej_metadata or (tiff.shaped_metadata or ({},))[0]
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
    """Keeps a library from logging a line for every damaged tag: one error says it all."""
    logger = logging.getLogger(name)
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def _page(path: Path, page: Any, before_bytes: int) -> np.ndarray:
    """One page (v, u); what it needs is compared with what is there before anything is decoded."""
    shape, dtype = page.shape, page.dtype
    if len(shape) != 2 or min(shape) < 1 or dtype is None or dtype.kind not in "iuf":
        raise InputError(str(path), f"a page of shape {shape}, type {dtype}", "grey images (rows, columns)")
    tag = page.tags.get(_ORIENTATION)
    if tag is not None and tag.value != 1:
        expected = "1 (row 0 at the top, column 0 on the left)"
        raise InputError(f"{path} tag Orientation", str(tag.value), expected, "turn the images")
    if page.compression not in (_PLAIN, *_DEFLATED):
        found = f"a page with compression {int(page.compression)}"
        raise InputError(str(path), found, "plain or deflated images", "save them uncompressed")
    needed = math.prod(shape) * dtype.itemsize
    chunk = math.prod(page.chunks) * dtype.itemsize
    size, here = path.stat().st_size, sum(page.databytecounts)
    most = 1 if page.compression == _PLAIN else _MOST_EXPANSION
    if needed > here * most or needed + before_bytes > size * most or chunk > 4 * needed + _FREE_BYTES:
        found = f"a page of shape {shape}, {needed} bytes, in {min(here, size)} bytes of data"
        raise InputError(str(path), found, "a size that the file can hold", "copy the file again")
    if page.compression in _DEFLATED:
        _check_inflation(path, page, chunk)
    return page.asarray(maxworkers=1)


def _check_inflation(path: Path, page: Any, most: int) -> None:
    """The library unpacks a strip to its end; one that has more in it than its pixels is refused before that."""
    with open(path, "rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            if len(zlib.decompressobj().decompress(file.read(count), most + 1)) > most:
                raise InputError(
                    str(path), f"a strip of more than {most} bytes", "as many as its pixels take"
                )


def _library() -> ModuleType:
    try:
        import tifffile
    except ImportError as error:
        remedy = "pip install 'phyradgs-cl[formats]'"
        raise InputError("tifffile", "not installed", "the package that reads TIFF", remedy) from error
    return tifffile
