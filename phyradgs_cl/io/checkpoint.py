"""Checkpoints of interrupted runs: plain arrays in a NumPy archive, never a pickle."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.atomic import written_beside

_FORMAT = 1
_MOST_ARRAYS = 64
_RESTART = "start without --resume"


def checkpoint_path(output: str | Path) -> Path:
    """Where the checkpoint of a run that writes ``output`` lies."""
    return Path(f"{output}.checkpoint.npz")


def write_checkpoint(path: str | Path, arrays: dict[str, np.ndarray], fingerprint: str) -> None:
    """Writes arrays whole or not at all; ``fingerprint`` says which scan and options they belong to."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(_FORMAT), fingerprint=np.array(fingerprint), **arrays)


def read_checkpoint(path: str | Path, fingerprint: str) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint. Raises InputError if it is missing, damaged or of another scan or options."""
    if not Path(path).is_file():
        raise InputError("--resume", f"no checkpoint {path}", "one left by an interrupted run", _RESTART)
    try:
        arrays = _arrays(path)
    except OSError as error:
        reason = f" ({error.strerror})" if error.strerror else ""
        raise InputError(str(path), f"a damaged checkpoint{reason}", "a whole one", _RESTART) from error
    except Exception as error:  # zipfile, and NumPy's parser of headers, hand on whatever they stumble over
        raise InputError(str(path), "a damaged checkpoint", "a whole one", _RESTART) from error
    if not np.array_equal(arrays.pop("format", None), _FORMAT):
        raise InputError(str(path), "another checkpoint format", str(_FORMAT), _RESTART)
    if str(arrays.pop("fingerprint", "")) != fingerprint:
        remedy = f"use the same scan and options, or {_RESTART}"
        raise InputError(
            str(path), "a checkpoint of another scan or other options", "one of this run", remedy
        )
    return arrays


def _arrays(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an archive as it is written here, nothing compressed: together no larger than the file."""
    size = Path(path).stat().st_size
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > _MOST_ARRAYS or sum(member.file_size for member in members) > size:
            raise ValueError("more arrays than the file can hold")
        return {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(".npy"):
        raise ValueError("not an array as it is stored here")
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
