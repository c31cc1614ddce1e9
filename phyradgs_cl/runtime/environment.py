"""Versions and hardware that a result depends on besides its options."""

import os
import platform
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.runtime.context import Runtime
from phyradgs_cl.runtime.pocl import cpu_name


def environment(rt: Runtime) -> dict[str, Any]:
    """Returns the versions of program, interpreter and libraries, the device, and the time."""
    return {
        "version": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "pyopencl": _installed("pyopencl"),
        "pocl": _installed("pocl-binary-distribution"),
        "platform": rt.device.platform,
        "device": rt.device.name,
        "device_version": rt.device.version,
        "compute_units": rt.device.compute_units,
        "host_cores": os.cpu_count(),
        "processor": cpu_name(),
        "finished": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
