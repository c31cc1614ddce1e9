"""Checks of values from users and files. They raise InputError, whose message begins with their argument ``subject``."""

import importlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import field
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.errors import InputError
from phyradgs_cl.text import suggest_name

_LONGEST = 80  # most characters of a wrong value in a message; the text of a longer value is cut
T = TypeVar("T")


def few_sizes(count: int, most: int) -> int:
    """Returns a work-group's size for ``count`` work-items on a CPU: the least power of 2 from ``count`` on, but at most
    ``most``. A driver compiles a kernel once for each size."""
    return min(1 << (count - 1).bit_length(), most)


def ceil_div(count: int, divisor: int) -> int:
    """Returns count / divisor rounded up, for whole numbers of any size."""
    return -(-count // divisor)


def positive(subject: str, value: float) -> None:
    """Raises InputError about ``subject`` unless the scalar ``value`` is finite and above 0."""
    if not (is_number(value) and value > 0):
        raise InputError(subject, short_repr(value), "a finite number above 0")


def at_least(subject: str, value: float, minimum: float) -> None:
    """Raises InputError about ``subject`` unless the scalar ``value`` is finite and at least ``minimum``."""
    if not (is_number(value) and value >= minimum):
        raise InputError(subject, short_repr(value), f"a finite number, at least {minimum}")


def within(subject: str, value: float, lowest: float, highest: float) -> None:
    """Raises InputError about ``subject`` unless the scalar ``value`` is from ``lowest`` to ``highest``, both included."""
    if not (is_number(value) and lowest <= value <= highest):
        raise InputError(subject, short_repr(value), f"a number from {lowest} to {highest}")


def option(default: T, help: str = "", usual: bool | str = True, **known: Any) -> T:
    """Returns a dataclass field for an option, with its help text and its limits.

    usual: the default in words, for help texts; True shows ``default``. known: limits for ``fields_within``, as ``range``
    (lowest, highest), allowed ``words`` and ``is_positive``, its ``subject``, and the command option's ``metavar``."""
    return field(default=default, metadata={"help": help, "usual": usual, **known})


def ranged(default: T, lowest: float, highest: float, subject: str = "") -> T:
    """Returns a dataclass field for a number that ``fields_within`` checks to be from ``lowest`` to ``highest``."""
    return option(default, range=(lowest, highest), subject=subject)


def fields_within(named: str | Callable[[str], str], options: object) -> None:
    """Raises InputError if a field of the dataclass ``options`` is not None and breaks the limits given to ``option``.

    Fields of base classes are checked too, and each number of a tuple. named: the text before a field's name in messages,
    or a function that takes the field's name and returns the message's subject."""
    own = [one for kind in reversed(type(options).__mro__) for one in getattr(kind, "__dataclass_fields__", {}).values()]
    for name, one in {one.name: one for one in own if one.metadata}.items():
        known, value = one.metadata, getattr(options, name)
        if value is None:
            continue
        subject = known.get("subject") or (named + name if isinstance(named, str) else named(name))
        if "words" in known:
            one_of(subject, value, known["words"])
        for number in value if isinstance(value, tuple) else (value,):
            if "is_positive" in known:
                positive(subject, number)
            elif "range" in known:
                (whole if one.type is int else within)(subject, number, *known["range"])


class Checked:
    """Base of option dataclasses, which checks the fields of a new instance as ``fields_within`` does. PREFIX: the text
    before a field's name in messages."""

    PREFIX = ""

    def __post_init__(self) -> None:
        fields_within(self.PREFIX, self)


def kind(subject: str, value: object, allowed: Any, expected: str, remedy: str = "") -> None:
    """Raises InputError, with the words ``expected`` and ``remedy``, unless ``value`` is an instance of ``allowed``."""
    if not isinstance(value, allowed):
        raise InputError(subject, short_repr(value), expected, remedy)


def one_of(subject: str, value: object, allowed: Iterable[object]) -> None:
    """Raises InputError, whose message lists the values ``allowed``, unless ``value`` is one of these."""
    choices = list(allowed)
    if value not in choices:
        remedy = suggest_name(value, (choice for choice in choices if isinstance(choice, str)), "")
        raise InputError(subject, short_repr(value), "one of " + ", ".join(repr(choice) for choice in choices), remedy)


def finite(subject: str, array: ArrayLike) -> None:
    """Raises InputError if ``array`` (any shape) has NaN or infinite values. The message states the first one's index."""
    good = np.isfinite(np.asarray(array))
    if not good.all():
        count = int(good.size - np.count_nonzero(good))
        first = tuple(int(i) for i in np.unravel_index(int(np.argmin(good)), good.shape))
        raise InputError(subject, f"{count} NaN or infinite values, first at {first}", "finite values")


def shape(subject: str, array: ArrayLike, expected: Sequence[int | None]) -> None:
    """Raises InputError unless ``array`` has the shape ``expected``, in which None stands for any length."""
    found = np.shape(array)
    fits = len(found) == len(expected) and all(e in (None, f) for f, e in zip(found, expected, strict=True))
    if not fits:
        wanted = ", ".join("any" if e is None else str(e) for e in expected)
        raise InputError(subject, f"shape {found}", f"shape ({wanted})")


def numbers(subject: str, value: ArrayLike, expected: Sequence[int | None] | None = None) -> NDArray[np.float64]:
    """Returns ``value`` as float64. Raises InputError unless it is real and finite, with the shape ``expected`` if given."""
    array = real_array(subject, value)
    if expected is not None:
        shape(subject, array, expected)
    finite(subject, array)
    return array.astype(np.float64)


def rising(subject: str, value: ArrayLike) -> NDArray[np.float64]:
    """Returns times (n,) as float64. Raises InputError for n = 0, and for a time that is not later than the one before."""
    times = numbers(subject, value, (None,))
    if len(times) == 0 or (np.diff(times) <= 0).any():
        raise InputError(subject, short_repr(times.tolist()), "at least one time, rising")
    return times


def real_array(subject: str, value: ArrayLike, kinds: str = "iuf") -> np.ndarray:
    """Returns ``value`` as an array of its own type. Raises InputError for masked elements, ragged lists, arrays on a
    device, and types outside of NumPy's ``kinds``: i and u are integers, f floats, b booleans."""
    unmasked(subject, value)
    try:
        array = np.asarray(value)
    except ValueError as error:  # NumPy's own message is too long for one line
        raise InputError(subject, "lists of unequal length", "an array of numbers") from error
    except (BufferError, RuntimeError, TypeError) as error:  # for arrays on a device, such as those of CuPy and PyTorch
        raise not_on_host(subject, value, error) from error
    if array.dtype.kind not in kinds:
        raise InputError(subject, short_repr(value), "numbers")
    return array


def unmasked(subject: str, value: object) -> None:
    """Raises InputError for a NumPy array with masked elements, or a list with such an array: NumPy would drop its mask."""
    parts = value if isinstance(value, list | tuple) else [value]
    if any(isinstance(one, np.ma.MaskedArray) and np.ma.is_masked(one) for one in parts):
        remedy = "give array.filled(0), or array.data and its mask apart where there is an argument mask"
        raise InputError(subject, "a masked array", "a plain array", remedy)


def not_on_host(subject: str, value: object, error: Exception) -> InputError:
    """Returns the InputError about an array that NumPy cannot read. error: the exception from the array's own library."""
    found, expected = f"{type(value).__name__} ({error})", "an array of real numbers on the host"
    return InputError(subject, found, expected, "copy it there: array.get(), or of tensors detach().cpu()")


def flag(subject: str, value: object) -> None:
    """Raises InputError for anything but True and False, because Python would take any other value for one of the two."""
    kind(subject, value, bool | np.bool_, "True or False")


def whole(subject: str, value: float, lowest: int, highest: int) -> None:
    """Raises InputError unless the scalar ``value`` is a whole number from ``lowest`` to ``highest``, both included."""
    within(subject, value, lowest, highest)
    if value != int(value):
        raise InputError(subject, short_repr(value), f"a whole number from {lowest} to {highest}")


def package(name: str, use: str, install: str) -> ModuleType:
    """Imports and returns the package ``name``. If it is missing, raises InputError with its ``use`` and the pip command."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(name, "not installed", use, f"pip install '{install}'") from error


def short_repr(value: object) -> str:
    """Returns the repr of a wrong value for a message, cut to 80 characters."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print whole numbers of thousands of digits
        return "a number of thousands of digits"
    except RecursionError:
        return "hundreds of tables or lists in each other"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def is_number(value: object) -> bool:
    """Returns whether ``value`` is a finite number. A bool does not count as a number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    return isinstance(value, int) or math.isfinite(value)  # isfinite raises for an int too large for a float
