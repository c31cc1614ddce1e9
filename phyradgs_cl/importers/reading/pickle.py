"""Pickles without trust: the standard library's unpickler, with an allow-list in place of whatever a file names.

What a name of the list stands for is a function of this module, not NumPy's: none of them allocates by a number in the
file or takes a state that it does not check.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.bounded import check_room
from phyradgs_cl.io.memory import at_most
from phyradgs_cl.io.regular import read_regular, regular_file

_BESIDE = 3  # arrays and line integrals, for every byte of the file
_LATIN1 = ("latin1", "latin-1")


def read_pickle(path: Path) -> object:
    """What a pickle file holds: dicts, lists, tuples, text, numbers, NumPy arrays. InputError for anything else."""
    culprit = str(path)
    size = regular_file(path, culprit).st_size
    check_room(culprit, _BESIDE * size)
    data = read_regular(path, culprit, size, "a pickle")
    try:
        with at_most(_BESIDE * size):
            return PlainUnpickler(culprit, data).load()
    except InputError:
        raise
    except Exception as error:  # a stranger's opcodes in any order: every failure is the file's
        found = f"a damaged pickle ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(culprit, found, "a pickle of plain containers and NumPy arrays") from error


class PlainUnpickler(pickle.Unpickler):
    """Plain containers, and arrays of real numbers, of the pickle ``data``; ``culprit`` is how errors name it."""

    def __init__(self, culprit: str, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")  # Python 2 wrote an array's bytes as text
        self._culprit = culprit

    def find_class(self, module: str, name: str) -> object:
        """What a name of the list stands for; NumPy 2 calls its core by another name."""
        known = module.replace("numpy._core.", "numpy.core."), name
        if known not in _NAMES:
            self._refuse(f"a call of {module[:60]}.{name[:60]}")
        return _NAMES[known]

    def persistent_load(self, pid: object) -> NoReturn:
        """An object that lies elsewhere."""
        self._refuse("a persistent object")

    def _refuse(self, found: str) -> NoReturn:
        raise InputError(self._culprit, found, "plain containers and NumPy arrays", "nothing was executed")


class _Allowed:
    """A function that a pickle may call, and whose own state it cannot set."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function

    def __call__(self, *arguments: object) -> object:
        return self._function(*arguments)

    def __setstate__(self, state: object) -> None:
        raise ValueError("a state for something that has none")


class _Dtype:
    """A NumPy type of plain real numbers: its code, and the byte order that its state sets."""

    __slots__ = ("dtype",)

    def __init__(self, code: object, *_: object) -> None:
        if not isinstance(code, str) or not re.fullmatch(r"[<>=|]?(b1|[iu][1248]|f[248])", code):
            shown = repr(code[:20]) if isinstance(code, str) else f"a {type(code).__name__}"
            raise ValueError(f"NumPy type {shown}, where plain real numbers belong")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "|", "="):
            raise ValueError("a NumPy type without byte order")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array that is filled by its state, with exactly as many bytes as its shape needs."""

    def __new__(cls) -> _Array:
        return super().__new__(cls, (0,), np.uint8)

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise ValueError("an array without shape, type and bytes")
        _, shape, dtype, fortran, raw = state
        if isinstance(raw, str):
            raw = raw.encode("latin1")
        if not isinstance(dtype, _Dtype) or not isinstance(raw, (bytes, bytearray)):
            raise ValueError("an array without numbers")
        if not isinstance(shape, tuple) or len(shape) > 8 or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError("an array with an impossible shape")
        if math.prod(shape) * dtype.dtype.itemsize != len(raw):
            raise ValueError(f"an array of shape {shape} in {len(raw)} bytes")
        super().__setstate__((1, shape, dtype.dtype, fortran is True or fortran == 1, bytes(raw)))


def _array(raw: object, dtype: object, shape: object, order: object = "C") -> _Array:
    made = _Array()
    made.__setstate__((1, shape, dtype, order == "F", raw))
    return made


def _encoded(text: object, encoding: object) -> bytes:
    if not isinstance(text, str) or encoding not in _LATIN1:
        raise ValueError("an encoding that is not latin1")
    return text.encode("latin1")


_NAMES = {
    ("numpy", "ndarray"): object(),  # named in the arguments of _reconstruct, never called
    ("numpy", "dtype"): _Allowed(_Dtype),
    ("numpy.core.multiarray", "_reconstruct"): _Allowed(lambda *_: _Array()),
    ("numpy.core.multiarray", "scalar"): _Allowed(lambda dtype, raw: _array(raw, dtype, ()).item()),
    ("numpy.core.numeric", "_frombuffer"): _Allowed(_array),
    ("_codecs", "encode"): _Allowed(_encoded),
}
