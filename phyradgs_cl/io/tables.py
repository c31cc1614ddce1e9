"""Typed values out of nested plain containers (JSON, TOML, pickles), each named by its path when it is wrong."""

import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.io.regular import read_regular
from phyradgs_cl.text import near_miss

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LARGEST = 1e12  # of any length, angle or time that makes sense; keeps sums finite
_MOST_TOML_BYTES = 16 << 20
_COUNTS = {2: "two", 3: "three"}


def read_toml(path: Path, subject: str = "") -> dict[str, Any]:
    """The content of a TOML file. Raises InputError, about ``subject`` or the path, where there is none or no TOML."""
    subject = subject or str(path)
    try:
        return tomllib.loads(read_regular(path, subject, _MOST_TOML_BYTES, "a TOML file").decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # not TOML, not text, too many digits; tables too deep
        raise InputError(subject, f"text that is not TOML ({error})", "a TOML file") from error


def refuse_unknown(subject: str, found: Collection[str], known: Collection[str], what: str = "a key") -> None:
    """InputError for the first name that is not known, with the one that it nearly is."""
    for key in found:
        if key not in known:
            remedy = near_miss(key, known, "remove it")
            raise InputError(f"{subject} {key}", f"{what} that is not known", ", ".join(known), remedy)


class Fields:
    """A mapping and the name to blame: values are taken out one by one, each checked. ``known``: the only names that it
    may have; None for a table that may have more than is read of it."""

    def __init__(self, subject: str, values: object, known: Collection[str] | None = None) -> None:
        if not isinstance(values, Mapping):
            raise InputError(subject, described(values), "a table of names and values")
        if known is not None:
            refuse_unknown(subject, values, known)
        self.subject = subject
        self.values = values
        self._joint = " " if known is not None or subject.endswith(":") else "."

    def name(self, key: str) -> str:
        """How messages name a value of the table."""
        return f"{self.subject}{self._joint}{key}"

    def error(self, key: str, found: str, expected: str, remedy: str = "") -> InputError:
        """What to raise about a value of the table."""
        return InputError(self.name(key), found, expected, remedy)

    def has(self, key: str) -> bool:
        return self.values.get(key) is not None

    def get(self, key: str) -> object:
        """A required value of any kind."""
        if not self.has(key):
            raise self.error(key, "nothing", "a value", "add it to the file")
        return self.values[key]

    def table(self, key: str) -> "Fields":
        """A required table inside this one."""
        return Fields(self.name(key), self.get(key))

    def number(
        self, key: str, default: float | None = None, lowest: float = -LARGEST, highest: float = LARGEST
    ) -> float:
        """A finite number between two bounds, both included."""
        if default is not None and not self.has(key):
            return default
        value = self._finite(key, self.get(key))
        if not lowest <= value <= highest:
            least = f"at least {lowest:g} and " if lowest > -LARGEST else ""
            raise self.error(key, f"{value:g}", f"a number, {least}at most {highest:g}")
        return value

    def length(self, key: str) -> float:
        """A number above zero."""
        value = self.number(key)
        if value <= 0:
            raise self.error(key, f"{value:g}", "a number above 0")
        return value

    def numbers(self, key: str, count: int | None = None, largest: float = LARGEST) -> np.ndarray:
        """A list, or an array, of finite numbers (count,) float64, in size at most ``largest``."""
        found = self.get(key)
        if isinstance(found, np.ndarray):
            found = found.tolist() if found.ndim == 1 else None
        wanted = f"{_COUNTS.get(count, count)} numbers" if count is not None else "a list of numbers"
        if not isinstance(found, Sequence) or isinstance(found, (str, bytes)):
            raise self.error(key, described(self.get(key)), wanted)
        if count is not None and len(found) != count:
            raise self.error(key, f"{len(found)} values", wanted)
        return np.array([self._finite(key, value, largest) for value in found], np.float64)

    def lengths(self, key: str, count: int) -> np.ndarray:
        """(count,) numbers above zero."""
        values = self.numbers(key, count)
        if values.min() <= 0:
            raise self.error(key, str(values.tolist()), "numbers above 0")
        return values

    def count(self, key: str, most: int) -> int:
        """A whole number from 1 to ``most``."""
        value = self.number(key)
        if not 1 <= value <= most or value != int(value):
            raise self.error(key, f"{value:g}", f"a whole number from 1 to {most}")
        return int(value)

    def counts(self, key: str, count: int) -> tuple[int, ...]:
        """``count`` whole numbers of at least 1."""
        values = self.numbers(key, count)
        if values.min() < 1 or values.max() > 1e6 or np.any(values != np.rint(values)):
            raise self.error(key, str(values.tolist()), "whole numbers from 1 to 1000000")
        return tuple(int(value) for value in values)

    def word(self, key: str, allowed: Sequence[str] | None = None, default: str | None = None) -> str:
        """A string, one of ``allowed`` where they are given."""
        if default is not None and not self.has(key):
            return default
        value = self.get(key)
        if not isinstance(value, str):
            raise self.error(key, described(value), "a string")
        if allowed is not None:
            checks.one_of(self.name(key), value, allowed)
        return value

    def tables(self, key: str) -> "Iterator[Fields]":
        """The tables of a list that is not empty."""
        found = self.get(key)
        if not isinstance(found, list) or not found:
            raise self.error(key, described(found), "a list with at least one entry")
        return (Fields(f"{self.name(key)}[{index}]", value) for index, value in enumerate(found))

    def _finite(self, key: str, value: object, largest: float = LARGEST) -> float:
        if isinstance(value, np.generic):
            value = value.item()
        good = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not good or not abs(value) <= largest:  # type: ignore[arg-type]
            raise self.error(key, described(value), f"a finite number of at most {largest:g}")
        return float(value)  # type: ignore[arg-type]


def described(value: object) -> str:
    """A value for a message; of containers the kind and length only, for a hostile one can take for ever to print."""
    if value is None or isinstance(value, (bool, int, float, str, bytes, np.generic)):
        return checks.shown(value)
    size = f" of {len(value)}" if isinstance(value, (Mapping, Sequence)) else ""
    return f"a {type(value).__name__}{size}"
