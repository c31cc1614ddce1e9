"""Typed values out of nested plain containers (JSON, TOML, pickles), each named by its path when it is wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

LARGEST = 1e12  # of any length, angle or time that makes sense; keeps sums finite


class Fields:
    """A mapping and the name to blame: values are taken out one by one, each checked."""

    def __init__(self, culprit: str, values: object) -> None:
        if not isinstance(values, Mapping):
            raise InputError(culprit, described(values), "a table of names and values")
        self.culprit = culprit
        self.values = values

    def name(self, key: str) -> str:
        """How messages name a value of the table."""
        return f"{self.culprit} {key}" if self.culprit.endswith(":") else f"{self.culprit}.{key}"

    def has(self, key: str) -> bool:
        """Whether there is a value other than None."""
        return self.values.get(key) is not None

    def get(self, key: str) -> object:
        """A required value of any kind."""
        if not self.has(key):
            raise InputError(self.name(key), "nothing", "a value", "add it to the file")
        return self.values[key]

    def table(self, key: str) -> Fields:
        """A required table inside this one."""
        return Fields(self.name(key), self.get(key))

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        if default is not None and not self.has(key):
            return default
        return self._finite(key, self.get(key))

    def length(self, key: str) -> float:
        """A number above zero."""
        value = self.number(key)
        if value <= 0:
            raise InputError(self.name(key), f"{value:g}", "a number above 0")
        return value

    def numbers(self, key: str, count: int | None = None) -> np.ndarray:
        """A list, or an array, of finite numbers (count,) float64."""
        found = self.get(key)
        if isinstance(found, np.ndarray):
            found = found.tolist() if found.ndim == 1 else None
        wanted = f"{count} numbers" if count is not None else "a list of numbers"
        if not isinstance(found, Sequence) or isinstance(found, (str, bytes)):
            raise InputError(self.name(key), described(self.get(key)), wanted)
        if count is not None and len(found) != count:
            raise InputError(self.name(key), f"{len(found)} values", wanted)
        return np.array([self._finite(key, value) for value in found], np.float64)

    def lengths(self, key: str, count: int) -> np.ndarray:
        """(count,) numbers above zero."""
        values = self.numbers(key, count)
        if values.min() <= 0:
            raise InputError(self.name(key), str(values.tolist()), "numbers above 0")
        return values

    def counts(self, key: str, count: int) -> tuple[int, ...]:
        """``count`` whole numbers of at least 1."""
        values = self.numbers(key, count)
        if values.min() < 1 or values.max() > 1e6 or np.any(values != np.rint(values)):
            raise InputError(self.name(key), str(values.tolist()), "whole numbers from 1 to 1000000")
        return tuple(int(value) for value in values)

    def word(self, key: str, allowed: Sequence[str] | None = None, default: str | None = None) -> str:
        """A string, one of ``allowed`` where they are given."""
        if default is not None and not self.has(key):
            return default
        value = self.get(key)
        if not isinstance(value, str):
            raise InputError(self.name(key), described(value), "a string")
        if allowed is not None:
            checks.one_of(self.name(key), value, allowed)
        return value

    def tables(self, key: str) -> Iterator[Fields]:
        """The tables of a list that is not empty."""
        found = self.get(key)
        if not isinstance(found, list) or not found:
            raise InputError(self.name(key), described(found), "a list with at least one entry")
        return (Fields(f"{self.name(key)}[{index}]", value) for index, value in enumerate(found))

    def _finite(self, key: str, value: object) -> float:
        if isinstance(value, np.generic):
            value = value.item()
        good = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not good or not abs(value) <= LARGEST or not math.isfinite(value):  # type: ignore[arg-type]
            raise InputError(self.name(key), described(value), "a finite number")
        return float(value)  # type: ignore[arg-type]


def described(value: object) -> str:
    """A value for a message; of containers the kind and length only, for a hostile one can take for ever to print."""
    if value is None or isinstance(value, (bool, int, float, str, bytes, np.generic)):
        return checks.shown(value)
    size = f" of {len(value)}" if isinstance(value, (Mapping, Sequence)) else ""
    return f"a {type(value).__name__}{size}"
