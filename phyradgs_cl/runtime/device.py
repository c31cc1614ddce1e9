"""Lists this machine's OpenCL devices, chooses one, and reports the versions on which results depend."""

import logging
import os
import platform
import re
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.errors import DeviceError, NoSuchDeviceError
from phyradgs_cl.runtime import pocl
from phyradgs_cl.runtime.opencl import cl

DEVICE_VARIABLE = "PHYRADGS_DEVICE"
_NEVER_BY_DEFAULT = ("oclgrind", "fpga", "emulat")  # parts of the names of devices that are used only if a user names them
_RIGHT_MESA = 25  # rusticl, the OpenCL of Mesa, computes wrong sums before this major version
log = logging.getLogger(__name__)
_targets: dict[int, str | None] = {}  # the processor for which PoCL builds kernels, by the address of the CPU device


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device, with the properties by which a device is chosen. vector_width: the number of floats in its native
    vectors. by_default: whether it may be chosen where the user names no device."""

    index: int
    name: str
    platform: str
    version: str
    kind: str  # "gpu", "cpu" or "accelerator"
    compute_units: int
    memory_bytes: int
    largest_allocation_bytes: int
    vector_width: int
    has_fp64: bool
    by_default: bool
    handle: "cl.Device"
    target: str | None = None  # the processor for which PoCL builds kernels; None: unknown, or not a CPU of PoCL

    @property
    def rank(self) -> tuple[int, int, int, int, int]:
        """The key by which devices are compared: the best device has the largest. Entries: 1 if it may be chosen by default;
        2 for a GPU, 1 for a CPU, 0 for others; 1 if it has memory of its own; floats in its vectors; its compute units."""
        kind = {"gpu": 2, "cpu": 1}.get(self.kind, 0)
        unified = bool(self.handle.host_unified_memory)
        return (int(self.by_default), kind, int(not unified), self.vector_width, self.compute_units)


def list_devices() -> list[DeviceInfo]:
    """Returns all devices of all platforms, in OpenCL's order."""
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # the loader reports "no platform" as an error
        return []
    infos: list[DeviceInfo] = []
    for one in platforms:
        try:
            devices = one.get_devices()
        except cl.Error:
            continue
        infos.extend(_describe(len(infos) + i, one, d) for i, d in enumerate(devices))
    return infos


def choose_device(wish: str | None = None, turn: int = 0, option: str = "--device") -> tuple[DeviceInfo, str]:
    """Returns the device to use, and the reason in words. Raises DeviceError where no device fits.

    wish (or the environment variable PHYRADGS_DEVICE): an index, ``cpu``, ``gpu``, a part of a device's or platform's
    name, or a list of these with commas. Without it, the best device is taken. turn: the number k of this process, from 0,
    among the run's processes on this machine. Process k takes entry k of a list. If ``wish`` is neither a list nor an
    index, process k takes the k-th device of the same name after the best one. After the last comes the first again.
    option: what messages call ``wish``."""
    source = option
    if not wish:
        wish, source = os.environ.get(DEVICE_VARIABLE), DEVICE_VARIABLE
    devices = list_devices()
    if not devices:
        found = "no device"
        remedy = "install your vendor's OpenCL driver; on Linux x86-64, pip install 'phyradgs-cl[cpu]' "
        remedy += "brings PoCL for the CPU"
        if pocl.unusable_cache() is not None:
            found += f", and PoCL's cache {pocl.unusable_cache()} cannot be written"
            remedy = f"set {pocl.CACHE_VARIABLE} to a folder that can be written"
        raise DeviceError("OpenCL", found, "at least one", remedy)
    if wish:
        several = [one for one in wish.split(",") if one.strip()] or [wish]
        named = several[turn % len(several)]
        device, reason = _wished(named, source, devices)
        is_exact = len(several) > 1 or named.strip().isdigit()
        return device if is_exact else _next_of_name(device, devices, turn), reason
    eligible = [d for d in devices if d.by_default]
    if not eligible:
        found = f"only {', '.join(d.name for d in devices)}"
        raise DeviceError("OpenCL", found, "a real device", "name one with --device to use it")
    reason = f"best of {len(eligible)} by capability (GPU before CPU, then memory, vector width, units)"
    return _next_of_name(max(eligible, key=lambda d: d.rank), devices, turn), reason


def _next_of_name(first: DeviceInfo, devices: list[DeviceInfo], turn: int) -> DeviceInfo:
    """Returns the ``turn``-th device after ``first`` of the same platform and name. After the last comes the first again."""
    same = [d for d in devices if (d.platform, d.name) == (first.platform, first.name)]
    return same[(same.index(first) + turn) % len(same)]


def _wished(wish: str, source: str, devices: list[DeviceInfo]) -> tuple[DeviceInfo, str]:
    if wish.strip().isdigit():
        matching = [d for d in devices if d.index == int(wish)]
    elif wish.lower() in ("cpu", "gpu"):
        matching = [d for d in devices if d.kind == wish.lower() and d.by_default]
    else:
        matching = [d for d in devices if wish.lower() in f"{d.platform} {d.name}".lower()]
    if not matching:
        known = "; ".join(f"{d.index}: {d.name} ({d.platform})" for d in devices)
        raise NoSuchDeviceError(source, f"{wish!r}, which fits no device", f"an index or part of a name of {known}")
    return max(matching, key=lambda d: d.rank), f"chosen by {source}={wish}"


def _describe(index: int, of: "cl.Platform", device: "cl.Device") -> DeviceInfo:
    is_pocl = "portable computing language" in of.name.lower()
    # A device's type is a bit field: PoCL reports ALL | CPU, so == does not work.
    kind = "gpu" if device.type & cl.device_type.GPU else "accelerator"
    kind = "cpu" if device.type & cl.device_type.CPU else kind
    if is_pocl:
        pocl.warn_of_cache()
    if is_pocl and kind == "cpu" and device.int_ptr not in _targets:
        named = device.version.rpartition("-linux-gnu-")[2] if "-linux-gnu-" in device.version else None
        is_old = "PoCL 3.0" in of.version
        _targets[device.int_ptr] = pocl.use_library_target(device.int_ptr) if is_old else named
    text = f"{of.name} {of.vendor} {device.name}".lower()
    usable = bool(device.available and device.compiler_available)
    return DeviceInfo(
        index=index, name=" ".join(device.name.split()), platform=of.name, version=device.version.strip(),
        kind=kind, compute_units=device.max_compute_units, memory_bytes=device.global_mem_size,
        largest_allocation_bytes=device.max_mem_alloc_size,
        vector_width=max(1, device.native_vector_width_float),
        has_fp64=device.native_vector_width_double > 0 or "cl_khr_fp64" in device.extensions,
        by_default=usable and not any(word in text for word in _NEVER_BY_DEFAULT), handle=device,
        target=_targets.get(device.int_ptr),
    )


def known_fault(device: DeviceInfo) -> str | None:
    """Returns a known fault of the device's driver in words, or None."""
    version = re.search(r"\d+", device.handle.driver_version)
    if device.platform.lower() == "rusticl" and version and int(version[0]) < _RIGHT_MESA:
        return f"rusticl of Mesa {device.handle.driver_version} computes wrong sums: install Mesa {_RIGHT_MESA} or newer"
    return None


@cache
def warn_of_fault(device: DeviceInfo) -> None:
    """Warns, once per device, of a known fault of its driver."""
    if fault := known_fault(device):
        log.warning("%s: %s", device.name, fault)


def environment(device: DeviceInfo) -> dict[str, Any]:
    """Returns what is stored with a result: versions of the program, Python and libraries, the device's and processor's
    names, the numbers of compute units and of cores, and the time in UTC."""
    return {
        "version": __version__, "python": platform.python_version(), "numpy": np.__version__,
        "pyopencl": _installed("pyopencl"), "pocl": _installed("pocl-binary-distribution"),
        "platform": device.platform, "device": device.name, "device_version": device.version,
        "compute_units": device.compute_units, "host_cores": os.cpu_count(), "processor": pocl.cpu_name(),
        "finished": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
