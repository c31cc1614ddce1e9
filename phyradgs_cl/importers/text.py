"""Reads texts of scanners and other programs: numbers with decimal commas or units, tables of angles, lines NAME = VALUE."""

import logging
import re
from collections.abc import Collection, Mapping
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
_COLUMNS = re.compile(r",\s+|[;:\s]+")
_ANGLE, _DEG = re.compile(r"angle|theta|phi|rot|deg", re.I), re.compile(r"deg|°", re.I)
_RAD = re.compile(r"(?<![a-z])rad(ians?)?(?![a-z/])", re.I)
_BRIGHTER = 1.2  # a pixel is too bright above this many times the stated counts of air: noise does not reach so far
_FEW = 0.01  # this fraction of the pixels may be too bright, because they are broken
_HEAD_BYTES = 1 << 14  # words of a format are searched in this many bytes at a file's start
TO_RAD = {"deg": np.pi / 180, "rad": 1.0}


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
    """Returns whether numbers in the texts have decimal commas: one has a comma that cannot mark thousands, and none a
    decimal point."""
    commas = any(_ONE_COMMA.fullmatch(text) and not _EITHER.fullmatch(text) for text in texts)
    return commas and not any(re.fullmatch(r"[-+]?\d*\.\d+", text) for text in texts)


def read_angles_rad(path: Path, count: int, unit: str | None = None, column: int | None = None) -> np.ndarray:
    """Reads angles (count,) in rad from a text file: one per line, all on one line, or in a column next to an index that
    gives their order. A line of column names may name the angles and their unit. The unit is ``unit`` ("deg" or "rad"),
    else that of the column's name, else degrees. Text after a # is ignored, unless the line before the numbers is such a
    text. column: where the angles are, from 0 on; None finds them. Raises InputError for another count, several columns
    without names, and lines that are no numbers."""
    stored = read_text(path).splitlines()
    lines = [(i, text) for i, line in enumerate(stored, 1) if (text := line.partition("#")[0].strip())]
    is_header = [not re.search(r"\d", line) or (_cells(line, True) or _cells(line, False)) is None for _, line in lines]
    head = is_header.index(False) if False in is_header else len(lines)
    if column is not None:  # a scanner's file: lines above the table may look like its lines
        head = max(head, len(lines) - count)
    names, rows = [line for _, line in lines[:head]], lines[head:]
    if not rows:
        place, found = (f"{path} line {lines[0][0]}", repr(lines[0][1][:40])) if lines else (str(path), "no angles")
        raise InputError(place, found, "a number, or an index and a number")
    above = stored[rows[0][0] - 2].strip() if rows[0][0] > 1 else ""
    if not names and above.startswith("#") and not re.search(r"\d", above):
        names = [above.strip("# ")]
    is_comma = _is_decimal_comma(path, [line for _, line in rows])
    table = []
    for i, line in rows:
        if (cells := _cells(line, is_comma)) is None or not all(abs(value) <= LARGEST for value in cells):
            raise InputError(f"{path} line {i}", repr(line[:40]), "a finite number, or an index and a number")
        table.append(cells)
    words = re.split(r"[\t;,]\s*|\s{2,}", names[-1]) if names else []
    values, at = _column(path, words, table, count, column)
    if len(values) != count:
        raise InputError(str(path), f"{len(values)} angles", f"{count}, one for each frame")
    name = re.sub("(?<=[a-z])(?=[A-Z])", " ", words[at] if len(words) == len(table[0]) else " ".join(words))
    return values * TO_RAD[unit or ("rad" if _RAD.search(name) and not _DEG.search(name) else "deg")]


def _cells(line: str, is_comma: bool) -> list[float] | None:
    """Returns the numbers on a line of a table; None if it has anything else. is_comma: commas are decimal."""
    parts = [part for part in (_COLUMNS if is_comma else re.compile(r"[,;:\s]+")).split(line) if part]
    try:
        return [float(part.replace(",", ".")) for part in parts]
    except ValueError:
        return None


def _is_decimal_comma(path: Path, lines: list[str]) -> bool:
    """Returns whether commas in a table are decimal, else they separate columns. Raises InputError if both are possible."""
    parts = [part for line in lines for part in _COLUMNS.split(line) if "," in part]
    if not all(part.count(",") == 1 and "." not in part for part in parts):
        return False
    pairs = [part.split(",") for part in parts]
    if not pairs or any(left.strip("+-") == "" or not right.isdecimal() for left, right in pairs):
        return True
    rights = {right for _, right in pairs}
    is_alike = len({right.rstrip("0") for right in rights}) == 1 or any(re.match("0.", right) for right in rights)
    if is_alike or len(pairs) < len(lines) or not _is_index([float(left) for left, _ in pairs]):
        return True
    if len({len(right) for right in rights}) > 1:
        return False
    raise InputError(str(path), f"{lines[0][:30]!r}: a decimal comma, or two columns", "a point, or columns with a ;")


def _is_index(values: list[float]) -> bool:
    """Returns whether the values count from 0 or 1 without a gap, in any order."""
    first = min(values)
    return len(values) > 1 and first in (0, 1) and sorted(values) == [first + i for i in range(len(values))]


def _column(
    path: Path, words: list[str], table: list[list[float]], count: int, column: int | None
) -> tuple[np.ndarray, int]:
    """Returns a table's angles in the stored unit, and their column: its only column or row, the column named as an angle,
    or the one next to an index, which gives the angles' order. words: the columns' names. Raises InputError if several
    columns may be meant."""
    widths = {len(row) for row in table}
    if widths == {1} or (len(table) == 1 and column is None) or (len(table) < count == sum(map(len, table))):
        return np.array([value for row in table for value in row]), 0
    if len(widths) != 1:
        raise InputError(str(path), f"lines of {min(widths, default=0)} to {max(widths, default=0)} numbers", "one a line")
    (width,), columns = widths, np.array(table).T
    is_counted = _is_index(columns[0].tolist())
    if column is None:
        named = [i for i, word in enumerate(words) if _ANGLE.search(word)]
        column = named[0] if len(named) == 1 else 1 if width == 2 and is_counted else width
    if column >= width:
        remedy = "leave an index and the angles, or name the columns in a line above"
        raise InputError(str(path), f"{width} numbers a line", "one angle a line", remedy)
    index = columns[1] if width == 2 and column == 0 else columns[0]
    is_ordered = is_counted if column > 0 else width == 2 and _is_index(index.tolist())
    return np.asarray(columns[column][np.argsort(index)] if is_ordered else columns[column]), column


def file_of_angles(folder: SafeFolder, name: str, *ends: str) -> Path | None:
    """Returns, for the first of the ``ends`` that a file's name has, the file called ``name`` + end, else the only file with
    that end. Returns None if no end leads to one file."""
    for end in ends:
        files = folder.glob(f"*{end}")
        own = [file for file in files if file.name.lower() == f"{name}{end}".lower()]
        if own or len(files) == 1:
            return (own or files)[0]
    return None


def measured_angles_rad(path: Path, steps_rad: np.ndarray) -> np.ndarray:
    """Reads measured angles (F,) in rad, relative to the first of the equal steps ``steps_rad`` (F,). Files differ in sign
    and order, so the sign and order nearest to the steps are taken. Warns with the largest difference."""
    listed_rad = np.unwrap(read_angles_rad(path, len(steps_rad), column=1))
    ways = [steps_rad[0] + way - way[0] for way in (listed_rad, listed_rad[::-1], -listed_rad, -listed_rad[::-1])]
    best = min(ways, key=lambda way: float(np.abs(way - steps_rad).max()))
    text = "%s: these measured angles are used; they differ from equal steps by %.3g° at most"
    _log.warning(text, path, np.rad2deg(np.abs(best - steps_rad).max()))
    return best


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
