"""Outputs that are there whole or not at all: written beside the target, then moved over it; names of files beside."""

import errno
import glob
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from zlib import crc32

from phyradgs_cl.errors import OutputError

NO_SPACE = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
"""What an operating system says where there is no room: the disk, the largest file, the user's share."""
_LONGEST = 50  # characters of the target's name, of up to four bytes each: names end at 255
_SPARE_BYTES = 1 << 16  # for headers beside the arrays
_WRITER = re.compile(r"\.([0-9a-f]{8})-(\d{1,9})-[0-9a-f]{8}\.part(\.[a-z.]+)?$")


def check_writable(path: str | Path) -> None:
    """Raise OutputError now if ``path`` could not be written later: makes, and removes, an empty file in its folder."""
    _create_beside(_target(path)).unlink()


def make_folder(folder: Path, subject: Path) -> None:
    """Makes a folder, and those above it; OutputError about ``subject`` where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        found = error.strerror or str(error)
        raise OutputError(str(subject), found, "a folder that can be written") from error


@contextmanager
def written_beside(path: str | Path, size_bytes: int = 0, suffix: str = "") -> Iterator[Path]:
    """Yields a temporary path in the target's folder that replaces the target on success, in one step. After an error an
    existing target has its old content, and system errors of the body become OutputError about ``path``.

    ``size_bytes``: of the arrays to be written. Their room is reserved first, for libraries that crash on a full disk or do
    not notice it. ``suffix``: the ending of the temporary name, for libraries that go by it.
    """
    target = _target(path)
    temporary = _create_beside(target, suffix)
    try:
        if size_bytes and hasattr(os, "posix_fallocate"):
            with open(temporary, "r+b") as file:
                os.posix_fallocate(file.fileno(), 0, size_bytes + _SPARE_BYTES)
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
        _flush_folder(target.parent)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) or (isinstance(error, RuntimeError) and "errno = " in str(error)):
            raise _output_error(target, error) from error
        raise


def _target(path: str | Path) -> Path:
    """The file to write, behind any symbolic link; OutputError if it, or its folder, will not do."""
    shown = str(path)
    if not shown or shown.endswith(("/", os.sep)) or os.path.isdir(shown):
        raise OutputError(shown or "output path", "a folder", "a file name", "add a file name to the path")
    target = Path(os.path.realpath(shown))
    try:
        mode = target.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        mode = None
    except OSError as error:
        raise _output_error(target, error) from error
    if mode is not None and not stat.S_ISREG(mode):
        raise OutputError(shown, "something that is not a regular file", "a file name")
    if mode is not None and not os.access(target, os.W_OK):
        expected = "a file that may be replaced"
        raise OutputError(shown, "a write-protected file", expected, "choose another name")
    if not target.parent.is_dir():
        expected = "an existing folder"
        raise OutputError(shown, f"no folder {target.parent}", expected, "create the folder first")
    return target


def _create_beside(target: Path, suffix: str = "") -> Path:
    """Creates an empty file in the target's folder, with the permissions of the user's umask."""
    temporary = temporary_name(target, suffix)
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        found = f"{error.strerror or error} in folder {target.parent}"
        remedy = "choose another folder or change its permissions"
        raise OutputError(str(target), found, "a folder that can be written", remedy) from error
    return temporary


def temporary_name(target: Path, suffix: str = "") -> Path:
    """Returns a new name beside ``target`` that holds the number of this process; removes files that dead processes left."""
    for path in target.parent.glob(f".{glob.escape(target.stem[:_LONGEST])}*.part*"):
        writer = _WRITER.search(path.name)
        if writer and writer[1] == _machine() and _is_dead(int(writer[2])):
            _discard(path)
    writer_now = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    return target.with_name(f".{target.name[:_LONGEST]}.{writer_now}.part{suffix}")


@cache
def _machine() -> str:
    """Where process numbers mean the same: a machine, or a container on it."""
    namespace = ""
    with suppress(OSError):
        namespace = os.readlink("/proc/self/ns/pid")
    return f"{crc32(f'{platform.node()} {namespace}'.encode()):08x}"


def _is_dead(process: int) -> bool:
    if os.name != "posix":  # elsewhere asking ends the process
        return False
    try:
        os.kill(process, 0)
    except OSError as error:
        return isinstance(error, ProcessLookupError)  # others say that it is somebody else's
    return False


def _discard(path: Path) -> None:
    """Removes a file or a folder, if it can be removed."""
    try:
        path.unlink()
    except OSError:  # a folder, or removed by another process
        shutil.rmtree(path, ignore_errors=True)


def _flush_folder(folder: Path) -> None:
    """Make the renaming itself durable where folders can be opened; elsewhere there is nothing to do."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _output_error(target: Path, error: BaseException) -> OutputError:
    code = getattr(error, "errno", None)
    full = code in NO_SPACE or any(f"errno = {number}," in str(error) for number in NO_SPACE)
    if full:
        found = f"no room left in folder {target.parent}"
        expected = "enough space on the disk"
        return OutputError(str(target), found, expected, "free some space or choose another folder")
    if code == errno.ENAMETOOLONG:
        return OutputError(str(target), "a file name that is too long", "a shorter name", "shorten the name")
    found = getattr(error, "strerror", None) or str(error)
    return OutputError(str(target), found, "a file that can be written", "choose another folder")


_LONGEST_BYTES = 255  # of a name, in every file system that is common


def shortened(name: str, most_bytes: int) -> str:
    """``name``, or as much of it as fits in front of a digest of all of it."""
    raw = os.fsencode(name)
    if len(raw) <= most_bytes:
        return name
    ending = f"~{hashlib.sha256(raw).hexdigest()[:12]}"
    return raw[: most_bytes - len(ending)].decode("utf-8", "ignore") + ending


def beside(path: str | Path, ending: str, beginning: str = "") -> Path:
    """The path ``beginning`` + name + ``ending`` in the same folder, shortened where no file system would take it."""
    room = _LONGEST_BYTES - len(os.fsencode(beginning + ending))
    path = Path(path)
    return path.with_name(f"{beginning}{shortened(path.name, room)}{ending}")
