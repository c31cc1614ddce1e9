"""NumPy archives (.npz) of plain arrays, read within bounds: never a pickle, never more memory than was allowed."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError

_MOST_ARRAYS = 64
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # as NumPy writes; others unfold without a bound


def read_npz(
    path: str | Path, what: str, remedy: str, *, most_bytes: int | None = None
) -> dict[str, np.ndarray]:
    """Every array of an archive by its name. Raises InputError, with ``what`` it should have been, if it is damaged.

    most_bytes: of all members together when they are unfolded; None for no more than the file itself has.
    """
    if not Path(path).is_file():  # a pipe would be waited for
        raise InputError(str(path), "no regular file", f"a {what}", remedy)
    try:
        return _arrays(path, Path(path).stat().st_size if most_bytes is None else most_bytes)
    except OSError as error:
        reason = f" ({error.strerror})" if error.strerror else ""
        raise InputError(str(path), f"a damaged {what}{reason}", "a whole one", remedy) from error
    except Exception as error:  # zipfile, zlib and NumPy's parser hand on whatever they stumble over
        raise InputError(str(path), f"a damaged {what}", "a whole one", remedy) from error


def _arrays(path: str | Path, most_bytes: int) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > _MOST_ARRAYS or sum(member.file_size for member in members) > most_bytes:
            raise ValueError("more arrays than are allowed")
        return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    if member.compress_type not in _COMPRESSIONS or not member.filename.endswith(".npy"):
        raise ValueError("not an array as NumPy stores it")
    with archive.open(member) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError("another version of NumPy's format")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
        nbytes = math.prod(shape) * dtype.itemsize
        if (
            dtype.hasobject
            or dtype.kind not in "biufU"
            or min(shape, default=0) < 0
            or nbytes > member.file_size
        ):
            raise ValueError("an array that the file cannot hold")
        values = np.ndarray(shape, dtype, file.read(nbytes), order="F" if fortran else "C")
        file.read()  # to the end, where the checksum is compared
    return values.copy(order="K")
