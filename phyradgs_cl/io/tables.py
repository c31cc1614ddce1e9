"""Reads and checks single values of TOML, JSON and pickles. Errors name a value by its path in the file."""

import json
import logging
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.io.files import decoded, read_regular
from phyradgs_cl.text import suggest_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LARGEST = 1e12  # no angle, time or count is larger, and sums of such numbers stay finite
LARGEST_LENGTH = 1e9  # no length is larger in mm, and none but 0 is below 1 / this number
_MOST_TOML_BYTES = 16 << 20  # a larger file is no description, and would take long to parse
_COUNTS = {2: "two", 3: "three"}
_log = logging.getLogger(__name__)
PROVENANCE: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("method", "program", "scan", "scan_sha256", "device"), (str,)),
    **dict.fromkeys(("seed", "gaussians", "interrupted_at"), (int,)),
    **dict.fromkeys(("options", "input"), (dict,)),
    "seconds": (int, float),
    "record": (list,),
}
"""Allowed types of some fields in a volume's provenance, by the field's name."""


def read_toml(path: Path, subject: str = "") -> dict[str, Any]:
    """Parses a TOML file. Raises InputError, about ``subject`` or the path, for a missing file and for wrong TOML."""
    subject = subject or str(path)
    try:
        return tomllib.loads(decoded(read_regular(path, subject, _MOST_TOML_BYTES, "a TOML file")))
    except (ValueError, RecursionError) as error:  # RecursionError: tables nested too deep
        raise InputError(subject, f"text that is not TOML ({error})", "a TOML file") from error


def read_facts(subject: str, text: str, types: Mapping[str, tuple[type, ...]]) -> dict[str, object]:
    """Parses a JSON object that users may have edited, such as provenance. types: the allowed types of some fields, beside
    null. A field of another type, and one that ``_fits`` refuses, is left out, with a warning. Raises InputError for text
    that is not a JSON object."""
    try:
        facts = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(subject, f"text that is not JSON ({error})", "a JSON object") from error
    if not isinstance(facts, dict):
        raise InputError(subject, f"JSON {type(facts).__name__}", "a JSON object")
    for name, allowed in types.items():
        value = facts.get(name)
        if value is not None and (not isinstance(value, allowed) or isinstance(value, bool) or not _fits(value)):
            expected = " or ".join(one.__name__ for one in allowed)
            _log.warning("%s: %s is left out: found %s; expected %s", subject, name, described(value), expected)
            del facts[name]
    return facts


def _fits(value: object) -> bool:
    """Returns whether a value is usable. A list must have only tables as entries; a number must be finite and below 2^63."""
    if isinstance(value, list):
        return all(isinstance(line, dict) for line in value)
    return not isinstance(value, (int, float)) or abs(value) < 2**63


def refuse_unknown(subject: str, names: Collection[str], allowed: Collection[str], what: str = "a key") -> None:
    """Raises InputError for the first unknown name, and suggests a similar allowed one."""
    for key in names:
        if key not in allowed:
            remedy = suggest_name(key, allowed, "remove it")
            raise InputError(f"{subject} {key}", f"{what} that is not known", ", ".join(allowed), remedy)


class Fields:
    """A table whose values are read and checked one at a time. subject: names the table in messages. allowed: the possible
    keys; None allows any. Methods raise InputError, about "SUBJECT key", for missing and for wrong values."""

    def __init__(self, subject: str, values: object, allowed: Collection[str] | None = None) -> None:
        if not isinstance(values, Mapping):
            raise InputError(subject, described(values), "a table of names and values")
        if allowed is not None:
            refuse_unknown(subject, values, allowed)
        self.subject = subject
        self.values = values
        self._joint = " " if allowed is not None or subject.endswith(":") else "."

    def name(self, key: str) -> str:
        return f"{self.subject}{self._joint}{key}"

    def error(self, key: str, found: str, expected: str, remedy: str = "") -> InputError:
        return InputError(self.name(key), found, expected, remedy)

    def has(self, key: str) -> bool:
        """Returns whether the table has a value for ``key``; None counts as missing."""
        return self.values.get(key) is not None

    def get(self, key: str) -> object:
        if not self.has(key):
            raise self.error(key, "nothing", "a value", "add it to the file")
        return self.values[key]

    def table(self, key: str) -> "Fields":
        return Fields(self.name(key), self.get(key))

    def number(
        self, key: str, default: float | None = None, lowest: float = -LARGEST, highest: float = LARGEST
    ) -> float:
        """Returns a finite number from ``lowest`` to ``highest``, or ``default`` if the key is missing."""
        if default is not None and not self.has(key):
            return default
        value = self._finite(key, self.get(key))
        if not lowest <= value <= highest:
            least = f"at least {lowest:g} and " if lowest > -LARGEST else ""
            raise self.error(key, f"{value:g}", f"a number, {least}at most {highest:g}")
        return value

    def length(self, key: str) -> float:
        """Returns a number from 1e-9 to 1e9, in the file's unit of length: no scanner has lengths outside this range."""
        value = self.number(key, highest=LARGEST_LENGTH)
        if value < 1 / LARGEST_LENGTH:
            raise self.error(key, f"{value:g}", "a number above 0")
        return value

    def position(self, key: str) -> float:
        """Returns a coordinate from -1e9 to 1e9, in the file's unit; 0 if the key is missing."""
        return self.number(key, 0.0, -LARGEST_LENGTH, LARGEST_LENGTH)

    def numbers(self, key: str, count: int | None = None, largest: float = LARGEST) -> np.ndarray:
        """Returns the finite numbers (count,) float64 of a list or array; none may be larger in size than ``largest``."""
        values = self.get(key)
        if isinstance(values, np.ndarray):
            values = values.ravel().tolist() if values.size in values.shape else None  # rows and columns are lists too
        expected = f"{_COUNTS.get(count, count)} numbers" if count is not None else "a list of numbers"
        if not isinstance(values, Sequence) or isinstance(values, (str, bytes)):
            raise self.error(key, described(self.get(key)), expected)
        if count is not None and len(values) != count:
            raise self.error(key, f"{len(values)} values", expected)
        return np.array([self._finite(key, value, largest) for value in values], np.float64)

    def lengths(self, key: str, count: int) -> np.ndarray:
        """Returns ``count`` numbers above 0, (count,) float64."""
        values = self.numbers(key, count)
        if values.min() <= 0:
            raise self.error(key, str(values.tolist()), "numbers above 0")
        return values

    def count(self, key: str, most: int) -> int:
        """Returns a whole number from 1 to ``most``."""
        value = self.number(key)
        if not 1 <= value <= most or value != int(value):
            raise self.error(key, f"{value:g}", f"a whole number from 1 to {most}")
        return int(value)

    def counts(self, key: str, count: int) -> tuple[int, ...]:
        """Returns ``count`` whole numbers from 1 to 1,000,000."""
        values = self.numbers(key, count)
        if values.min() < 1 or values.max() > 1e6 or np.any(values != np.rint(values)):
            raise self.error(key, str(values.tolist()), "whole numbers from 1 to 1000000")
        return tuple(int(value) for value in values)

    def word(self, key: str, allowed: Sequence[str] | None = None, default: str | None = None) -> str:
        """Returns a string, one of ``allowed`` if given."""
        if default is not None and not self.has(key):
            return default
        value = self.get(key)
        if not isinstance(value, str):
            raise self.error(key, described(value), "a string")
        if allowed is not None:
            checks.one_of(self.name(key), value, allowed)
        return value

    def tables(self, key: str) -> "Iterator[Fields]":
        """Yields the tables of the list at ``key``. Raises InputError, when called, for no list and for an empty one."""
        entries = self.get(key)
        if not isinstance(entries, list) or not entries:
            raise self.error(key, described(entries), "a list with at least one entry")
        return (Fields(f"{self.name(key)}[{index}]", value) for index, value in enumerate(entries))

    def _finite(self, key: str, value: object, largest: float = LARGEST) -> float:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= largest:
            raise self.error(key, described(value), f"a finite number of at most {largest:g}")
        return float(value)


def described(value: object) -> str:
    """Describes a value in messages. A container is described by type and length only, because it may be huge."""
    if value is None or isinstance(value, (bool, int, float, str, bytes, np.generic)):
        return checks.short_repr(value)
    size = f" of {len(value)}" if isinstance(value, (Mapping, Sequence)) else ""
    return f"a {type(value).__name__}{size}"
