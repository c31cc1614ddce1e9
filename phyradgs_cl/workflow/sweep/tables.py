"""The lines of a sweep's results file, and the tables made of them: a row per setting (Markdown), a record per run (CSV)."""

import csv
import io
import json
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.io import written_beside
from phyradgs_cl.io.files import read_regular
from phyradgs_cl.metrics import HELD_OUT, METRICS
from phyradgs_cl.text import flattened, plain_text

_FACTS = ("run", "scan", "method", "preset", "seed")
_RESULTS = (*METRICS, *HELD_OUT, "seconds", "gaussians", "device", "host", "version", "volume", "error")
Line = dict[str, Any]
log = logging.getLogger(__name__)
_EXPECTED = "a results file (JSON lines)"
_MOST_BYTES = 1 << 30


def identity(line: Line) -> tuple[Any, ...]:
    """Returns the values that equal lines of one run share: its name, and the size and time of the scan file. Names are as a
    results file has them, where text that is no UTF-8 is replaced."""
    values = (line.get(name) for name in ("run", "scan", "scan_bytes", "scan_mtime_ns"))
    return tuple(plain_text(value) if isinstance(value, str) else value for value in values)


def write_tables(folder: Path, lines: Sequence[Line], planned: Sequence[Line]) -> list[Path]:
    """Writes results.md and results.csv of the newest lines of the planned runs; returns both paths."""
    newest = {line["run"]: line for line in lines}
    rows = [newest[facts["run"]] for facts in planned if identity(newest.get(facts["run"], {})) == identity(facts)]
    tables = {"results.md": markdown(rows, len(planned)), "results.csv": comma_separated(rows)}
    paths = [folder / name for name in tables]
    for path, text in zip(paths, tables.values(), strict=True):
        with written_beside(path) as temporary:
            temporary.write_text(plain_text(text), encoding="utf-8", newline="")
    return paths


def markdown(lines: Sequence[Line], planned: int) -> str:
    """Returns means and standard deviations over the scans and seeds of every setting, and the failed runs below."""
    done = [line for line in lines if "error" not in line]
    measured = {name for line in done for name in line["metrics"]}
    metrics = {**METRICS, **{name: metric for name, metric in HELD_OUT.items() if name in measured}}
    rows = [
        f"{len(done)} of {planned} runs, {len(lines) - len(done)} failed; mean ± standard deviation over scans and seeds.",
        "",
        "| setting | runs | " + " | ".join(metric.heading for metric in metrics.values()) + " | seconds |",
        "| --- | ---: |" + " ---: |" * (len(metrics) + 1),
    ]
    for label in dict.fromkeys(line["label"] for line in done):
        same = [line for line in done if line["label"] == label]
        cells = [_cell(label), str(len(same))]
        cells += [_mean([line["metrics"].get(name) for line in same], metric.form) for name, metric in metrics.items()]
        cells.append(_mean([line["seconds"] for line in same], ".1f"))
        rows.append("| " + " | ".join(cells) + " |")
    rows += _failures([line for line in lines if "error" in line])
    return "\n".join([*rows, ""])


def _failures(failed: Sequence[Line]) -> Iterator[str]:
    if failed:
        yield from ("", "| failed run | setting | error |", "| --- | --- | --- |")
    for line in failed:
        yield f"| {_cell(line['run'])} | {_cell(line['label'])} | {_cell(line['error'])} |"


def comma_separated(lines: Sequence[Line]) -> str:
    """Returns a record per run, with a column for every option that any run states."""
    options = [dict(flattened({**line["input"], **line["changes"]})) for line in lines]
    names = list(dict.fromkeys(name for stated in options for name in stated))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*_FACTS, *names, *_RESULTS])
    for line, stated in zip(lines, options, strict=True):
        values = {**line, **line.get("metrics", {})}
        facts, results = ([values.get(name) for name in columns] for columns in (_FACTS, _RESULTS))
        writer.writerow([*facts, *(stated.get(name) for name in names), *results])
    return stream.getvalue()


def _mean(values: Sequence[Any], form: str) -> str:
    numbers = [float(value) for value in values if value is not None]
    if not numbers:
        return "–"
    mean = format(np.mean(numbers), form)
    return f"{mean} ± {np.std(numbers, ddof=1):{form}}" if len(numbers) > 1 else mean


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def read_lines(path: Path) -> list[Line]:
    """Reads the lines of a results file that are whole, and warns of others; no lines where there is no file. InputError for
    a file that cannot be read, or with content but no result."""
    text = ""
    if path.exists():
        text = read_regular(path, str(path), _MOST_BYTES, _EXPECTED).decode(errors="replace")
    lines: list[Line] = []
    damaged = []
    for number, row in enumerate(text.split("\n"), 1):
        line = _parsed(row)
        if line is not None:
            lines.append(line)
        elif row.strip():
            damaged.append(number)
    if damaged and not lines and len(damaged) > 1:
        raise InputError(str(path), "no result in any line", _EXPECTED, "choose another -o")
    if damaged:
        where = ("line %s is" if len(damaged) == 1 else "lines %s are") % ", ".join(map(str, damaged))
        log.warning("%s: %s damaged and left out", path, where)
    return lines


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
    except ValueError:
        return None
    return line if isinstance(line, dict) and "run" in line else None


def _is_open_ended(file: Any) -> bool:
    if file.seek(0, os.SEEK_END) == 0:
        return False
    file.seek(-1, os.SEEK_END)
    return bool(file.read(1) != b"\n")
