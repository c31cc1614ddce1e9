"""What operators take and give: arrays of the host, or of the device."""

from __future__ import annotations

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

    Raises InputError, of which ``name`` is the culprit, for what is no array of numbers or has another shape.
    """
    array = adopted(name, values, rt.queue) if is_cl_array(values) else on_host(name, values)
    checks.shape(name, array, shape)  # type: ignore[arg-type]
    return array


def given_back(rt: Runtime, values: Values) -> Any:
    """A result as who called it knows arrays: NumPy's, or pyopencl's on the device."""
    return lent(values, rt.queue) if isinstance(values, DeviceArray) else values


def on_device(rt: Runtime, function: Callable[[DeviceArray], DeviceArray], values: Values) -> Values:
    """``function`` of values wherever they lie, its result there too."""
    if isinstance(values, DeviceArray):
        return function(values)
    return rt.download(function(rt.upload(values)))


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
