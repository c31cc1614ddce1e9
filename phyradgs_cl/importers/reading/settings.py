"""Descriptions of scans as lines of names and values: the INI files and logs that scanners and toolkits write."""

import logging
import math
import re
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.files import read_bytes
from phyradgs_cl.io.tables import Fields

_log = logging.getLogger(__name__)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?=$|[\s;])")

_ONE_ANGLE = 1e-6
_BRIGHTER, _FEW = 1.2, 0.01  # of the counts of air: no noise of air is so bright; fraction of pixels that may be broken


def read_settings(
    path: Path, names: Collection[str], separator: str = "=", sections: Collection[str] = ()
) -> Fields:
    """Reads the lines NAME ``separator`` VALUE whose name is one of ``names``, in any case; other lines are not looked at.

    A value that begins with a number is that number; other text stays text. ``sections``: the only [sections] that count,
    in any case; () takes all. Of a name in two sections the first counts. InputError for a file without any of the names,
    and for one section that gives a name two values."""
    spelt = {name.lower(): name for name in names}
    wanted = {section.lower() for section in sections}
    values: dict[str, object] = {}
    texts: dict[tuple[str, str], str] = {}
    section, is_inside = "", not wanted
    for raw in read_bytes(path).decode("utf-8-sig", "replace").splitlines():
        line = raw.strip()
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1].strip().lower()
            is_inside = not wanted or section in wanted
            continue
        key, sign, text = line.partition(separator)
        name = spelt.get(key.strip().lower())
        if is_inside and sign and name and text.strip():
            values.setdefault(name, _value(text.strip()))
            earlier = texts.setdefault((section, name), text.strip())
            if earlier != text.strip():
                pair = f"{earlier[:40]!r} and {text.strip()[:40]!r}"
                raise InputError(f"{path}: {name}", pair, "one value", "are these two descriptions in one file?")
    if not values:
        expected = f"lines such as {', '.join(list(names)[:4])}"
        raise InputError(str(path), f"nothing of a description: no line NAME {separator} VALUE", expected, "copy it again")
    return Fields(f"{path}:", values)


def head_has(path: Path, *marks: bytes, most_bytes: int = 1 << 14) -> bool:
    """True for a regular file whose beginning has all the marks, in any case."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        head = file.read(most_bytes).lower()
    return all(mark.lower() in head for mark in marks)


def say_missing(fields: Fields, meanings: Mapping[str, str]) -> None:
    """Says in one line which of the names the description lacks, and what that means."""
    missing = [f"no {name} ({meaning})" for name, meaning in meanings.items() if not fields.has(name)]
    if missing:
        _log.warning("%s %s", fields.subject, ", ".join(missing))


def differing(fields: Fields, key: str, angle_deg: np.ndarray) -> np.ndarray:
    """Returns angles (F,) in rad. InputError about ``key``, which states them, where all of several are the same."""
    angle_rad = np.deg2rad(angle_deg)
    if len(angle_rad) > 1 and np.ptp(np.cos(angle_rad)) + np.ptp(np.sin(angle_rad)) < _ONE_ANGLE:
        raise fields.error(key, f"{len(angle_rad)} views at one angle", "a turn between the views")
    return angle_rad


def white_level(fields: Fields, key: str, frames: np.ndarray, remedy: str) -> float:
    """Returns the counts of air that ``key`` states. InputError where frames (F, v, u) are much brighter."""
    white = fields.length(key)
    brighter = sum(np.count_nonzero(frame > _BRIGHTER * white) for frame in frames) / frames.size
    if brighter > _FEW:
        found = f"{white:g} counts, and {100 * brighter:.3g} % of the pixels at more than {_BRIGHTER:g} times as many"
        raise fields.error(key, found, "the counts of air, which nothing outshines", remedy)
    return white


def _value(text: str) -> float | str:
    found = _NUMBER.match(text)
    value = float(found.group()) if found else math.nan
    return value if math.isfinite(value) else text
