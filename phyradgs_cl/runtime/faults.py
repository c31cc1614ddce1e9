"""Translates errors of an OpenCL driver into DeviceError and MemoryShortage.

Drivers queue work: a launch may be refused at once, or fail later in any call that waits. Every call that enqueues or
waits is therefore translated, and names its work.
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
    """True where a driver's error means that memory ran out; some drivers report it only at a launch or a wait."""
    if isinstance(error, cl.MemoryError):
        return True
    return _code(error) in _MEMORY_CODES


def translated(error: "cl.Error", ledger: MemoryLedger, work: str) -> DeviceError:
    """Returns an OpenCL error as a DeviceError; ``work`` names what failed: a kernel, or "a copy"."""
    if exhausted(error):
        return ledger.refused(work, error)
    message = " ".join(str(error).split())[:300] or type(error).__name__
    remedy = "see the system's log, or try another --device"
    return DeviceError(
        f"device {ledger.device.name}", f"{work} failed ({message})", "a device that works", remedy
    )


def naming_failures(work: str | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a method of a runtime, so that OpenCL's errors become DeviceError or MemoryShortage.

    ``work`` names the method's work; None takes the name of the kernel, the first argument of a launch.
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
