"""OLE2 containers of numbers, as Zeiss writes them, by olefile."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.files import check_room
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.io.tables import LARGEST, Fields

_RESULT_BYTES = 5  # per pixel: a line integral in float32, and its mask
_STEADY = 1e-3  # relative: how far the lengths of single images may differ


class Streams(Fields):
    """Streams of numbers by their names. They may have room for more images than were taken."""

    def first_of(self, name: str, lowest: float = -LARGEST, highest: float = LARGEST) -> float:
        """Returns the first number of a stream, which is between two bounds."""
        return Fields(self.subject, {name: float(self.leading(name, 1)[0])}).number(name, lowest=lowest, highest=highest)

    def leading(self, name: str, count: int) -> np.ndarray:
        """Returns the first ``count`` numbers (count,) of a stream."""
        if len(values := self.numbers(name)) < count:
            raise self.error(name, f"{len(values)} numbers", f"{count}, one for each image")
        return values[:count]

    def steady(self, name: str) -> float:
        """Returns a length above 0 that is the same for all images, without its sign."""
        lengths = np.abs(self.numbers(name))
        lengths = lengths[lengths > 0]
        if not len(lengths) or np.ptp(lengths) > _STEADY * lengths[0]:
            raise self.error(name, f"{np.ptp(lengths):g} between images" if len(lengths) else "0", "one length above 0 mm")
        return float(lengths[0])


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


def read_stream(ole: Any, path: Path, name: str, dtype: str) -> np.ndarray:
    """Returns a stream as numbers (n,). InputError for a missing one, and for one that is larger than its file."""
    found, most = f"{ole.get_size(name)} bytes" if ole.exists(name) else "nothing", path.stat().st_size
    if found == "nothing" or ole.get_size(name) > most:
        raise InputError(f"{path}: {name}", found, f"numbers in at most {most} bytes")
    data = ole.openstream(name).read()
    return np.frombuffer(data, dtype, len(data) // np.dtype(dtype).itemsize)


def read_images(ole: Any, path: Path, names: list[str], dtype: str, panel: tuple[int, int]) -> np.ndarray:
    """Returns images (F, v, u), one per stream, row 0 as stored."""
    check_room(str(path), len(names) * panel[0] * panel[1] * (np.dtype(dtype).itemsize + _RESULT_BYTES))
    stack = np.empty((len(names), *panel), dtype)
    for image, name in zip(stack, names, strict=True):
        values = read_stream(ole, path, name, dtype)
        if len(values) != panel[0] * panel[1]:
            raise InputError(f"{path}: {name}", f"{len(values)} pixels", f"{panel[0]} × {panel[1]}")
        image[:] = values.reshape(panel)
    return stack
