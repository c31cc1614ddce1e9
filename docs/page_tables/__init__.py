"""Makes the tables of pages in Markdown, by name, from recorded runs in docs/results."""

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parent.parent / "results"
TABLES: dict[str, Callable[[], str]] = {}
"""What makes each table."""
Row = dict[str, str]
Scores = dict[str, Any]


def table(name: str, *given: Any) -> Callable[[Callable[..., str]], Callable[..., str]]:
    """Marks what makes a table when it is called with ``given``."""

    def marked(make: Callable[..., str]) -> Callable[..., str]:
        TABLES[name] = lambda: make(*given)
        return make

    return marked


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def facts_of(name: str) -> Any:
    """Returns what a JSON file in docs/results holds."""
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def lines_of(name: str) -> list[Scores]:
    """Returns the lines of a JSONL file in docs/results."""
    return [json.loads(line) for line in (RESULTS / name).read_text(encoding="utf-8").splitlines()]


def grouped(lines: Iterable[Scores], *keys: str) -> dict[tuple[Any, ...], list[Scores]]:
    """Returns the lines by their values of ``keys``, in the order in which these come first."""
    groups: dict[tuple[Any, ...], list[Scores]] = {}
    for line in lines:
        groups.setdefault(tuple(line[key] for key in keys), []).append(line)
    return groups


def span(values: Sequence[float], form: str) -> str:
    """Returns the least and the largest value, or the only one. A minus would be lost beside a dash."""
    least, most = (f"{value:{form}}" for value in (min(values), max(values)))
    return least if least == most else f"{least} to {most}" if min(values) < 0 else f"{least}–{most}"


def rows_of(name: str) -> dict[tuple[str, str, str], Row]:
    """Returns the rows of a benchmark's CSV by protocol, row and acquisition."""
    with open(RESULTS / name, encoding="utf-8") as file:
        return {(row["protocol"], row["row"], row["acquisition"]): row for row in csv.DictReader(file)}
