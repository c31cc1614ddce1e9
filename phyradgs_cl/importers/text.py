"""Reads texts of scanners and other programs: numbers with decimal commas or units, lines NAME = VALUE."""

import logging
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.files import SafeFolder, read_text
from phyradgs_cl.io.files import decoded
from phyradgs_cl.io.hdf5.datasets import Quantity
from phyradgs_cl.io.tables import LARGEST, Fields

_log = logging.getLogger(__name__)
_BEGINNING = re.compile(r"([-+]?(?:\d[\d.,]*|[.,]\d+))([eE][-+]?\d+)?(?=$|[\s;°µμa-zA-Z%(])(?![eE][-+]?\d)[\s;]*(.*)", re.S)
_ENGLISH, _GERMAN = (re.compile(rf"[-+]?\d{{1,3}}({k}\d{{3}})+{d}") for k, d in ((",", r"(\.\d+|,\d{3})"), (r"\.", r",\d+")))
_ONE_COMMA, _EITHER = re.compile(r"[-+]?\d*,\d+"), re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
_BRIGHTER = 1.2  # a pixel is too bright above this many times the stated counts of air: noise does not reach so far
_FEW = 0.01  # this fraction of the pixels may be too bright, because they are broken
_HEAD_BYTES = 1 << 14  # bytes at a file's start in which the words that mark a format are sought


def number_at_start(text: str, comma_is_decimal: bool = False) -> tuple[float, str] | None:
    """Returns the number at the start of a text, and the text behind it, such as a unit; None without a number. In 1,000
    the comma may be decimal or separate thousands. It is decimal with ``comma_is_decimal``; else the result is None."""
    if not (found := _BEGINNING.match(text.strip())):
        return None
    digits, power, rest = found[1], found[2] or "", found[3]
    if _ENGLISH.fullmatch(digits):
        digits = digits.replace(",", "")
    elif _GERMAN.fullmatch(digits):
        digits = digits.replace(".", "").replace(",", ".")
    elif _ONE_COMMA.fullmatch(digits) and (comma_is_decimal or not _EITHER.fullmatch(digits)):
        digits = digits.replace(",", ".")
    try:
        return float(digits + power), rest
    except ValueError:
        return None


def commas_are_decimal(texts: list[str]) -> bool:
    """Returns whether commas in the texts' numbers are decimal: some comma cannot mark thousands, and no number has a
    point."""
    commas = any(_ONE_COMMA.fullmatch(text) and not _EITHER.fullmatch(text) for text in texts)
    return commas and not any(re.fullmatch(r"[-+]?\d*\.\d+", text) for text in texts)


class Settings(Fields):
    """Fields whose values are texts. Its methods read numbers from the texts, also numbers that a unit follows."""

    def __init__(self, subject: str, values: Mapping[str, str | list[str]], comma_is_decimal: bool = False) -> None:
        super().__init__(subject, values)
        self.comma_is_decimal = comma_is_decimal

    def measured(self, key: str, quantity: Quantity, unit: str) -> float:
        """Returns a number above 0, in the package's unit of ``quantity``. unit: the number's unit, unless a known unit
        follows the number in the text."""
        found = number_at_start(str(self.get(key)), self.comma_is_decimal)
        stated = quantity.factor(found[1]) if found and found[1] else None
        factor = stated or quantity.factor(unit)
        assert factor is not None
        return self.length(key) * factor

    def listed(self, key: str, count: int) -> np.ndarray:
        """Returns the numbers (count,) in the comma-separated text of ``key``. Raises InputError for another count."""
        return Settings(self.subject, {key: self.word(key).split(",")}).numbers(key, count)

    def _finite(self, key: str, value: object, largest: float = LARGEST) -> float:
        found = number_at_start(value, self.comma_is_decimal) if isinstance(value, str) else None
        return super()._finite(key, found[0] if found else value, largest)


def read_settings(
    path: Path, names: Collection[str], separator: str = "=", sections: Collection[str] = ()
) -> Settings:
    """Reads the lines NAME ``separator`` VALUE for the given ``names``, in upper or lower case; ignores other lines.

    sections: the only [sections] that are read; () reads all. If a name is in two sections, the first counts. Raises
    InputError for a file with none of the names, and for a section that gives a name two values."""
    spelt, wanted = {name.lower(): name for name in names}, {section.lower() for section in sections}
    values: dict[tuple[str, str], str] = {}  # keys are (section, name)
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


def head_has(path: Path, *marks: bytes) -> bool:
    """Returns whether a regular file has all ``marks`` in its first 16 KiB, upper case or lower."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        head = decoded(file.read(_HEAD_BYTES)).lower()
    return all(mark.decode().lower() in head for mark in marks)


def found_by(suffixes: tuple[str, ...], *marks: bytes) -> Callable[[Path], list[Path]]:
    """Returns a function that finds the files with one of the suffixes and with all ``marks`` in their heads: the path that
    it takes, or those in this folder."""

    def found(path: Path) -> list[Path]:
        files = SafeFolder(path).matching(*suffixes) if path.is_dir() else [path]
        return [file for file in files if file.suffix.lower() in suffixes and head_has(file, *marks)]

    return found


def say_missing(fields: Fields, meanings: Mapping[str, str]) -> None:
    """Warns of names that the description lacks. meanings: the value that is assumed for each missing name."""
    if missing := [f"no {name} ({meaning})" for name, meaning in meanings.items() if not fields.has(name)]:
        _log.warning("%s %s", fields.subject, ", ".join(missing))


def white_level(fields: Fields, key: str, frames: np.ndarray, remedy: str) -> float:
    """Returns the counts of air that ``key`` states. Raises InputError if more than 1 % of the pixels of frames (F, v, u)
    exceed 1.2 times these counts."""
    white = fields.length(key)
    brighter = sum(np.count_nonzero(frame > _BRIGHTER * white) for frame in frames) / frames.size
    if brighter > _FEW:
        found = f"{white:g} counts, and {100 * brighter:.3g} % of the pixels at more than {_BRIGHTER:g} times as many"
        raise fields.error(key, found, "the counts of air, which nothing outshines", remedy)
    return white
