"""How much memory a reading may take: what the file's header promises, and what this machine has."""

from __future__ import annotations

import os

HOST_SHARE = 0.8
"""Of this machine's memory: what one array may take."""


def host_bytes() -> float:
    """This machine's memory; infinite where the system does not say."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return float("inf")
