"""Writes outputs completely or not at all: each is written under another name first, and then renamed. A lock file keeps two
runs from writing one output. Checkpoints of interrupted runs are plain arrays in a NumPy archive, never a pickle."""

import errno
import glob
import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from zlib import crc32

import numpy as np

from phyradgs_cl.errors import InputError, OutputError

NO_SPACE = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
"""Error numbers of a full disk, a file that is too large, and a user's exhausted quota."""
# A temporary name takes at most so many characters of the target's name: at 4 bytes each, it stays below 255 bytes.
_LONGEST = 50
_LONGEST_BYTES = 255  # longest file name that common file systems allow
_SPARE_BYTES = 1 << 16  # room on the disk that is reserved for headers, besides the arrays
_WRITER = re.compile(r"\.([0-9a-f]{8})-(\d{1,9})-[0-9a-f]{8}\.part(\.[a-z.]+)?$")
_FORMAT = 2  # version of the checkpoint format; other versions are refused
_RESTART = "start without --resume"


class BusyError(OutputError):
    """Raised if another run is writing the same output."""


def check_writable(path: str | Path) -> None:
    """Raises OutputError if ``path`` could not be written later. Tests it by creating an empty file in its folder."""
    _create_beside(_target(path)).unlink()


def refuse_overwriting(option: str, output: str | Path, *others: Path | None) -> None:
    """Raises InputError about ``option`` if the output is also one of a command's other files."""
    for path in others:
        if path is not None and Path(output).resolve() == path.resolve():
            raise InputError(option, f"{path}, which the command reads or writes", "another file to write")


def make_folder(folder: Path, subject: Path) -> None:
    """Creates a folder and its parents. Raises OutputError about ``subject`` if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(str(subject), error.strerror or str(error), "a folder that can be written") from error


def lock_path(output: str | Path) -> Path:
    """Returns the path of the lock file of ``output``. A lock file that a dead process left locks nothing."""
    return beside(Path(os.path.realpath(output)), ".lock", ".")


@contextmanager
def only_run(output: str | Path) -> Iterator[None]:
    """Locks ``output`` against other runs. The system releases the lock when a process ends. Raises BusyError if another
    run has the lock, OutputError if the lock file cannot be created."""
    from filelock import FileLock, Timeout

    path = lock_path(output)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        remedy = "wait for it, or choose another output"
        raise BusyError(str(output), "another run at work on it", "one run per output", remedy) from None
    except OSError as error:
        found = f"{error.strerror or error} for its lock {path}"
        raise OutputError(str(output), found, "a folder that can be written", "choose another") from error
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # before the release, so that a waiting process sees that the file is gone
        lock.release()


@contextmanager
def written_beside(path: str | Path, size_bytes: int = 0, suffix: str = "") -> Iterator[Path]:
    """Yields a temporary path in the target's folder. On success it is renamed to the target. After an error an existing
    target is unchanged, and errors of the system become OutputError about ``path``.

    size_bytes: room on the disk that is reserved first, since some libraries crash on a full disk or do not notice it.
    suffix: ending of the temporary name, by which some libraries choose the format."""
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
    """Returns the file to write: ``path``, or where its symbolic link leads. Raises OutputError if it cannot be written."""
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
        raise OutputError(shown, "a write-protected file", "a file that may be replaced", "choose another name")
    if not target.parent.is_dir():
        raise OutputError(shown, f"no folder {target.parent}", "an existing folder", "create the folder first")
    return target


def _create_beside(target: Path, suffix: str = "") -> Path:
    temporary = temporary_name(target, suffix)
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except OSError as error:
        found = f"{error.strerror or error} in folder {target.parent}"
        remedy = "choose another folder or change its permissions"
        raise OutputError(str(target), found, "a folder that can be written", remedy) from error
    return temporary


def temporary_name(target: Path, suffix: str = "") -> Path:
    """Returns a new temporary path in the target's folder. Its name states this machine and process, so that temporary files
    of the same target that dead processes left are found and removed."""
    for path in target.parent.glob(f".{glob.escape(target.stem[:_LONGEST])}*.part*"):
        writer = _WRITER.search(path.name)
        if writer and writer[1] == _machine() and _is_dead(int(writer[2])):
            with suppress(OSError):  # ``path`` is a folder, or another process has removed it
                path.unlink()
            shutil.rmtree(path, ignore_errors=True)
    writer_now = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    return target.with_name(f".{target.name[:_LONGEST]}.{writer_now}.part{suffix}")


@cache
def _machine() -> str:
    """Returns a hash of this machine and its container (PID namespace), within which process numbers are unique."""
    namespace = ""
    with suppress(OSError):
        namespace = os.readlink("/proc/self/ns/pid")
    return f"{crc32(f'{platform.node()} {namespace}'.encode()):08x}"


def _is_dead(process: int) -> bool:
    if os.name != "posix":  # on Windows os.kill would end the process
        return False
    try:
        os.kill(process, 0)
    except OSError as error:
        return isinstance(error, ProcessLookupError)  # another error: the process lives, but is another user's
    return False


def _flush_folder(folder: Path) -> None:
    """Writes a folder's list of names to the disk, so that renaming survives a power cut. Not all systems allow it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _output_error(target: Path, error: BaseException) -> OutputError:
    code, words = getattr(error, "errno", None), str(error)
    # HDF5 names the system's error in its text, and NumPy the part that was written
    if code in NO_SPACE or " requested and " in words or any(f"errno = {number}," in words for number in NO_SPACE):
        found = f"no room left in folder {target.parent}"
        expected = "enough space on the disk"
        return OutputError(str(target), found, expected, "free some space or choose another folder")
    if code == errno.ENAMETOOLONG:
        return OutputError(str(target), "a file name that is too long", "a shorter name", "shorten the name")
    found = getattr(error, "strerror", None) or words
    return OutputError(str(target), found, "a file that can be written", "choose another folder")


def shortened(name: str, most_bytes: int) -> str:
    """Returns ``name``; if it is longer than ``most_bytes``, its start and a hash of the whole name."""
    raw = os.fsencode(name)
    if len(raw) <= most_bytes:
        return name
    ending = f"~{hashlib.sha256(raw).hexdigest()[:12]}"
    return raw[: most_bytes - len(ending)].decode("utf-8", "ignore") + ending


def beside(path: str | Path, ending: str, beginning: str = "") -> Path:
    """Returns the path ``beginning`` + name + ``ending`` in the same folder. Shortens names of more than 255 bytes."""
    room = _LONGEST_BYTES - len(os.fsencode(beginning + ending))
    path = Path(path)
    return path.with_name(f"{beginning}{shortened(path.name, room)}{ending}")


def checkpoint_path(output: str | Path) -> Path:
    return beside(output, ".checkpoint.npz")


def former_checkpoint_path(output: str | Path) -> Path:
    """Returns where a new run keeps the checkpoint of an earlier run with the same output."""
    return beside(output, ".checkpoint.npz.bak")


def partial_path(output: str | Path) -> Path:
    """Returns where an interrupted run writes its result: NAME.partial.SUFFIX for ``output`` NAME.SUFFIX. Raises OutputError
    for a path without a name, as "." and "/" are."""
    path = Path(output)
    if not path.name:
        raise OutputError(str(output), "a folder", "a file that can be written", "add the file's name")
    return beside(path.with_suffix(""), f".partial{path.suffix}")


def write_checkpoint(path: str | Path, state: Mapping[str, np.ndarray]) -> None:
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(_FORMAT), **state)  # type: ignore[arg-type]


def read_checkpoint(path: str | Path) -> dict[str, np.ndarray]:
    """Returns a checkpoint's arrays by name. Raises InputError for a missing or damaged file, and for another version's."""
    if not Path(path).is_file():
        raise InputError("--resume", f"no checkpoint {path}", "one left by an interrupted run", _RESTART)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        if not all(isinstance(values, np.ndarray) for values in arrays.values()):
            raise ValueError("no array")
    except Exception as error:  # zipfile, zlib and NumPy's parser raise exceptions of every kind
        reason = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise InputError(str(path), f"a damaged checkpoint{reason}", "a complete one", _RESTART) from error
    if not np.array_equal(arrays.pop("format", None), _FORMAT):
        raise InputError(str(path), "a checkpoint of another version", f"format {_FORMAT}", _RESTART)
    return arrays
