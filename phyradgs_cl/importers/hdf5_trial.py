"""A first look at a stranger's HDF5 file by another process, which may crash or hang in place of this one.

The HDF5 library follows damaged headers without looking: a flipped bit can end the process that reads it. The child
opens every object, reads every attribute and every small dataset; a file that it does not survive is refused. Damage
inside large datasets is met, and reported, by the reading itself.
"""

from __future__ import annotations

import subprocess
import sys
from functools import lru_cache
from pathlib import Path

from phyradgs_cl.errors import InputError

SECONDS = 20.0
_SMALL_BYTES, _MOST_OBJECTS = 1 << 20, 10_000
_WALK = """
import sys, h5py
small, left = int(sys.argv[2]), [int(sys.argv[3])]
def look(thing):
    left[0] -= 1
    if left[0] < 0:
        return
    try:
        for name in thing.attrs:
            thing.attrs[name]
        if isinstance(thing, h5py.Dataset):
            if not thing.is_virtual and not thing.external and thing.nbytes <= small:
                thing[()]
            return
        for name in thing:
            if isinstance(thing.get(name, getlink=True), h5py.HardLink):
                look(thing[name])
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, MemoryError):
        pass  # damage that HDF5 survives: met again, and named, by the reading itself
with h5py.File(sys.argv[1], "r") as file:
    look(file)
"""


def survive(path: Path) -> None:
    """InputError if reading the file's headers kills a process or keeps it for ever; other damage is passed over."""
    facts = path.stat()
    _try(path.resolve(), facts.st_mtime_ns, facts.st_size)


@lru_cache(maxsize=8)  # recognising a file and importing it is one trial
def _try(path: Path, mtime_ns: int, size: int) -> None:
    command = [sys.executable, "-c", _WALK, str(path), str(_SMALL_BYTES), str(_MOST_OBJECTS)]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        found = f"a file that HDF5 does not finish reading in {SECONDS:g} s"
        raise InputError(str(path), found, "readable HDF5", "copy the file again") from None
    if done.returncode < 0 or done.returncode > 2:  # killed by a signal, or as Windows says it
        found = "a file so damaged that the HDF5 library crashes on it"
        raise InputError(str(path), found, "readable HDF5", "copy the file again")
