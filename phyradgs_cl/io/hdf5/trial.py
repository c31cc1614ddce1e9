"""A first look at an HDF5 file by another process (`look`), which may crash or hang in place of this one.

A flipped bit in a header can end the process that reads it, or keep it for ever. Damage inside large datasets is met by
the reading itself. Linux copies this process, in milliseconds; elsewhere an interpreter is started.
"""

import faulthandler
import logging
import os
import signal
import subprocess
import sys
import warnings
from functools import lru_cache
from pathlib import Path

from h5py._objects import phil

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.hdf5.look.__main__ import LARGE, look

CPU_SECONDS, SECONDS = 3, 60.0
"""What a look may take: of a processor, where the system counts that, and by the clock, for a slow disk."""
FORKS = sys.platform == "linux"
_SMALL_BYTES, _MOST_OBJECTS, _MOST_MEMORY_BYTES = 1 << 17, 5_000, 256 << 20
_LOOK = Path(__file__).with_name("look")
_SIGXCPU, _SIGALRM = 24, 14
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
    limits = (_SMALL_BYTES, _MOST_OBJECTS, _MOST_MEMORY_BYTES, CPU_SECONDS, SECONDS)
    try:
        status = _in_a_copy(str(path), limits) if FORKS else _in_an_interpreter(str(path), limits)
    except OSError as error:
        _log.debug("no process to try HDF5 files in: %s", error)
        return ""
    if status == LARGE:
        return f"a file whose headers ask HDF5 for more than {_MOST_MEMORY_BYTES >> 20} MiB"
    if status in (-_SIGXCPU, -_SIGALRM):
        return "a file that HDF5 does not finish reading"
    return "a file so damaged that the HDF5 library crashes on it" if status < 0 else ""


def _in_a_copy(path: str, limits: tuple[int, int, int, int, float]) -> int:
    """How a copy of this process that looks at the file ends: its status, or less the signal."""
    with phil, warnings.catch_warnings():  # no other thread is inside HDF5; none goes on in the copy
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        status = 1
        try:
            _be_silent()
            status = look(path, *limits)
        finally:
            os._exit(status)
    try:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    except BaseException:  # Ctrl-C
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise


def _be_silent() -> None:
    """In the copy: signals are for the process that was copied, and so is the terminal."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    faulthandler.disable()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)


def _in_an_interpreter(path: str, limits: tuple[float, ...]) -> int:
    quiet = subprocess.DEVNULL
    command = [sys.executable, str(_LOOK), path, *map(str, limits)]
    try:
        return subprocess.run(
            command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True, timeout=SECONDS
        ).returncode
    except subprocess.TimeoutExpired:
        return -_SIGALRM
