"""Device memory: arrays, a limit of their total size, errors of drivers, and exchange of arrays with pyopencl."""

import logging
import math
import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from phyradgs_cl.errors import DeviceError, InputError, OutOfMemoryError
from phyradgs_cl.runtime.device import DeviceInfo
from phyradgs_cl.runtime.opencl import cl

MEMORY_VARIABLE = "PHYRADGS_MEMORY"
_SMALLER = 0.25  # after memory ran short, a second attempt may use this fraction of the free memory
_PLANNED = 0.9  # fraction of the free memory that operators may use; the rest is a reserve
# Fraction of the memory that operators may use if a GPU's driver does not say how much other programs and the screen use.
_PLANNED_UNSEEN = 0.6
_UNITS = {"": 1, "B": 1}
for _power, _letter in enumerate("KMGT", start=1):
    _UNITS |= {_letter: 1024**_power, f"{_letter}IB": 1024**_power, f"{_letter}B": 1000**_power}
log = logging.getLogger(__name__)
# OpenCL's error codes for a shortage: allocation failure, out of resources, out of host memory, invalid buffer size.
_MEMORY_CODES = (-4, -5, -6, -61)


class MemoryShortage(OutOfMemoryError):
    """Raised where device memory runs short: beyond the limit, or in the driver. Smaller parts of a volume may fit."""


@dataclass(eq=False)
class DeviceArray:
    """A C-contiguous array in device memory."""

    buffer: "cl.Buffer"
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        return math.prod(self.shape)  # np.prod takes 20 µs, and each launch needs the sizes of several arrays

    @property
    def nbytes(self) -> int:
        return self.size * self.dtype.itemsize


@dataclass(eq=False)
class LaterItem:
    """A number that is copied to the host once the device has computed it. The host need not wait: it asks ``is_here``."""

    _values: np.ndarray
    _event: "cl.Event"

    @property
    def is_here(self) -> bool:
        return bool(self._event.command_execution_status == cl.command_execution_status.COMPLETE)

    @property
    def value(self) -> np.generic:
        """Returns the number; valid once ``is_here`` is True."""
        return self._values[0]


Array = np.ndarray | DeviceArray
"""C-contiguous values on host or device. Operators return a NumPy array for a NumPy array, else a device array."""
SameArray = TypeVar("SameArray", bound=Array)


@dataclass
class Traffic:
    """Counts the bytes sent to the device and back, and how often the host waited for the device."""

    bytes_up: int = 0
    bytes_down: int = 0
    blocking: int = 0

    def count(self, up: int = 0, down: int = 0) -> None:
        self.bytes_up += up
        self.bytes_down += down
        self.blocking += 1


@dataclass(frozen=True)
class Room:
    """The device memory that an operator may still use, and the largest single buffer, both in bytes."""

    free_bytes: int
    largest_bytes: int

    def holds(self, *sizes_bytes: int) -> bool:
        """Returns whether buffers of these sizes fit at the same time."""
        return sum(sizes_bytes) <= self.free_bytes and max(sizes_bytes, default=0) <= self.largest_bytes

    def scaled(self, share: float) -> "Room":
        return Room(int(share * self.free_bytes), int(share * self.largest_bytes))


class MemoryLedger:
    """Counts the device memory in use, in bytes, and refuses a buffer that would raise it above ``limit_bytes``."""

    def __init__(self, device: DeviceInfo, limit_bytes: int | None) -> None:
        self.device = device
        self.is_asked = limit_bytes is not None
        free_bytes = reported_bytes(device)
        self.limit_bytes = (free_bytes or device.memory_bytes) if limit_bytes is None else limit_bytes
        is_unseen = limit_bytes is None and free_bytes is None and device.kind != "cpu"
        self.planned = _PLANNED_UNSEEN if is_unseen else _PLANNED
        self.held_bytes = 0
        self.peak_bytes = 0
        self.reserved_bytes = 0
        self._counting = threading.RLock()  # for threads; re-entrant: the release of an array may count amid a count

    def count(self, nbytes: int) -> None:
        with self._counting:
            self.held_bytes += nbytes
            self.peak_bytes = max(self.peak_bytes, self.held_bytes)

    @contextmanager
    def reserved(self, nbytes: int) -> Iterator[None]:
        """Makes ``room`` leave ``nbytes`` free in the body of a ``with``, for buffers that are made later."""
        with self._counting:
            self.reserved_bytes += nbytes
        try:
            yield
        finally:
            with self._counting:
                self.reserved_bytes -= nbytes

    def room(self, largest_bytes: int) -> Room:
        """Returns what operators may use of the memory that is left, in buffers of at most ``largest_bytes``: nine tenths,
        or six tenths if a GPU's driver does not report its free memory and the user has set no limit."""
        free_bytes = max(self.limit_bytes - self.held_bytes - self.reserved_bytes, 0)
        return Room(int(self.planned * free_bytes), min(largest_bytes, self.limit_bytes))

    def check(self, nbytes: int, largest_bytes: int) -> None:
        """Raises MemoryShortage for a buffer of ``nbytes`` above ``largest_bytes``, or above the rest of the limit."""
        subject, found = f"memory of {self.device.name}", f"{mebibytes(nbytes)} in one buffer"
        remedy = "use a smaller problem"
        if nbytes > largest_bytes:
            raise MemoryShortage(subject, found, f"at most {mebibytes(largest_bytes)}", remedy)
        if self.held_bytes + nbytes > self.limit_bytes:
            rest = mebibytes(max(self.limit_bytes - self.held_bytes, 0))
            expected = f"at most {rest}, what is left of {mebibytes(self.limit_bytes)}"
            if self.is_asked:
                remedy = f"allow more with --memory or {MEMORY_VARIABLE}, or {remedy}"
            raise MemoryShortage(subject, found, expected, remedy)

    def error(self, work: str, error: "cl.Error", queue: "cl.CommandQueue | None" = None) -> DeviceError:
        """Returns an OpenCL error as a DeviceError, or as a MemoryShortage if memory ran out. work: the failed call.

        Some drivers report a shortage only at a launch or a wait. They also say "out of resources" after a kernel that
        crashed or ran too long. In that case ``queue`` no longer works, which tells the two causes apart."""
        code = getattr(error, "code", 0)  # some errors of pyopencl, such as those of a build, have no code
        is_dead = queue is not None and not answers(queue)
        if not is_dead and (isinstance(error, cl.MemoryError) or code in _MEMORY_CODES):
            remedy = f"set a limit with --memory or {MEMORY_VARIABLE}, or use a smaller problem"
            found = f"{work} refused ({error})"
            return MemoryShortage(f"memory of {self.device.name}", found, "enough free memory", remedy)
        found = f"{work} failed ({' '.join(str(error).split())[:300] or type(error).__name__})"
        remedy = "see the system's log, or try another --device"
        if is_dead:
            found += ": the driver ended a kernel, or lost the device"
            remedy = "run 'phyradgs devices --check', see the system's log, or try another --device"
        return DeviceError(f"device {self.device.name}", found, "a device that works", remedy)


def answers(queue: "cl.CommandQueue") -> bool:
    """Returns whether a queue still works. After a driver has ended a kernel, every call in its context fails."""
    try:
        word = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, 4)
        cl.enqueue_fill_buffer(queue, word, np.zeros(1, np.float32), 0, 4)
        queue.finish()
    except cl.Error:
        return False
    return True


def reported_bytes(device: DeviceInfo) -> int | None:
    """Returns the device's free memory in bytes, which only AMD's drivers report; None for others."""
    with suppress(cl.Error, AttributeError):
        if "cl_amd_device_attribute_query" in device.handle.extensions:
            return int(device.handle.global_free_memory_amd[0]) * 1024  # type: ignore[index]
    return None


def memory_limit(wish: str | int | None) -> int | None:
    """Returns the limit in bytes from ``wish``, else from the environment variable PHYRADGS_MEMORY, or None if neither is
    set. Raises InputError for a value that is no size."""
    if wish is not None:
        return bytes_of(wish, "memory")
    text = os.environ.get(MEMORY_VARIABLE)
    return bytes_of(text, MEMORY_VARIABLE) if text else None


def bytes_of(wish: str | int, subject: str) -> int:
    """Returns the number of bytes that a text such as 2GiB, 1.5 GB or 512M, or a plain number, means. The letters K, M, G
    and T alone mean powers of 1024, like KiB; KB means 1000. Raises InputError about ``subject`` for other text, and for a
    size of 0 or of 2^63 and more."""
    text = "" if isinstance(wish, bool) else str(wish)
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*", text)
    factor = _UNITS.get(match.group(2).upper()) if match else None
    if match is None or factor is None or not 0 < float(match.group(1)) * factor < 2**63:
        expected, remedy = "a size above 0, in bytes or with a unit", "write for example 2GiB, 1.5GB or 512M"
        raise InputError(subject, repr(wish), expected, remedy)
    return max(int(float(match.group(1)) * factor), 1)


def mebibytes(nbytes: int) -> str:
    size = nbytes / 2**20
    return f"{size:.0f} MiB" if size >= 10 else f"{size:.2g} MiB"


class Attempt:
    """One attempt at work that is divided to fit the memory. As a context manager it gives the fraction ``share`` of the
    free memory to use. It catches a MemoryShortage of the first attempt (share 1), so that a second attempt can follow."""

    has_failed = False

    def __init__(self, what: str, share: float) -> None:
        self.what, self.share = what, share

    def __enter__(self) -> float:
        return self.share

    def __exit__(self, kind: object, error: object, at: object) -> bool:
        self.has_failed = isinstance(error, MemoryShortage) and self.share == 1
        if self.has_failed:
            # The error is logged as text: a record with the error itself would keep the failed attempt's buffers alive.
            log.warning("%s: %s; trying again with smaller bricks", self.what, str(error))
        return self.has_failed


def attempts(what: str) -> Iterator[Attempt]:
    """Yields an attempt that may use all of the free memory. If memory runs short, warns and yields a second attempt, which
    may use a quarter. what: the work, for the warning."""
    yield (first := Attempt(what, 1.0))
    if first.has_failed:
        yield Attempt(what, _SMALLER)


def is_cl_array(value: object) -> bool:
    """Returns whether a value is a pyopencl.array.Array. Its module is not imported: without it no such value exists."""
    module = sys.modules.get("pyopencl.array")
    return module is not None and isinstance(value, module.Array)


def adopted(name: str, array: Any, queue: "cl.CommandQueue") -> DeviceArray:
    """Returns pyopencl's float32 Array (C order) as a DeviceArray on the same memory. An Array with an offset is copied.

    Raises InputError about ``name`` for an Array of another context, queue, type or order."""
    remedy = "make it with the operator's to_device, or on its queue"
    if array.context != queue.context:
        raise InputError(name, "an Array of another OpenCL context", "the operator's context", remedy)
    if array.queue not in (None, queue):
        raise InputError(name, "an Array on another queue", "the operator's queue", remedy)
    if array.dtype != np.float32 or not array.flags.c_contiguous:
        order = "" if array.flags.c_contiguous else ", not in C order"
        raise InputError(name, f"an Array of {array.dtype}{order}", "float32 in C order", "convert it on the device")
    contiguous = array.with_queue(queue).copy() if array.offset else array
    return DeviceArray(contiguous.base_data, tuple(array.shape), array.dtype)


def lent(array: DeviceArray, queue: "cl.CommandQueue") -> Any:
    """Returns a DeviceArray as pyopencl's Array on the same memory, which counts as in use while the Array exists."""
    import pyopencl.array

    shared = pyopencl.array.Array(queue, array.shape, array.dtype, data=array.buffer)
    shared.memory_of = array  # type: ignore[attr-defined]
    return shared
