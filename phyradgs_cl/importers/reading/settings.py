"""Descriptions of scans as lines of names and values: the INI files and logs that scanners and toolkits write."""

import logging
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.files import read_text
from phyradgs_cl.importers.reading.text import commas_are_decimal, number_at_start
from phyradgs_cl.io.files import decoded
from phyradgs_cl.io.hdf5.datasets import Quantity
from phyradgs_cl.io.tables import LARGEST, Fields

_log = logging.getLogger(__name__)
_BRIGHTER, _FEW = 1.2, 0.01  # of the counts of air: no noise of air is so bright; fraction of pixels that may be broken


class Settings(Fields):
    """Names and texts. A text becomes a number where a number is asked for, and stays text where a word is."""

    def __init__(self, subject: str, values: Mapping[str, str | list[str]], comma_is_decimal: bool = False) -> None:
        super().__init__(subject, values)
        self.comma_is_decimal = comma_is_decimal

    def measured(self, key: str, quantity: Quantity, unit: str) -> float:
        """Returns a number above zero in the package's unit of ``quantity``. It is in ``unit``, unless a unit behind it says
        otherwise."""
        found = number_at_start(str(self.get(key)), self.comma_is_decimal)
        stated = quantity.factor(found[1]) if found and found[1] else None
        factor = stated or quantity.factor(unit)
        assert factor is not None
        return self.length(key) * factor

    def listed(self, key: str, count: int) -> np.ndarray:
        """Returns the numbers (count,) of a text, which commas separate."""
        return Settings(self.subject, {key: self.word(key).split(",")}).numbers(key, count)

    def _finite(self, key: str, value: object, largest: float = LARGEST) -> float:
        found = number_at_start(value, self.comma_is_decimal) if isinstance(value, str) else None
        return super()._finite(key, found[0] if found else value, largest)


def read_settings(
    path: Path, names: Collection[str], separator: str = "=", sections: Collection[str] = ()
) -> Settings:
    """Reads the lines NAME ``separator`` VALUE whose name is one of ``names``, in any case; other lines are not looked at.

    ``sections``: the only [sections] that count, in any case; () takes all. Of a name in two sections the first counts.
    InputError for a file without any of the names, and for one section that gives a name two values."""
    spelt, wanted = {name.lower(): name for name in names}, {section.lower() for section in sections}
    values: dict[tuple[str, str], str] = {}  # by section and name
    others: list[str] = []
    section = ""
    for line in map(str.strip, read_text(path).splitlines()):
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1].strip().lower()
            continue
        key, sign, text = (part.strip() for part in line.partition(separator))
        name = spelt.get(key.lower())
        others.append(text)
        is_wanted = (not wanted or section in wanted) and sign and text
        if is_wanted and name and (earlier := values.setdefault((section, name), text)) != text:
            pair = f"{earlier[:40]!r} and {text[:40]!r}"
            raise InputError(f"{path}: {name}", pair, "one value", "are these two descriptions in one file?")
    if not values:
        expected = f"lines such as {', '.join(list(names)[:4])}"
        raise InputError(str(path), f"nothing of a description: no line NAME {separator} VALUE", expected, "copy it again")
    first = {name: text for (_, name), text in reversed(values.items())}
    return Settings(f"{path}:", first, commas_are_decimal(others))


def head_has(path: Path, *marks: bytes, most_bytes: int = 1 << 14) -> bool:
    """True for a regular file whose beginning has all the marks, in any case."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        head = decoded(file.read(most_bytes)).lower()
    return all(mark.decode().lower() in head for mark in marks)


def say_missing(fields: Fields, meanings: Mapping[str, str]) -> None:
    """Says in one line which of the names the description lacks, and what that means."""
    if missing := [f"no {name} ({meaning})" for name, meaning in meanings.items() if not fields.has(name)]:
        _log.warning("%s %s", fields.subject, ", ".join(missing))


def white_level(fields: Fields, key: str, frames: np.ndarray, remedy: str) -> float:
    """Returns the counts of air that ``key`` states. InputError where frames (F, v, u) are much brighter."""
    white = fields.length(key)
    brighter = sum(np.count_nonzero(frame > _BRIGHTER * white) for frame in frames) / frames.size
    if brighter > _FEW:
        found = f"{white:g} counts, and {100 * brighter:.3g} % of the pixels at more than {_BRIGHTER:g} times as many"
        raise fields.error(key, found, "the counts of air, which nothing outshines", remedy)
    return white

