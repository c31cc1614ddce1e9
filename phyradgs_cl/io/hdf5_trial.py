"""A first look at an HDF5 file by another process, which may crash or hang in place of this one.

The HDF5 library follows damaged headers without looking: a flipped bit can end the process that reads it, or keep it for
ever. The other process (`hdf5_look`) opens every object, reads every attribute and every small dataset; a file that it does
not survive is refused. Damage inside large datasets is met, and reported, by the reading itself. One process, started with
the first file, looks at all of them; it leaves with this one.
"""

from __future__ import annotations

import atexit
import json
import logging
import os
import subprocess
import sys
import threading
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from phyradgs_cl.errors import InputError

CPU_SECONDS, SECONDS = 3, 60.0
"""What a look may take: of a processor, where the system counts that, and by the clock, for a slow disk."""
_SMALL_BYTES, _MOST_OBJECTS, _MOST_MEMORY_BYTES = 1 << 17, 5_000, 8 << 30
_LOOK = Path(__file__).with_name("hdf5_look")
_SIGXCPU = 24
_log = logging.getLogger(__name__)


def survive(path: Path) -> None:
    """InputError if reading the file's headers kills a process or keeps it for ever; other damage is passed over."""
    try:
        facts = path.stat()
    except OSError:
        return  # gone since it was looked for: whoever opens it says so
    found = _verdict(path.resolve(), facts.st_mtime_ns, facts.st_size)
    if found:
        raise InputError(str(path), found, "readable HDF5", "copy the file again")


@lru_cache(maxsize=64)  # a command may open a file several times
def _verdict(path: Path, mtime_ns: int, size: int) -> str:
    """What is wrong with the file; "" where nothing is, or where nobody could look."""
    with _lock:
        return _scout.verdict(path)


class _Scout:
    """The other process, started anew after a file that it did not survive."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._owner = 0
        self._is_out = False

    def verdict(self, path: Path) -> str:
        process = self._running()
        if process is None:
            return ""
        timed_out = threading.Event()

        def give_up() -> None:
            timed_out.set()
            process.kill()

        timer = threading.Timer(SECONDS, give_up)
        timer.start()
        try:
            answer = self._asked(process, json.dumps(str(path)))
        finally:
            timer.cancel()
        if answer == "done":
            return ""
        self.leave()
        if answer == "large":
            return f"a file whose headers ask HDF5 for more than {_MOST_MEMORY_BYTES >> 25} MiB"
        if timed_out.is_set() or process.returncode == -_SIGXCPU:
            return "a file that HDF5 does not finish reading"
        return "a file so damaged that the HDF5 library crashes on it"

    def leave(self) -> None:
        """Ends the process."""
        process, self._process = self._process, None
        if process is None or self._owner != os.getpid():
            return
        for stream in (process.stdin, process.stdout):
            with suppress(OSError):  # what it was not told any more
                stream.close()  # type: ignore[union-attr]
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _running(self) -> subprocess.Popen[str] | None:
        """The process; None where it cannot be started: then files are read without a trial."""
        if self._process is not None and self._owner == os.getpid() and self._process.poll() is None:
            return self._process
        if self._is_out:
            return None
        limits = [str(n) for n in (_SMALL_BYTES, _MOST_OBJECTS, _MOST_MEMORY_BYTES, CPU_SECONDS)]
        try:
            self._process = subprocess.Popen(
                [sys.executable, str(_LOOK), *limits],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                start_new_session=True,  # Ctrl-C is for this process
            )
        except (OSError, ValueError) as error:
            return self._give_up(str(error))
        self._owner = os.getpid()
        if self._process.stdout.readline() != "ready\n":  # type: ignore[union-attr]
            self.leave()
            return self._give_up("it ended at once")
        return self._process

    def _asked(self, process: subprocess.Popen[str], question: str) -> str:
        try:
            process.stdin.write(question + "\n")  # type: ignore[union-attr]
            process.stdin.flush()  # type: ignore[union-attr]
        except OSError:
            return ""
        return process.stdout.readline().strip()  # type: ignore[union-attr]

    def _give_up(self, reason: str) -> None:
        self._is_out = True
        _log.debug("no process to try HDF5 files in: %s", reason)


_lock, _scout = threading.Lock(), _Scout()
atexit.register(_scout.leave)
