"""The results file: which runs it holds."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from phyradgs_cl.workflow.sweep.tables import Line, append_line, refuse_irregular
from phyradgs_cl.workflow.sweep.tables import read_lines as sound_lines

__all__ = ["KEY", "Line", "Present", "append_line", "key_of", "read_lines", "refuse_irregular"]

# What makes a run the same run; its options are compared besides.
KEY = (
    "study", "volume", "source", "run", "acquisition", "voxels", "pixels", "protocol", "axis", "seed", "iterations",
)  # fmt: skip


def read_lines(path: Path) -> list[Line]:
    """All sound lines of a benchmark's results file, with a word about others; none where there is no file.

    Raises:
        InputError: a file that cannot be read, or that has content but no result.
    """
    return sound_lines(path, _is_sound)


def _is_sound(line: Line) -> bool:
    """Whether the parts of a line that are read have their types: a hand may have edited it."""
    metrics = line.get("metrics", {})
    return isinstance(metrics, dict) and not any(isinstance(line.get(name), list | dict) for name in KEY)


def key_of(line: Mapping[str, Any]) -> tuple[Any, ...]:
    """The identity of a run."""
    return tuple(line.get(name) for name in KEY)


class Present:
    """Which runs a results file holds."""

    def __init__(self, lines: Sequence[Line]) -> None:
        self._by_key: dict[tuple[Any, ...], list[Line]] = defaultdict(list)
        for line in lines:
            self.add(line)

    def add(self, line: Line) -> None:
        """One line more; those of failed runs do not count."""
        if "error" not in line:
            self._by_key[key_of(line)].append(line)

    def has(self, facts: Mapping[str, Any]) -> bool:
        """Whether the run that ``facts`` describe was made, with the same options.

        Options that one of the two does not know, because the program has gained or lost them since, are not
        compared.
        """
        same = self._by_key.get(key_of(facts), ())
        return any(_agree(line.get("options"), facts.get("options")) for line in same)


def _agree(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return all(_agree(a[name], b[name]) for name in a.keys() & b.keys())
    return bool(a == b)
