"""Pickles without trust: a small machine that knows plain containers and NumPy arrays, and runs nothing else.

Python's unpickler calls whatever a file names. This one interprets the opcodes itself: a name outside of
``_NAMES`` is refused before anything happens, and the names inside stand for functions of pickle_arrays.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.folder import regular_file
from phyradgs_cl.importers.pickle_arrays import CALLS, ArrayOnItsWay, DtypeOnItsWay, array_view

_MOST_OPCODES = 3_000_000  # some seconds
_MOST_COPIES, _FREE_BYTES = 4, 1 << 20
_MARK = object()


@dataclass
class _Name:
    """A global of the file, by its meaning here."""

    meaning: str


_NUMPY_CORES = ("numpy.core.", "numpy._core.")
_NAMES = {
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("_codecs", "encode"): "encode",
    ("builtins", "bytearray"): "bytearray",
    **{(f"{core}multiarray", "_reconstruct"): "reconstruct" for core in _NUMPY_CORES},
    **{(f"{core}multiarray", "scalar"): "scalar" for core in _NUMPY_CORES},
    **{(f"{core}numeric", "_frombuffer"): "frombuffer" for core in _NUMPY_CORES},
}


def read_pickle(path: Path) -> object:
    """What a pickle file holds: dicts, lists, tuples, text, numbers, NumPy arrays. InputError for anything else."""
    regular_file(path, str(path))
    machine = _Machine(str(path))
    try:
        return machine.run(path.read_bytes())
    except InputError:
        raise
    except OSError as error:
        raise InputError(str(path), error.strerror or str(error), "a readable file") from error
    except MemoryError:
        raise
    except Exception as error:  # a stranger's opcodes in any order: every failure is the file's
        found = f"a damaged pickle ({type(error).__name__}: {str(error)[:80]})"
        raise InputError(str(path), found, "a pickle of plain containers and NumPy arrays") from error


class _Machine:
    """Stack and memo of one run."""

    def __init__(self, culprit: str) -> None:
        self.culprit = culprit
        self.stack: list[object] = []
        self.memo: dict[int, object] = {}
        self.bytes_left = 0

    def run(self, data: bytes) -> object:
        """Interpret a pickle to its STOP."""
        self.bytes_left = _MOST_COPIES * len(data) + _FREE_BYTES
        for count, (opcode, argument, _) in enumerate(pickletools.genops(io.BytesIO(data))):
            if count >= _MOST_OPCODES:
                raise InputError(
                    self.culprit, f"more than {_MOST_OPCODES} opcodes", "arrays, not lists of numbers"
                )
            if opcode.name == "STOP":
                return self.stack.pop()
            self._step(opcode.name, argument)
        raise ValueError("no STOP")

    def _step(self, name: str, argument: object) -> None:
        if name in _LITERALS:
            self.stack.append(argument)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name]())
        elif name in _ACTIONS:
            _ACTIONS[name](self, argument)
        elif name not in ("PROTO", "FRAME"):
            found = f"the opcode {name}"
            raise InputError(self.culprit, found, "plain containers and NumPy arrays", "nothing was executed")

    def spend(self, value: object) -> None:
        """Counts bytes that a call has copied: one text of the file may be encoded again and again."""
        self.bytes_left -= len(value) if isinstance(value, (bytes, str)) else 0
        if self.bytes_left < 0:
            raise ValueError("more bytes than the file holds")

    def popped_to_mark(self) -> list[object]:
        """What lies on the stack above the last mark, taken off with it."""
        for at in range(len(self.stack) - 1, -1, -1):
            if self.stack[at] is _MARK:
                items = self.stack[at + 1 :]
                del self.stack[at:]
                return items
        raise ValueError("no mark")

    def named(self, module: object, name: object) -> None:
        """Push a global, if it is one of the few."""
        meaning = _NAMES.get((str(module), str(name)))
        if meaning is None:
            found = f"a call of {str(module)[:60]}.{str(name)[:60]}"
            raise InputError(self.culprit, found, "plain containers and NumPy arrays", "nothing was executed")
        self.stack.append(_Name(meaning))


def _reduce(machine: _Machine, _: object) -> None:
    arguments, callee = machine.stack.pop(), machine.stack.pop()
    if not isinstance(callee, _Name) or not isinstance(arguments, tuple):
        raise ValueError("a call of something that is no function")
    result = CALLS[callee.meaning](*arguments)
    machine.spend(result)
    machine.stack.append(result)


def _build(machine: _Machine, _: object) -> None:
    state, target = machine.stack.pop(), machine.stack[-1]
    if isinstance(target, DtypeOnItsWay) and isinstance(state, tuple) and state[1] in ("<", ">", "|", "="):
        target.order = state[1]
    elif isinstance(target, ArrayOnItsWay) and isinstance(state, tuple) and len(state) == 5:
        _, shape, dtype, fortran, raw = state
        if isinstance(raw, str):
            machine.spend(raw)
        values = array_view(raw, dtype, shape, "F" if fortran else "C")
        machine.stack[-1] = values
        for entry in target.entries:
            machine.memo[entry] = values
    else:
        raise ValueError("a state for something that has none")


def _put(machine: _Machine, index: object) -> None:
    top = machine.stack[-1]
    machine.memo[int(index)] = top  # type: ignore[call-overload]
    if isinstance(top, ArrayOnItsWay):
        top.entries.append(int(index))  # type: ignore[call-overload]


def _set_items(target: object, pairs: list[object]) -> None:
    if type(target) is not dict or len(pairs) % 2:
        raise ValueError("items for something that is no dict")
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        if not isinstance(key, (str, int, float, bytes)):  # tuples can take for ever to hash
            raise ValueError("a key that is neither text nor a number")
        target[key] = value


def _made_dict(pairs: list[object]) -> dict[object, object]:
    made: dict[object, object] = {}
    _set_items(made, pairs)
    return made


def _append(target: object, items: list[object]) -> None:
    if type(target) is not list:
        raise ValueError("items for something that is no list")
    target.extend(items)


def _tuple_of(count: int) -> Callable[[_Machine, object], None]:
    def make(machine: _Machine, _: object) -> None:
        items = tuple(machine.stack[-count:])
        if len(items) < count:
            raise ValueError("too few items")
        machine.stack[-count:] = [items]

    return make


def _stack_global(machine: _Machine, _: object) -> None:
    name, module = machine.stack.pop(), machine.stack.pop()
    machine.named(module, name)


def _set_one(machine: _Machine, _: object) -> None:
    value, key = machine.stack.pop(), machine.stack.pop()
    _set_items(machine.stack[-1], [key, value])


def _set_many(machine: _Machine, _: object) -> None:
    pairs = machine.popped_to_mark()
    _set_items(machine.stack[-1], pairs)


def _append_one(machine: _Machine, _: object) -> None:
    item = machine.stack.pop()
    _append(machine.stack[-1], [item])


def _append_many(machine: _Machine, _: object) -> None:
    items = machine.popped_to_mark()
    _append(machine.stack[-1], items)


_LITERALS = frozenset(
    [
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *(
            "STRING",
            "BINSTRING",
            "SHORT_BINSTRING",
            "UNICODE",
            "BINUNICODE",
            "SHORT_BINUNICODE",
            "BINUNICODE8",
        ),
        *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    ]
)
_CONSTANTS: dict[str, Callable[[], object]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "MARK": lambda: _MARK,
}
_ACTIONS: dict[str, Callable[[_Machine, object], None]] = {
    "POP": lambda m, _: m.stack.pop(),
    "POP_MARK": lambda m, _: m.popped_to_mark(),
    "DUP": lambda m, _: m.stack.append(m.stack[-1]),
    "DICT": lambda m, _: m.stack.append(_made_dict(m.popped_to_mark())),
    "LIST": lambda m, _: m.stack.append(m.popped_to_mark()),
    "TUPLE": lambda m, _: m.stack.append(tuple(m.popped_to_mark())),
    "TUPLE1": _tuple_of(1),
    "TUPLE2": _tuple_of(2),
    "TUPLE3": _tuple_of(3),
    "APPEND": _append_one,
    "APPENDS": _append_many,
    "SETITEM": _set_one,
    "SETITEMS": _set_many,
    "PUT": _put,
    "BINPUT": _put,
    "LONG_BINPUT": _put,
    "MEMOIZE": lambda m, _: _put(m, len(m.memo)),
    "GET": lambda m, i: m.stack.append(m.memo[i]),  # type: ignore[index]
    "BINGET": lambda m, i: m.stack.append(m.memo[i]),  # type: ignore[index]
    "LONG_BINGET": lambda m, i: m.stack.append(m.memo[i]),  # type: ignore[index]
    "GLOBAL": lambda m, text: m.named(*str(text).split(" ", 1)),
    "STACK_GLOBAL": _stack_global,
    "REDUCE": _reduce,
    "BUILD": _build,
}
