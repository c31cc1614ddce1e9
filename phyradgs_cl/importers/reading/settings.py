"""Descriptions of scans as lines of names and values: the INI files and logs that scanners and toolkits write."""

import logging
import math
import re
from collections.abc import Collection, Mapping
from pathlib import Path

from phyradgs_cl.importers.reading.files import read_bytes
from phyradgs_cl.io.tables import Fields

_log = logging.getLogger(__name__)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?=$|[\s;])")


def read_settings(
    path: Path, names: Collection[str], separator: str = "=", sections: Collection[str] = ()
) -> Fields:
    """Reads the lines NAME ``separator`` VALUE whose name is one of ``names``, in any case; other lines are not looked at.

    A value that begins with a number is that number; other text stays text. ``sections``: the only [sections] that count,
    in any case; () takes all. Of a name that comes twice the first counts."""
    spelt = {name.lower(): name for name in names}
    wanted = {section.lower() for section in sections}
    values: dict[str, object] = {}
    is_inside = not wanted
    for raw in read_bytes(path).decode("utf-8-sig", "replace").splitlines():
        line = raw.strip()
        if line.startswith("[") and line.endswith("]"):
            is_inside = not wanted or line[1:-1].strip().lower() in wanted
            continue
        key, sign, text = line.partition(separator)
        name = spelt.get(key.strip().lower())
        if is_inside and sign and name and text.strip():
            values.setdefault(name, _value(text.strip()))
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


def _value(text: str) -> float | str:
    found = _NUMBER.match(text)
    value = float(found.group()) if found else math.nan
    return value if math.isfinite(value) else text
