"""Reading small texts and NumPy arrays whose size is bounded by the file's own, and by this machine's memory."""

import json
import math
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.memory import HOST_SHARE, host_bytes
from phyradgs_cl.io.regular import read_regular, regular_file
from phyradgs_cl.io.tables import LARGEST

MOST_TEXT_BYTES = 64 << 20


def check_room(subject: str, needed_bytes: int) -> None:
    """InputError for what would take more than its share of this machine's memory."""
    most = HOST_SHARE * host_bytes()
    if needed_bytes > most:
        found, expected = (f"{n / 2**30:.3g} GiB" for n in (needed_bytes, most))
        remedy = "import fewer frames at a time, or bin them"
        raise InputError(subject, f"{found} to unpack", f"at most {expected} on this machine", remedy)


def read_bytes(path: Path) -> bytes:
    """A whole file, of a description's size at most."""
    return read_regular(path, str(path), MOST_TEXT_BYTES, "a description of a scan")


def read_json(path: Path) -> dict[str, object]:
    """The object that a JSON file holds."""
    try:
        content = json.loads(read_bytes(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise InputError(str(path), f"text that is not JSON ({error})", "a JSON object") from error
    if not isinstance(content, dict):
        raise InputError(str(path), f"JSON {type(content).__name__}", "a JSON object")
    return content


def read_numbers(path: Path, count: int, what: str) -> np.ndarray:
    """(count,) finite numbers of a text file, one per line; empty lines and what follows a # are passed over."""
    values = []
    for number, line in enumerate(read_bytes(path).decode("utf-8-sig", "replace").splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST:
            raise InputError(f"{path} line {number}", repr(text[:40]), "a finite number")
        values.append(value)
    if len(values) != count:
        raise InputError(str(path), f"{len(values)} {what}", f"{count}, one for each frame")
    return np.array(values)


def read_npy(path: Path, ndim: int) -> np.ndarray:
    """A numeric array of a .npy file, C order; never a pickle, never larger than the file says."""
    subject = str(path)
    regular_file(path, subject)
    try:
        with open(path, "rb") as file:
            version = np.lib.format.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise InputError(subject, f"version {version}", "a .npy file of version 1.0 or 2.0")
            read = getattr(np.lib.format, f"read_array_header_{version[0]}_0")
            shape, fortran, dtype = read(file)
            check_array(subject, shape, dtype, path.stat().st_size - file.tell(), ndim)
            values = np.fromfile(file, dtype, math.prod(shape))
    except (InputError, MemoryError):
        raise
    except Exception as error:  # NumPy hands on whatever Python's parser and tokeniser stumble over
        raise InputError(subject, f"a damaged .npy file ({error})", "a NumPy array") from error
    values = values.reshape(shape, order="F" if fortran else "C")
    return np.ascontiguousarray(values)


def check_array(
    subject: str, shape: tuple[int, ...], dtype: np.dtype, available_bytes: int, ndim: int
) -> None:
    """InputError unless an uncompressed array of numbers fits into the bytes that there are."""
    if dtype.kind not in "iuf" or dtype.itemsize not in (1, 2, 4, 8):
        raise InputError(subject, f"type {dtype}", "plain real numbers")
    if len(shape) != ndim or min(shape, default=0) < 1:
        raise InputError(subject, f"shape {shape}", f"{ndim} axes, none of them empty")
    needed = math.prod(shape) * dtype.itemsize
    if needed > available_bytes:
        found = f"shape {shape}, {needed} bytes, in {available_bytes} bytes of data"
        raise InputError(subject, found, "as many bytes as its header announces", "copy the file again")
