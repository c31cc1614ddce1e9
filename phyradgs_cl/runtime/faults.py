"""What an OpenCL driver reports when a device fails, in this package's words.

Drivers queue work: a launch may be refused, or accepted and reported as failed by whatever waits for it next. Every call
that enqueues or waits is therefore translated, and says what it was about.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from phyradgs_cl.errors import DeviceError
from phyradgs_cl.runtime.memory import MemoryLedger
from phyradgs_cl.runtime.opencl import cl

P = ParamSpec("P")
R = TypeVar("R")
# mem object allocation failure, out of resources, out of host memory, invalid buffer size
_MEMORY_CODES = (-4, -5, -6, -61)


def exhausted(error: "cl.Error") -> bool:
    """Whether a driver's error says that memory ran out; some say so only at a launch, or when it is waited for."""
    if isinstance(error, cl.MemoryError):
        return True
    return _code(error) in _MEMORY_CODES


def translated(error: "cl.Error", ledger: MemoryLedger, work: str) -> DeviceError:
    """An OpenCL error as one of ours; ``work`` is what was being done: a kernel's name, or "a copy"."""
    if exhausted(error):
        return ledger.refused(work, error)
    said = " ".join(str(error).split())[:300] or type(error).__name__
    remedy = "see the system's log, or try another --device"
    return DeviceError(
        f"device {ledger.device.name}", f"{work} failed ({said})", "a device that works", remedy
    )


def naming_failures(work: str | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a method of a runtime: OpenCL's errors come out as DeviceError or MemoryShortage.

    ``work`` is None for launches, whose kernel (the first argument) has a name of its own.
    """

    def decorate(method: Callable[P, R]) -> Callable[P, R]:
        @wraps(method)
        def named(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return method(*args, **kwargs)
            except cl.Error as error:
                what = work or f"a launch of {args[1].function_name}"  # type: ignore[attr-defined]
                raise translated(error, args[0].ledger, what) from error  # type: ignore[attr-defined]

        return named

    return decorate


def _code(error: "cl.Error") -> int:
    try:
        return int(error.code)
    except AttributeError:  # raised with a text, as pyopencl does for a build
        return 0
