"""OLE2 containers of numbers, as Zeiss writes them: streams of a size that the file can hold, read one by one."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.files import check_room
from phyradgs_cl.io.files import regular_file

_RESULT_BYTES = 5  # per pixel: a line integral in float32, and its mask


@contextmanager
def open_ole(path: Path) -> Iterator[Any]:
    """Yields an open container of olefile. Any error of the library in the body becomes InputError."""
    regular_file(path, str(path))
    olefile = checks.package("olefile", "the package that reads .txrm", "phyradgs-cl[formats]")
    try:
        with olefile.OleFileIO(str(path)) as ole:
            yield ole
    except (InputError, MemoryError):
        raise
    except Exception as error:  # damage raises any exception
        found = f"a container that cannot be read ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(str(path), found, "an OLE2 file") from error


def read_stream(ole: Any, path: Path, name: str, dtype: str, most_values: int) -> np.ndarray:
    """Returns a stream as numbers (n,). InputError for a stream that is larger than its file, or than ``most_values``."""
    subject, size = f"{path}: {name}", ole.get_size(name)
    most_bytes = min(path.stat().st_size, most_values * np.dtype(dtype).itemsize)
    if size > most_bytes:
        raise InputError(subject, f"{size} bytes", f"at most {most_bytes}")
    data = ole.openstream(name).read(size)
    return np.frombuffer(data[: len(data) - len(data) % np.dtype(dtype).itemsize], dtype)


def read_images(ole: Any, path: Path, names: list[str], dtype: str, panel: tuple[int, int]) -> np.ndarray:
    """Returns images (F, v, u), one per stream, row 0 as stored. InputError for more of them than the file can hold."""
    pixels, pixel_bytes = panel[0] * panel[1], np.dtype(dtype).itemsize
    if len(names) * pixels * pixel_bytes > path.stat().st_size:
        found = f"{len(names)} images of {panel[0]} × {panel[1]} pixels in {path.stat().st_size} bytes"
        raise InputError(str(path), found, "as many as the file can hold", "copy the file again")
    check_room(str(path), len(names) * pixels * (pixel_bytes + _RESULT_BYTES))
    stack = np.empty((len(names), *panel), dtype)
    for image, name in zip(stack, names, strict=True):
        if not ole.exists(name):
            raise InputError(f"{path}: {name}", "nothing", "an image")
        values = read_stream(ole, path, name, dtype, pixels)
        if len(values) != pixels:
            raise InputError(f"{path}: {name}", f"{len(values)} pixels", f"{panel[0]} × {panel[1]}")
        image[:] = values.reshape(panel)
    return stack
