"""Finds which files of a folder are a scan's frames, and their order, from the numbers in their names.

A number may be an index, an angle with sign and decimals, or a time. Files whose names have other words than most are left
out, with a warning. A missing or repeated number is an error: all later frames would get wrong angles."""

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError

_log = logging.getLogger(__name__)
_NUMBER = re.compile(r"([-+]?)(\d+)(?:[.,](\d+))?")
_DATE = r"(?<!\d)((?:19|20)\d\d)[-_.]?(0[1-9]|1[0-2])[-_.]?(0[1-9]|[12]\d|3[01])"
_TIME = re.compile(_DATE + r"[-_ T.]*([01]\d|2[0-3])[-_.:h]?([0-5]\d)[-_.:m]?([0-5]\d)(?!\d)")
_DEGREES, _ANGLE = re.compile(r"[ _]?(deg|°|grad)", re.I), re.compile(r"(deg|angle|ang|theta|phi|rot)[ _=]*$", re.I)
# A step from one number to the next is regular if it is near the usual step, the most frequent one.
_STEADY = 0.25  # largest difference of a regular step from the usual one, as a fraction of the usual step
_GAP = 1.5  # a step between angles or times ≥ this × the usual step shows a missing frame
_USUAL = 0.5  # a series of numbers is regular if at least this fraction of its steps is regular
_STEADY_ANGLES = 0.75  # angles or times with a smaller fraction of regular steps are uneven: no step shows a missing frame
_SMALL = 0.25  # a group of files with the same words holds no frames if it is smaller than this fraction of the largest
_BEFORE, _AFTER = (re.compile(rf"(?<![a-z])({words})(?![a-z])", re.I) for words in ("before|pre|start", "after|post|end"))
_STAMP = 10**7  # numbers of this size and above are times in milliseconds, not indices
_MOST_NAMES = 8  # a message lists at most this many file names


@dataclass(frozen=True, eq=False)
class Series:
    """A scan's files in order. numbers (F,): the numbers in their names, or None. said: a text about files and order."""

    paths: list[Path]
    numbers: np.ndarray | None
    said: str


@dataclass(frozen=True, eq=False)
class _Column:
    """The numbers (F,) at one position in the files' names. place: the position, 1 for a name's first number. is_angle:
    words next to the numbers say that they are angles."""

    place: int
    values: np.ndarray
    is_angle: bool

    @property
    def is_distinct(self) -> bool:
        return len(np.unique(self.values)) == len(self.values)

    @property
    def what(self) -> str:
        return "angle" if self.is_angle else "number"

    @cached_property
    def steps(self) -> tuple[float, np.ndarray]:
        """The usual step between the sorted numbers, and each step (F − 1,) in units of it. The usual step is the most
        frequent one above 0. Where none makes up half of the steps, it is their median."""
        steps = np.diff(np.sort(self.values))
        if not len(steps):
            return 1.0, steps
        sizes, counts = np.unique(np.round(steps, 6), return_counts=True)
        usual = float(np.median(steps)) if 2 * counts.max() < len(steps) else float(sizes[np.argmax(counts * (sizes > 0))])
        return usual, steps / (usual or 1.0)

    @property
    def regular(self) -> float:
        """The fraction of steps that differ from the usual step by at most ``_STEADY`` of it."""
        return float(np.mean(np.abs(self.steps[1] - 1) <= _STEADY)) if len(self.values) > 1 else 1.0

    @property
    def rank(self) -> tuple[bool, bool, bool]:
        """Sort key of columns that may give the order: regular ones first, indices before angles, integers before others."""
        return self.regular < _USUAL, self.is_angle, self.values.dtype.kind == "f"


def series_of(
    paths: Sequence[Path], subject: str, remedy: str, *, order: int | None = None, holes: bool = False, skip: int = 0
) -> Series:
    """Returns the frames among files, in order. subject: names the files in messages. remedy: what to do about a missing
    number. order: which number in the names gives the order, 1 the first; None finds it. holes: whether numbers may be
    missing. skip: length of a prefix that all names have. Raises InputError for a missing or repeated number, several
    series, and an ``order`` that is not the place of a number."""
    paths = list(paths) if skip else _of_one_series(list(paths), subject)
    columns = _columns([path.stem[skip:] for path in paths])
    if order is not None and order not in {column.place for column in columns}:
        raise InputError(subject, f"{order}", f"the place of a number, from 1 on, in {paths[0].name}")
    varying = [column for column in columns if len(paths) == 1 or np.ptp(column.values)]
    if not varying:
        words = "" if len(paths) == 1 else ", in the order of the alphabet: no number in their names gives one"
        if len({path.stem for path in paths}) < len(paths):
            raise InputError(subject, f"{paths[1].name} after {paths[0].name}: one name twice", "every name once", remedy)
        return Series(paths, None, f"frames: {_ends(paths)}{words}")
    distinct = sorted((column for column in varying if column.is_distinct), key=lambda column: column.rank)
    if order is not None:
        distinct = [column for column in columns if column.place == order][:1]
    # two numbers may count together, such as turn and frame; then every combination exists once
    pairs = set(zip(*(column.values.tolist() for column in varying), strict=True))
    are_pairs = len(pairs) == len(paths) == np.prod([len(np.unique(column.values)) for column in varying])
    key = distinct[0] if distinct else max(varying, key=lambda column: len(np.unique(column.values)))
    keys = [key] if distinct or not are_pairs or len(varying) == 1 else varying
    at = np.lexsort([column.values for column in reversed(keys)])
    paths = [paths[i] for i in at]
    if len(keys) > 1:
        places = " and ".join(str(column.place) for column in keys)
        return Series(paths, np.arange(len(paths)), f"frames: {_ends(paths)}, by the numbers {places} in their names")
    numbers, (step, of_usual) = key.values[at], key.steps
    is_index = not key.is_angle and key.values.dtype.kind == "i" and numbers[-1] < _STAMP
    is_gap = np.abs(of_usual - 1) > _STEADY if is_index else (of_usual >= _GAP) & (key.regular >= _STEADY_ANGLES)
    is_double = np.diff(numbers) == 0
    for gap in np.flatnonzero(is_double if is_double.any() else is_gap & (not holes))[:1]:
        kind = "one number twice, or a hole" if is_double.any() else "a hole"
        found = f"{paths[gap + 1].name} after {paths[gap].name}: {kind} in the numbering"
        raise InputError(subject, found, "every number once", remedy)
    rank = np.argsort(np.argsort(key.values))
    for other in distinct[1:]:
        others = np.argsort(np.argsort(other.values))
        if not (np.array_equal(others, rank) or np.array_equal(others, rank[::-1])):
            text = "%s: number %d in the names gives the order, and %s %d another one: say [frames] order = %d for that"
            _log.warning(text, subject, key.place, other.what, other.place, other.place)
            break
    steps = f"in steps of {step:g}" if key.regular == 1 else "in uneven steps, in which no hole shows"
    by = f"by {key.what} {key.place} in their names, {numbers[0]:g} to {numbers[-1]:g} {steps}"
    return Series(paths, numbers, f"frames: {_ends(paths)}, {by}")


def _ends(paths: list[Path]) -> str:
    return paths[0].name if len(paths) == 1 else f"{len(paths)} files, {paths[0].name} to {paths[-1].name}"


def _words(name: str) -> tuple[str, ...]:
    return tuple(_NUMBER.sub("\0", _TIME.sub("\0", name)).lower().split("\0"))


def _of_one_series(paths: list[Path], subject: str) -> list[Path]:
    """Returns the files whose names have the most frequent words. Other words that take turns with these, as in a_1, b_2,
    a_3, belong to the series too. Raises InputError for several series."""
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path in paths:
        groups.setdefault(_words(path.stem), []).append(path)
    largest = max(groups.values(), key=len)
    if len(largest) == 1:
        return paths
    large = [group for group in groups.values() if len(group) >= max(2, _SMALL * len(largest))]
    taken = [path for path in paths if any(_words(path.stem) == _words(group[0].stem) for group in large)]
    if len(large) > 1 and not _do_alternate(large):
        names = ", ".join(f"{group[0].name} and {len(group) - 1} more" for group in large[:_MOST_NAMES])
        remedy = "name one of them as the projections, and others as flats or darks"
        raise InputError(subject, f"several series of files: {names}", "one", remedy)
    if strays := [path.name for path in paths if path not in taken]:
        text = "%s: %d files are no frames by their names, and are left out: %s"
        _log.warning(text, subject, len(strays), ", ".join(strays[:_MOST_NAMES]))
    return taken


def _do_alternate(groups: list[list[Path]]) -> bool:
    """Returns whether groups of files take turns, as a_1, b_2, a_3 do: if the files are sorted by a number in their names,
    the group changes at least as often as the smallest group has files."""
    if len({len(_words(group[0].stem)) for group in groups}) > 1:
        return False
    owner = [i for i, group in enumerate(groups) for _ in group]
    for column in _columns([path.stem for group in groups for path in group]):
        if column.is_distinct:
            sorted_owner = np.array(owner)[np.argsort(column.values)]
            return bool(np.count_nonzero(np.diff(sorted_owner)) >= min(map(len, groups)))
    return False


def _columns(names: list[str]) -> list[_Column]:
    """Returns the numbers in names, by position. A date with a time in all names becomes one number, in s, if no other
    number differs between all files."""
    columns, clocks = _read(names), [_TIME.search(name) for name in names]
    others = _read([_TIME.sub("", name) for name in names])
    if all(clocks) and not any(column.is_distinct for column in others):
        times = [datetime(*map(int, clock.groups())) for clock in clocks if clock]  # type: ignore[arg-type]
        seconds = np.array([(time - times[0]).total_seconds() for time in times])
        return [*others, _Column(len(columns) + 1, seconds, False)]
    return columns


def _read(names: list[str]) -> list[_Column]:
    found = [list(_NUMBER.finditer(name)) for name in names]
    if len({len(numbers) for numbers in found}) > 1:
        return []
    return [column for place, numbers in enumerate(zip(*found, strict=True), 1) for column in _column(place, numbers)]


def _column(place: int, numbers: tuple[re.Match[str], ...]) -> Iterator[_Column]:
    """Yields the numbers at one position as one column; as two if a point separates two indices, as in 3.9 and 3.12."""
    befores, afters = ([one.string[: one.start()] for one in numbers], [one.string[one.end() :] for one in numbers])
    is_angle = all(map(_DEGREES.match, afters)) or all(map(_ANGLE.search, befores))
    signs, decimals = [one[1] for one in numbers], [one[3] or "" for one in numbers]
    # a hyphen that all names have separates words; it is a minus only before angles and behind no letter or digit
    is_signed = not all(signs) or (is_angle and not any(before[-1:].isalnum() for before in befores))
    sign = np.array([-1 if is_signed and one == "-" else 1 for one in signs])
    whole = np.array([int(one[2]) for one in numbers])
    if not any(decimals):
        yield _Column(place, whole * sign, is_angle)
    elif is_angle or len({len(one) for one in decimals}) == 1:
        yield _Column(place, sign * [float(f"{one[2]}.{one[3] or 0}") for one in numbers], is_angle)
    else:
        yield _Column(place, whole, False)
        yield _Column(place, np.array([int(one or 0) for one in decimals]), False)


def flat_places(flats: list[Path], darks: list[Path], series: Series) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns when flats and projections were taken (``frames.Moments``). Words such as "before" in the flats' names show
    it, or numbers that continue through flats, darks and projections. Returns None if neither does."""
    ends = [[bool(words.search(path.stem)) for path in flats] for words in (_BEFORE, _AFTER)]
    if flats and all(map(np.logical_xor, *ends)):
        return np.where(ends[0], -0.5, len(series.paths) - 0.5), np.arange(len(series.paths))
    own = [_columns([path.stem for path in paths]) for paths in (flats, darks) if paths]
    if not flats or not all(own) or series.numbers is None:
        return None
    numbers = [*(columns[-1].values for columns in own), series.numbers]
    if np.any(np.diff(np.sort(np.concatenate(numbers))) != 1):
        return None
    return numbers[0], series.numbers
