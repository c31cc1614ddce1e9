"""What operators take and give: arrays of the host, or of the device."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DeviceArray, Runtime, adopted, is_cl_array, lent

Values = np.ndarray | DeviceArray
"""float32 in C order, on the host or on the device."""


def entered(rt: Runtime, name: str, values: Any, shape: Sequence[int | None]) -> Values:
    """A user's array as float32 in C order, where it lies; copied only if it is neither.

    Raises InputError, of which ``name`` is the subject, for what is no array of numbers or has another shape.
    """
    array = adopted(name, values, rt.queue) if is_cl_array(values) else on_host(name, values)
    checks.shape(name, array, shape)  # type: ignore[arg-type]
    return array


def given_back(rt: Runtime, values: Values) -> Any:
    """A result as who called it knows arrays: NumPy's, or pyopencl's on the device."""
    return lent(values, rt.queue) if isinstance(values, DeviceArray) else values


def placed(rt: Runtime, values: Values, there: bool) -> Any:
    """Values on the device, if ``there``, or on the host; as they are if that is where they are."""
    if isinstance(values, DeviceArray):
        return values if there else rt.download(values)
    return rt.upload(values) if there else values


def computed(rt: Runtime, there: bool, function: Callable[[Any], Values], values: Values) -> Values:
    """``function``, which works on the device or on the host, of values wherever they are; its result is there too."""
    return placed(rt, function(placed(rt, values, there)), isinstance(values, DeviceArray))


def on_host(name: str, values: Any) -> np.ndarray:
    """Numbers as NumPy's float32 in C order: its own arrays, and by DLPack, without a copy, those of others on the host."""
    try:
        array = np.from_dlpack(values) if _speaks_dlpack(values) else np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"numbers of type {array.dtype}")
        return np.ascontiguousarray(array, np.float32)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        expected = "an array of real numbers on the host, or pyopencl's"
        raise InputError(name, f"{type(values).__name__} ({error})", expected, "of tensors: detach().cpu()") from error


def _speaks_dlpack(values: object) -> bool:
    return hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)
