"""Memory of this machine and of this process, as the operating system reports it."""

import os
from contextlib import suppress
from pathlib import Path

try:
    import resource
except ImportError:  # not POSIX
    resource = None  # type: ignore[assignment]

HOST_SHARE = 0.8
"""The share of this machine's memory that one array may take."""


def host_bytes() -> float:
    """Returns this machine's memory; infinity where the system does not report it."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return float("inf")


def free_bytes() -> float:
    """Returns the memory that this process may still take; infinity where the system does not report it."""
    free = host_bytes()
    with suppress(OSError, ValueError, IndexError):
        free = 1024.0 * int(Path("/proc/meminfo").read_text().partition("MemAvailable:")[2].split()[0])
    limit = -1 if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]
    return free if limit < 0 else min(free, limit - in_use_bytes("VmSize:"))


def in_use_bytes(field: str) -> int:
    """Returns the memory of this process from a field of Linux' /proc/self/status: "VmHWM:" for the peak of resident memory,
    "VmSize:" for the address space; 0 on other systems."""
    try:
        return 1024 * int(Path("/proc/self/status").read_text().partition(field)[2].split()[0])
    except (OSError, ValueError, IndexError):
        return 0
