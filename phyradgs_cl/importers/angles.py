"""Reads the angles of frames from text files: tables whose heading may name columns and unit, and scanners' own files."""

import logging
import re
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.files import SafeFolder, read_text
from phyradgs_cl.io.hdf5.datasets import ANGLE
from phyradgs_cl.io.tables import LARGEST

_log = logging.getLogger(__name__)
_COLUMNS = re.compile(r",\s+|[;:\s]+")
_ANGLE = re.compile(r"angle|theta|phi|rot|winkel|deg(?!_?c\b)", re.I)
_NO_ANGLE = re.compile(r"speed|veloc|rate|temp|err|std|sigma", re.I)
# _WHOLE forbids splits inside brackets. _SPLITS split columns' names at tabs, punctuation and several blanks, or any blank.
_WHOLE = r"(?![^(\[]*[)\]])"
_SPLITS = [re.compile(rf"(?:{separator}){_WHOLE}") for separator in (r"[\t;,:]\s*|\s{2,}", r"[\t;,:\s]+")]
_BRACKETS, _BEFORE_BRACKET = re.compile(r"[(\[]([^)\]]*)[)\]]"), re.compile(r"(?<! ) (?=[(\[])")
_GLUED = re.compile(r"(angle|theta|phi|rotation|rot)(?=[a-zµμ]{3})", re.I)  # a unit joined to a word, as in thetadeg
_HUMP = re.compile(r"(?<=[a-z])(?=[A-Z])")
_SCALED = re.compile(  # a unit with a multiple, prefix or rate, as 0.1 deg or deg/s: not a known unit
    r"(milli|micro)(?-i:(?![a-z]))|centi|(\d[.,]\d+|\de-?\d+|\^\S+)\s*(deg|°|rad)|(deg\w*|°|rad\w*|turns?)\s*(/|per\b)\s*\w*",
    re.I,
)
_OTHERS = re.compile(
    r"counts?|ticks|pulses|steps|s|sec|seconds?|ms|mm|um|px|pixels?|percent|time|dose|current|grad", re.I
)
_FEW_WORDS = 3  # a text of more words is a sentence, in which a word such as "time" is no unit


def read_angles_rad(path: Path, count: int, unit: str | None = None, column: int | None = None) -> np.ndarray:
    """Reads angles (count,) in rad from a text file: one per line, all on one line, or in a column of a table, where an
    index may give their order. Lines above the numbers, with or without a #, may name the columns and the unit.

    unit: the angles' unit, one of ``ANGLE``; None takes the one that the file names, else degrees. column: the column, from
    0 on, in which a scanner's files have the angles, unless names say otherwise. Raises InputError for another count,
    several columns without names, names that contradict the numbers, unknown units, and lines without numbers."""
    stored = read_text(path).splitlines()
    lines = [(i, text) for i, line in enumerate(stored, 1) if (text := line.partition("#")[0].strip())]
    is_header = [not re.search(r"\d", line) or (_cells(line, True) or _cells(line, False)) is None for _, line in lines]
    head = is_header.index(False) if False in is_header else len(lines)
    if column is not None:  # a scanner's heading may hold lines of numbers: the table has at most ``count`` lines
        head = max(head, len(lines) - count)
    rows = lines[head:]
    if not rows:
        place, found = (f"{path} line {lines[0][0]}", repr(lines[0][1][:40])) if lines else (str(path), "no angles")
        raise InputError(place, found, "a number, or an index and a number")
    is_comma = _is_decimal_comma(path, [line for _, line in rows])
    table = []
    for i, line in rows:
        if (cells := _cells(line, is_comma)) is None or not all(abs(value) <= LARGEST for value in cells):
            raise InputError(f"{path} line {i}", repr(line[:40]), "a finite number, or an index and a number")
        table.append(cells)
    above = [line.strip() for line in stored[rows[0][0] - 2 :: -1]] if rows[0][0] > 1 else []
    # a line behind a # that has digits outside brackets, such as a date, names neither columns nor a unit
    named = [text for text in above if text[:1] != "#" or not re.search(r"\d", _BRACKETS.sub("", text))]
    named = [text.strip("# ") for text in named if re.search(r"[^\W\d_]|°", text)]
    words, header = _names(named, len(table[0]))
    values, at = _column(path, words, header, table, count, column)
    if len(values) != count:
        raise InputError(str(path), f"{len(values)} angles", f"{count}, one for each frame")
    texts = [words[at], *(text for text in named if text != header)] if words else named
    factor = ANGLE.factor(unit) if unit else _factor(path, texts)
    assert factor is not None
    return values * factor


def _names(lines: list[str], width: int) -> tuple[list[str], str]:
    """Returns the names of ``width`` columns and the line that has them; [] and "" without such a line. lines: the texts
    above the numbers, nearest first. Of lines with ``width`` > 1 names, the first with one name of an angle is preferred."""
    fitting = [
        (words, line) for line in lines for words in [_split(line, len(_split(line)) != width)]
        if len(words) == width > 1
    ]  # fmt: skip
    return next((one for one in fitting if len(_angles_among(one[0])) == 1), fitting[0] if fitting else ([], ""))


def _split(line: str, at_blanks: bool = False) -> list[str]:
    """Returns the names of columns in a line, each with its unit. Names end at tabs, punctuation and several blanks; with
    ``at_blanks`` also at single blanks."""
    return [word for word in _SPLITS[at_blanks].split(_BEFORE_BRACKET.sub("", line)) if word]


def _angles_among(words: list[str]) -> list[int]:
    return [i for i, word in enumerate(words) if _ANGLE.search(word) and not _NO_ANGLE.search(word)]


def _factor(path: Path, texts: list[str]) -> float:
    """Returns the factor to rad of the unit in the first text that names one; that of degrees without one. texts: the
    heading of the angles comes first. Raises InputError for two units in a text, or an unknown one in the heading."""
    for i, text in enumerate(texts):
        known, others = _units(text)
        if len(set(known.values())) > 1 or (others and (i == 0 or known)):
            found = " and ".join(map(repr, [*known, *others][:3])) + f" in {text[:60]!r}"
            raise InputError(f"{path} unit of the angles", found, f"one of {ANGLE.accepted}", "name one of these")
        if known:
            return next(iter(known.values()))
    return np.pi / 180


def _units(text: str) -> tuple[dict[str, float], list[str]]:
    """Returns the units of angles that a text names, each with its factor to rad, and the words of the text that may be
    units of another quantity or unknown ones."""
    if scaled := _SCALED.search(text):
        return {}, [scaled[0]]
    known, others = dict[str, float](), list[str]()
    for part, is_bracket in ((_BRACKETS.sub(" ", text), False), *((inside, True) for inside in _BRACKETS.findall(text))):
        words = [word for word in re.split(r"[\s_,;:=/\"-]+", _GLUED.sub(r"\1 ", part)) if word]
        words = [one for word in words for one in ([word] if ANGLE.factor(word) else _HUMP.split(word))]
        if re.search("winkel", text, re.I):  # in German, Grad means degrees, not gradians
            words = ["deg" if word.lower() == "grad" else word for word in words]
        units = {word: factor for word in words if (factor := ANGLE.factor(word)) is not None}
        known |= units
        if is_bracket and (not units or re.search(r"\d", part)) and re.search(r"[^\W_]|[°%]", part):
            others.append(part)
        elif not units and len(words) <= _FEW_WORDS:
            others += [word for word in words if _OTHERS.fullmatch(word)]
    return known, others


def _cells(line: str, is_comma: bool) -> list[float] | None:
    """Returns the numbers on a line of a table; None if the line has anything else. is_comma: commas are decimal."""
    parts = [part for part in (_COLUMNS if is_comma else re.compile(r"[,;:\s]+")).split(line) if part]
    try:
        return [float(part.replace(",", ".")) for part in parts]
    except ValueError:
        return None


def _is_decimal_comma(path: Path, lines: list[str]) -> bool:
    """Returns whether commas in the lines of a table are decimal, not separators. Raises InputError if they may be both."""
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
    """Returns whether the values, sorted, are 0, 1, 2, … or 1, 2, 3, …, and at least two."""
    first = min(values)
    return len(values) > 1 and first in (0, 1) and sorted(values) == [first + i for i in range(len(values))]


def _column(
    path: Path, words: list[str], header: str, table: list[list[float]], count: int, usual: int | None
) -> tuple[np.ndarray, int]:
    """Returns the angles of a table in the file's unit, and their column: the only column or row, else the one named as an
    angle, else ``usual``, else the one beside an index. An index gives the order. words: the columns' names, found in the
    line ``header``. count: the number of frames. Raises InputError if several columns may hold the angles."""
    widths, named = {len(row) for row in table}, _angles_among(words)
    is_row = len(named) != 1 and ((len(table) == 1 and usual is None) or len(table) < count == sum(map(len, table)))
    is_row &= widths != {2} or not _is_index([row[0] for row in table])
    if widths == {1} or is_row:
        return np.array([value for row in table for value in row]), 0
    if len(widths) != 1:
        raise InputError(str(path), f"lines of {min(widths, default=0)} to {max(widths, default=0)} numbers", "one a line")
    (width,), columns = widths, np.array(table).T
    is_counted = _is_index(columns[0].tolist())
    column = usual if usual is not None else 1 if width == 2 and is_counted else width
    if len(named) == 1:
        column = named[0]
        counts = [_is_index(values.tolist()) for values in columns]
        if words != _split(header) and counts[column] and not all(counts):  # header may be a title: Angle table
            found, remedy = f"{header[:60]!r}, and numbers that count", "separate the names by tabs or commas"
            raise InputError(f"{path} column {words[column]}", found, "angles", remedy)
    if column >= width:
        remedy = "leave an index and the angles, or name every column in the line above"
        raise InputError(str(path), f"{width} numbers a line", "one angle a line", remedy)
    index = columns[1] if width == 2 and column == 0 else columns[0]
    is_ordered = is_counted if column > 0 else width == 2 and _is_index(index.tolist())
    return np.asarray(columns[column][np.argsort(index)] if is_ordered else columns[column]), column


def file_of_angles(folder: SafeFolder, name: str, *ends: str) -> Path | None:
    """Returns a folder's file of angles. Takes each of the ``ends`` in turn: the file called ``name`` + end, else the only
    file with this end. Returns None if no end leads to one file."""
    for end in ends:
        files = folder.glob(f"*{end}")
        own = [file for file in files if file.name.lower() == f"{name}{end}".lower()]
        if own or len(files) == 1:
            return (own or files)[0]
    return None


def measured_angles_rad(path: Path, steps_rad: np.ndarray) -> np.ndarray:
    """Reads measured angles (F,) in rad, shifted so that the first is steps_rad[0]. steps_rad (F,): the planned, equal
    steps. Files differ in sign and order: the ones nearest to ``steps_rad`` are taken. Warns of the largest difference."""
    listed_rad = np.unwrap(read_angles_rad(path, len(steps_rad), column=1))
    ways = [steps_rad[0] + way - way[0] for way in (listed_rad, listed_rad[::-1], -listed_rad, -listed_rad[::-1])]
    best = min(ways, key=lambda way: float(np.abs(way - steps_rad).max()))
    text = "%s: these measured angles are used; they differ from equal steps by %.3g° at most"
    _log.warning(text, path, np.rad2deg(np.abs(best - steps_rad).max()))
    return best
