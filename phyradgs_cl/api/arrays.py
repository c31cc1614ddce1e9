"""Arrays that operators take and return, on the host or on the device, and the device that a call is given."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DeviceArray, Runtime, adopted, is_cl_array, lent

Device = str | Runtime | None
"""The argument ``device``: what ``--device`` takes, or a Runtime."""
Values = np.ndarray | DeviceArray
"""float32 in C order, on the host or on the device."""


def runtime_of(device: Device) -> Runtime:
    """Returns the Runtime for the argument ``device``; None is the best device."""
    if isinstance(device, Runtime):
        return device
    return _runtime_by_name(None if device is None else str(device))


@lru_cache(maxsize=4)
def _runtime_by_name(name: str | None) -> Runtime:
    """One Runtime per device, so that programs are built once."""
    return Runtime(name)


def to_operator_array(rt: Runtime, name: str, values: Any, shape: Sequence[int | None]) -> Values:
    """Returns a user's array as float32 in C order, on the host or the device where it is; copied only if it must be.

    Raises InputError about ``name`` for anything but an array of numbers, and for another shape."""
    array = adopted(name, values, rt.queue) if is_cl_array(values) else on_host(name, values)
    checks.shape(name, array, shape)  # type: ignore[arg-type]
    return array


def to_user_array(rt: Runtime, values: Values) -> Any:
    """Returns a result in the caller's kind of array: NumPy's, or pyopencl's on the device."""
    return lent(values, rt.queue) if isinstance(values, DeviceArray) else values


def moved_to(rt: Runtime, values: Values, on_device: bool) -> Any:
    """Returns values on the device or on the host, copied only if they are elsewhere."""
    if isinstance(values, DeviceArray):
        return values if on_device else rt.download(values)
    return rt.upload(values) if on_device else values


def computed(rt: Runtime, on_device: bool, function: Callable[[Any], Values], values: Values) -> Values:
    """Applies a function that works on the device or on the host; the result is returned to where ``values`` are."""
    return moved_to(rt, function(moved_to(rt, values, on_device)), isinstance(values, DeviceArray))


def on_host(name: str, values: Any) -> np.ndarray:
    """Returns numbers as NumPy's float32 in C order; arrays of other libraries on the host enter by DLPack, not copied."""
    has_dlpack = hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)
    try:
        array = np.from_dlpack(values) if has_dlpack else np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"numbers of type {array.dtype}")
        return np.ascontiguousarray(array, np.float32)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        expected = "an array of real numbers on the host, or pyopencl's"
        raise InputError(name, f"{type(values).__name__} ({error})", expected, "of tensors: detach().cpu()") from error
