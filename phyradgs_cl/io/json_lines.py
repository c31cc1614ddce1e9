"""Results files: one JSON line per run, appended. A damaged line is left out, and the next one begins on a line of its
own."""

import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.io.files import read_regular, regular_file
from phyradgs_cl.text import plain_text

Line = dict[str, Any]
log = logging.getLogger(__name__)
_EXPECTED = "a results file (JSON lines)"
_MOST_BYTES = 1 << 30


def read_lines(path: Path, is_sound: Callable[[Line], bool] = lambda line: True) -> list[Line]:
    """Reads the lines of a results file that are whole and pass ``is_sound``, and warns of others; no lines where there
    is no file. InputError for a file that cannot be read, or with content but no result."""
    text = ""
    if path.exists():
        text = read_regular(path, str(path), _MOST_BYTES, _EXPECTED).decode(errors="replace")
    lines: list[Line] = []
    damaged = []
    for number, row in enumerate(text.split("\n"), 1):
        line = _parsed(row)
        if line is not None and is_sound(line):
            lines.append(line)
        elif row.strip():
            damaged.append(number)
    if damaged and not lines and len(damaged) > 1:
        raise InputError(str(path), "no result in any line", _EXPECTED, "choose another -o")
    if damaged:
        where = ("line %s is" if len(damaged) == 1 else "lines %s are") % ", ".join(map(str, damaged))
        log.warning("%s: %s damaged and left out", path, where)
    return lines


def refuse_irregular(path: Path) -> None:
    """Raises InputError for an existing path that is no regular file: reading a device or a pipe may never end."""
    if path.exists():
        regular_file(path, str(path), _EXPECTED)


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Appends one line in a single write, and waits until it is on the disk."""
    text = json_text(line) + "\n"
    try:
        with open(path, "ab+") as file:
            if _is_open_ended(file):
                text = "\n" + text
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        expected = "a file that can be appended to"
        raise OutputError(str(path), error.strerror or str(error), expected) from error


def json_text(value: object) -> str:
    """Returns JSON with finite numbers and readable text."""
    return plain_text(json.dumps(value, ensure_ascii=False, allow_nan=False))


def _parsed(row: str) -> Line | None:
    try:
        line = json.loads(row)
    except (ValueError, RecursionError):
        return None
    return line if isinstance(line, dict) and "run" in line else None


def _is_open_ended(file: Any) -> bool:
    if file.seek(0, os.SEEK_END) == 0:
        return False
    file.seek(-1, os.SEEK_END)
    return bool(file.read(1) != b"\n")
