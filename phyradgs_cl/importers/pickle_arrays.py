"""NumPy arrays as pickles spell them: types, shapes and bytes, put together without asking NumPy's unpickling.

Every array is a view of the file's own bytes, so that no header can ask for more memory than the file is long.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_LONGEST = 1 << 40


@dataclass
class DtypeOnItsWay:
    """A NumPy type on its way: its code, and the byte order that BUILD sets."""

    code: str
    order: str = "="

    def finished(self) -> np.dtype:
        """The type, if it is one of plain real numbers."""
        dtype = np.dtype(self.code)
        if dtype.kind not in "iufb" or dtype.itemsize not in (1, 2, 4, 8):
            raise ValueError(f"NumPy type {self.code!r}, where plain real numbers belong")
        return dtype.newbyteorder(self.order)


@dataclass
class ArrayOnItsWay:
    """An array on its way, until BUILD puts the array in its place, also in these entries of the memo."""

    entries: list[int]


def array_view(raw: object, dtype: object, shape: object, order: str) -> np.ndarray:
    """An array over bytes of the file, with exactly as many as it needs."""
    if isinstance(raw, str):  # Python 2 wrote bytes as text
        raw = raw.encode("latin1")
    if not isinstance(dtype, DtypeOnItsWay) or not isinstance(raw, (bytes, bytearray)):
        raise ValueError("an array without numbers")
    if (
        not isinstance(shape, tuple)
        or len(shape) > 8
        or any(type(n) is not int or not 0 <= n < _LONGEST for n in shape)
    ):
        raise ValueError("an array with an impossible shape")
    kind = dtype.finished()
    if math.prod(shape) * kind.itemsize != len(raw):
        raise ValueError(f"an array of shape {shape} in {len(raw)} bytes")
    return np.frombuffer(raw, kind).reshape(shape, order=order)


def _scalar(dtype: object, raw: object) -> object:
    return array_view(raw, dtype, (), "C").item()


def _from_buffer(raw: object, dtype: object, shape: object, order: object, *_: object) -> np.ndarray:
    return array_view(raw, dtype, shape, "F" if order == "F" else "C")


def _encode(text: object, encoding: object) -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise ValueError("an encoding that is not latin1")
    return text.encode("latin1")


def _dtype(code: object, *_: object) -> DtypeOnItsWay:
    if not isinstance(code, str) or len(code) > 8:
        raise ValueError("a NumPy type that is no plain number")
    return DtypeOnItsWay(code)


def _bytearray(raw: object = b"", *_: object) -> bytes:
    if not isinstance(raw, (bytes, bytearray)):
        raise ValueError("a bytearray that is not made of bytes")
    return bytes(raw)


def _not_called(*_: object) -> object:
    raise ValueError("a call of numpy.ndarray")


CALLS: dict[str, Callable[..., object]] = {
    "reconstruct": lambda *_: ArrayOnItsWay([]),
    "scalar": _scalar,
    "frombuffer": _from_buffer,
    "encode": _encode,
    "dtype": _dtype,
    "bytearray": _bytearray,
    "ndarray": _not_called,
}
