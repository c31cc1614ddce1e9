"""The lines of a sweep's results file, and the table of means over scans and seeds that is made of them."""

import json
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl.errors import OutputError
from phyradgs_cl.metrics import HELD_OUT, METRICS
from phyradgs_cl.text import plain_text

Line = dict[str, Any]
log = logging.getLogger(__name__)


def markdown(lines: Sequence[Line], planned: int) -> str:
    """Returns means and standard deviations over the scans and seeds of every setting, and the failed runs below."""
    done, failed = [line for line in lines if "error" not in line], [line for line in lines if "error" in line]
    measured = {name for line in done for name in line["metrics"]}
    metrics = {**METRICS, **{name: metric for name, metric in HELD_OUT.items() if name in measured}}
    headings = ["setting", "runs", *(metric.heading for metric in metrics.values()), "seconds"]
    title = f"{len(done)} of {planned} runs, {len(failed)} failed; mean ± standard deviation over scans and seeds."
    rows = [title, "", _row(headings), _row(["---"] + ["---:"] * (len(headings) - 1))]
    for label in dict.fromkeys(line["label"] for line in done):
        same = [line for line in done if line["label"] == label]
        means = [_mean([line["metrics"].get(name) for line in same], metric.form) for name, metric in metrics.items()]
        rows.append(_row([label, str(len(same)), *means, _mean([line["seconds"] for line in same], ".1f")]))
    if failed:
        rows += ["", _row(["failed run", "setting", "error"]), _row(["---"] * 3)]
    return "\n".join([*rows, *(_row([line["run"], line["label"], line["error"]]) for line in failed), ""])


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _mean(values: Sequence[Any], form: str) -> str:
    numbers = [float(value) for value in values if value is not None]
    spread = f" ± {np.std(numbers, ddof=1):{form}}" if len(numbers) > 1 else ""
    return f"{np.mean(numbers):{form}}{spread}" if numbers else "–"


def read_lines(path: Path) -> list[Line]:
    """Reads the lines of a results file that are whole, and warns of others; no lines where there is no file."""
    lines, damaged = [], []
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    for number, row in enumerate(text.split("\n"), 1):
        try:
            line = json.loads(row)
            lines.append({"run": line["run"], **line})
        except (ValueError, KeyError, TypeError):
            damaged += [str(number)] if row.strip() else []
    if damaged:
        log.warning("%s: damaged and left out: line %s", path, ", ".join(damaged))
    return lines


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Appends one line in a single write, and waits until it is on the disk."""
    text = plain_text(json.dumps(line, ensure_ascii=False, allow_nan=False, default=str)) + "\n"
    try:
        with open(path, "ab+") as file:
            if file.tell() and file.seek(-1, os.SEEK_END) >= 0 and file.read(1) != b"\n":
                text = "\n" + text  # after a line that was cut off
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(str(path), error.strerror or str(error), "a file that can be appended to") from error
