"""Pickles without trust: the standard library's unpickler, with an allow-list in place of whatever a file names.

What a name stands for is a function of this module that neither allocates by a number in the file nor takes a state
unchecked. The unpickler is the one in Python: that in C hashes keys before anyone looks, and equal hashes keep it for hours.
"""

import io
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.bounded import check_room
from phyradgs_cl.io.regular import read_regular, regular_file

_MOST_OPCODES = 1_000_000  # two seconds
_MOST_COPIES, _FREE_BYTES = 4, 1 << 20  # of the file's size: one text may be made an array again and again
_BESIDE = 3  # arrays and line integrals, for every byte of the file
_LARGEST_KEY = 1 << 60  # smaller integers are their own hashes
_REFUSED = ("INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "EMPTY_SET", "FROZENSET")
_LATIN1 = ("latin1", "latin-1")


def read_pickle(path: Path) -> object:
    """What a pickle file holds: dicts, lists, tuples, text, numbers, NumPy arrays. InputError for anything else."""
    subject = str(path)
    size = regular_file(path, subject).st_size
    check_room(subject, _BESIDE * size)
    data = read_regular(path, subject, size, "a pickle")
    try:
        return PlainUnpickler(subject, data).load()
    except InputError:
        raise
    except Exception as error:  # a stranger's opcodes in any order: every failure is the file's
        found = f"a damaged pickle ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(subject, found, "a pickle of plain containers and NumPy arrays") from error


class PlainUnpickler(pickle._Unpickler):
    """Plain containers, and arrays of real numbers, of the pickle ``data``; ``subject`` is how errors name it."""

    def __init__(self, subject: str, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")  # Python 2 wrote an array's bytes as text
        self._subject = subject
        self._bytes_left = _MOST_COPIES * len(data) + _FREE_BYTES
        self._names = {
            ("numpy", "ndarray"): object(),  # named in the arguments of _reconstruct, never called
            ("numpy", "dtype"): _Allowed(_Dtype),
            ("numpy.core.multiarray", "_reconstruct"): _Allowed(lambda *_: _Array(self._spend)),
            ("numpy.core.multiarray", "scalar"): _Allowed(lambda dtype, raw: self._array(raw, dtype, ()).item()),
            ("numpy.core.numeric", "_frombuffer"): _Allowed(self._array),
            ("_codecs", "encode"): _Allowed(self._encoded),
        }
        self.dispatch = _Opcodes(pickle._Unpickler.dispatch)  # type: ignore[misc]
        self.dispatch[pickle.EMPTY_DICT[0]] = lambda machine: machine.append(_Table())
        self.dispatch[pickle.DICT[0]] = _load_table
        for name in _REFUSED:
            self.dispatch[getattr(pickle, name)[0]] = lambda machine, n=name: machine.refuse(f"the opcode {n}")

    def find_class(self, module: str, name: str) -> object:
        """What a name of the list stands for; NumPy 2 calls its core by another name."""
        known = module.replace("numpy._core.", "numpy.core."), name
        if known not in self._names:
            self.refuse(f"a call of {module[:60]}.{name[:60]}")
        return self._names[known]

    def persistent_load(self, pid: object) -> NoReturn:
        self.refuse("a persistent object")

    def refuse(self, found: str) -> NoReturn:
        """Raises InputError for what no plain file holds."""
        raise InputError(self._subject, found, "plain containers and NumPy arrays", "nothing was executed")

    def _spend(self, count: int) -> None:
        self._bytes_left -= count
        if self._bytes_left < 0:
            raise ValueError("more bytes than the file holds")

    def _array(self, raw: object, dtype: object, shape: object, order: object = "C") -> np.ndarray:
        made = _Array(self._spend)
        made.__setstate__((1, shape, dtype, order == "F", raw))
        return made

    def _encoded(self, text: object, encoding: object) -> bytes:
        if not isinstance(text, str) or encoding not in _LATIN1:
            raise ValueError("an encoding that is not latin1")
        self._spend(len(text))
        return text.encode("latin1")


class _Opcodes(dict[int, Callable[..., None]]):
    left = _MOST_OPCODES

    def __getitem__(self, code: int) -> Callable[..., None]:
        self.left -= 1
        if self.left < 0:
            raise ValueError(f"more than {_MOST_OPCODES} opcodes, where arrays belong")
        return super().__getitem__(code)


class _Table(dict[object, object]):
    """A dict whose keys are quick to hash, and hard to give one hash."""

    __slots__ = ()

    def __setitem__(self, key: object, value: object) -> None:
        if not (isinstance(key, (str, bytes)) or (isinstance(key, int) and abs(key) < _LARGEST_KEY)):
            raise ValueError("a key that is neither text nor a small integer")
        super().__setitem__(key, value)


def _load_table(machine: Any) -> None:
    items, table = machine.pop_mark(), _Table()
    for key, value in zip(items[::2], items[1::2], strict=True):
        table[key] = value
    machine.append(table)


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

    _spend: Callable[[int], None]

    def __new__(cls, spend: Callable[[int], None]) -> "_Array":
        made = super().__new__(cls, (0,), np.uint8)
        made._spend = spend
        return made

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
        self._spend(len(raw))
        super().__setstate__((1, shape, dtype.dtype, fortran is True or fortran == 1, bytes(raw)))  # type: ignore[arg-type]
