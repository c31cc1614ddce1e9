"""Files that a user or another file names, opened without waiting: a device, a pipe or a file of /proc may never end."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from phyradgs_cl.errors import InputError

_NO_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)


def regular_file(path: Path, subject: str, expected: str = "a regular file") -> os.stat_result:
    """What the system says of a file that exists and is no folder, device or pipe; InputError about all others."""
    where = "" if str(path) in subject else f" {path}"
    try:
        found = os.stat(path)
    except FileNotFoundError as error:
        what = f"no file{where}" if where else "no such file"
        raise InputError(subject, what, expected, "check the path") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL, or half a surrogate pair
        what = getattr(error, "strerror", None) or "no name of a file"
        raise InputError(subject, f"{what}{where}", expected, "check the path") from error
    if not stat.S_ISREG(found.st_mode):
        what = "a folder" if stat.S_ISDIR(found.st_mode) else "something that is not a regular file"
        raise InputError(subject, f"{what}{where}", expected, "check the path")
    if not os.access(path, os.R_OK):
        raise InputError(subject, f"no permission to read it{where}", expected, "ask whoever owns the file")
    return found


@contextmanager
def open_regular(path: Path, subject: str, expected: str = "a regular file") -> Iterator[tuple[BinaryIO, int]]:
    """A file to read and its size, beyond which nothing is read; errors of the system in the body become InputError."""
    regular_file(path, subject, expected)
    try:
        with open(os.open(path, os.O_RDONLY | _NO_WAITING), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise InputError(subject, "something that is not a regular file", expected)
            yield file, found.st_size
    except OSError as error:
        raise InputError(subject, error.strerror or str(error), expected) from error


def read_regular(path: Path, subject: str, most_bytes: int, expected: str) -> bytes:
    """All bytes of a file of at most ``most_bytes``."""
    with open_regular(path, subject, expected) as (file, size):
        if size > most_bytes:
            raise InputError(subject, f"{size} bytes", f"at most {most_bytes} bytes for {expected}")
        return file.read(size)
