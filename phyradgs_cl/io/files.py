"""Reads regular files up to a size, computes their hashes, and reports this machine's memory."""

import hashlib
import os
import stat
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from phyradgs_cl.errors import InputError

try:
    import resource
except ImportError:  # Windows has no such module
    resource = None  # type: ignore[assignment]

HOST_SHARE = 0.8
"""Fraction of this machine's memory that one array may take; larger ones are refused before they are read."""
_BLOCK_BYTES = 1 << 20  # bytes read at a time for a hash, so that a large file is never in memory as a whole


def regular_file(path: Path, subject: str, expected: str = "a regular file") -> os.stat_result:
    """Returns the status of a readable regular file. Raises InputError about ``subject`` for a missing or unreadable file
    and for a folder. Raises it also for devices and pipes, because reading them may never end."""
    where, remedy = "" if str(path) in subject else f" {path}", "check the path"
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise InputError(subject, f"no file{where}" if where else "no such file", expected, remedy) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL or half a surrogate pair in the name
        reason = getattr(error, "strerror", None) or "no name of a file"
        raise InputError(subject, f"{reason}{where}", expected, remedy) from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "something that is not a regular file"
        raise InputError(subject, f"{kind}{where}", expected, remedy)
    if not os.access(path, os.R_OK):
        raise InputError(subject, f"no permission to read it{where}", expected, "ask whoever owns the file")
    return status


def read_regular(path: Path, subject: str, most_bytes: int, expected: str) -> bytes:
    """Reads a whole regular file. Raises InputError about ``subject`` for one of more than ``most_bytes``."""
    if (size := regular_file(path, subject, expected).st_size) > most_bytes:
        raise InputError(subject, f"{size} bytes", f"at most {most_bytes} bytes for {expected}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(subject, error.strerror or str(error), expected) from error


def decoded(data: bytes) -> str:
    """Decodes a file's text, which may be in UTF-8, in UTF-16 as Windows saves it, or in Windows' code page 1252."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    if data[1:8:2] == bytes(4) or data[:8:2] == bytes(4):  # UTF-16 without a byte order mark
        return data.decode("utf-16-le" if data[1:2] == b"\0" else "utf-16-be", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def sha256_of(path: str | Path, given_up: threading.Event | None = None) -> str:
    """Returns the SHA-256 of a file, or of a folder's file names and their hashes, as 64 hexadecimal digits. given_up: when
    set, ends the computation early; the result then means nothing. Raises InputError for a file that cannot be read."""
    digest, subject = hashlib.sha256(), str(path)
    if (folder := Path(path)).is_dir():
        for part in sorted(part for part in folder.rglob("*") if part.is_file()):
            digest.update(f"{part.relative_to(folder)} {sha256_of(part, given_up)}\n".encode())
        return digest.hexdigest()
    regular_file(Path(path), subject, "a readable file")
    try:
        with open(path, "rb") as file:
            while not (given_up and given_up.is_set()) and (block := file.read(_BLOCK_BYTES)):
                digest.update(block)
    except OSError as error:
        raise InputError(subject, error.strerror or str(error), "a readable file") from error
    return digest.hexdigest()


@contextmanager
def hashing(path: str | Path) -> Iterator[Callable[[], str]]:
    """Hashes a file while the caller reads it, so that the disk is read once. Yields a function that returns the SHA-256."""
    given_up = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        try:
            yield pool.submit(sha256_of, path, given_up).result
        finally:
            given_up.set()


def host_bytes() -> float:
    """Returns this machine's memory in bytes; infinity if the system does not report it."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return float("inf")


def free_bytes() -> float:
    """Returns the memory in bytes that this process may still take: what Linux calls available, elsewhere all memory. A
    limit of the process' address space lowers the result."""
    free = host_bytes()
    with suppress(OSError, ValueError, IndexError):
        free = 1024.0 * int(Path("/proc/meminfo").read_text().partition("MemAvailable:")[2].split()[0])
    limit = -1 if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]
    return free if limit < 0 else min(free, limit - in_use_bytes("VmSize:"))


def in_use_bytes(field: str) -> int:
    """Returns a field of Linux' /proc/self/status for this process, in bytes: "VmHWM:" is the peak of resident memory,
    "VmSize:" the address space. Returns 0 on other systems."""
    try:
        return 1024 * int(Path("/proc/self/status").read_text().partition(field)[2].split()[0])
    except (OSError, ValueError, IndexError):
        return 0
