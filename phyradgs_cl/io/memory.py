"""How much memory a reading may take: what the file's header promises, and what this machine has."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from phyradgs_cl.io.hdf5.look.__main__ import in_use_bytes

try:
    import resource
except ImportError:  # not POSIX
    resource = None  # type: ignore[assignment]

HOST_SHARE = 0.8
"""Of this machine's memory: what one array may take."""
_FREE_BYTES = 256 << 20  # that libraries map for themselves, and a thread for its heap
_lock = threading.Lock()


def host_bytes() -> float:
    """This machine's memory; infinite where the system does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return float("inf")


def free_bytes() -> float:
    """Memory that this process may still take without others losing theirs; infinite where the system does not say."""
    free = host_bytes()
    with suppress(OSError, ValueError, IndexError):
        free = 1024.0 * int(Path("/proc/meminfo").read_text().partition("MemAvailable:")[2].split()[0])
    limit = -1 if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]
    return free if limit < 0 else min(free, limit - in_use_bytes("VmSize:"))


@contextmanager
def at_most(more_bytes: int) -> Iterator[None]:
    """Whoever asks the system for more than ``more_bytes`` (and some) in the body gets none, where Linux counts:
    libraries that unfold compressed data would go on until there is no memory left."""
    in_use = in_use_bytes("VmSize:")
    if resource is None or not in_use:
        yield
        return
    with _lock:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        wanted = in_use + more_bytes + _FREE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (wanted if soft < 0 else min(wanted, soft), hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
