"""One run an output: a lock file beside it that the operating system lets go of when its process ends, however it ends."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from phyradgs_cl import signals
from phyradgs_cl.errors import OutputError
from phyradgs_cl.io.names import beside

try:
    import fcntl
except ImportError:  # Windows has no such locks: two runs on one output are not noticed there
    fcntl = None  # type: ignore[assignment]


_LOOK_EVERY_S = 0.2


class BusyError(OutputError):
    """Another run is at work on the output."""


def lock_path(output: str | Path) -> Path:
    """The lock file of ``output``; it is there while a run is, and means nothing once that has ended."""
    target = Path(os.path.realpath(output))
    return beside(target, ".lock", ".")


@contextmanager
def only_run(output: str | Path, wait_s: float = 0.0) -> Iterator[None]:
    """Holds the lock of ``output``; raises BusyError if another run still does after ``wait_s``.

    A dead run's file is taken over.
    """
    if fcntl is None:
        yield
        return
    path = lock_path(output)
    descriptor = _locked(path, output, time.monotonic() + wait_s)
    signals.unfinished.add(str(path))
    try:
        _sign(descriptor, output)
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # still locked: whoever waits for this file will see that it is not there any more
        signals.unfinished.discard(str(path))
        os.close(descriptor)


def _sign(descriptor: int, output: str | Path) -> None:
    """Writes whose lock it is."""
    try:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"{os.getpid()}\n".encode())
    except OSError as error:
        found = f"{error.strerror or error} for its lock"
        remedy = "free some space or choose another folder"
        raise OutputError(str(output), found, "a folder that can be written", remedy) from error


def _locked(path: Path, output: str | Path, deadline_s: float) -> int:
    """A descriptor of the file that is at ``path``, locked by the deadline."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            found = f"{error.strerror} for its lock {path}"
            raise OutputError(str(output), found, "a folder that can be written", "choose another") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _holder(descriptor)
            os.close(descriptor)
            if time.monotonic() < deadline_s:
                time.sleep(_LOOK_EVERY_S)
                continue
            remedy = "wait for it, or choose another output"
            raise BusyError(
                str(output), f"another run{holder} is at work on it", "one run an output", remedy
            ) from None
        except OSError:  # a file system without locks
            return descriptor
        if _is_at(descriptor, path):
            return descriptor
        os.close(descriptor)  # its owner removed it while we opened it


def _holder(descriptor: int) -> str:
    text = os.read(descriptor, 20).decode("ascii", "replace").strip()
    return f" (process {text})" if text.isdigit() else ""


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        there, here = os.stat(path, follow_symlinks=False), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)
