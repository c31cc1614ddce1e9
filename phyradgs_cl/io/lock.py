"""One run per output: a lock file beside it that the operating system lets go of when its process ends, however it ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from phyradgs_cl.errors import OutputError
from phyradgs_cl.io.output import beside

_LOOK_EVERY_S = 0.2


class BusyError(OutputError):
    """Another run is at work on the output."""


def lock_path(output: str | Path) -> Path:
    """The lock file of ``output``; it is there while a run is, and means nothing once that has ended."""
    target = Path(os.path.realpath(output))
    return beside(target, ".lock", ".")


@contextmanager
def only_run(output: str | Path, wait_s: float = 0.0) -> Iterator[None]:
    """Holds the lock of ``output``, a dead run's too; raises BusyError if another run still does after ``wait_s``."""
    from filelock import FileLock, Timeout

    path = lock_path(output)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=wait_s, poll_interval=_LOOK_EVERY_S)
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
            path.unlink()  # still locked: whoever waits for this file will see that it is not there any more
        lock.release()
