"""The results file, and which runs it holds."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from phyradgs_cl.workflow.sweep import Line, append_line, read_lines

__all__ = ["KEY", "Line", "Present", "append_line", "key_of", "read_lines"]

# The facts that identify a run. Its options are compared as well.
KEY = (
    "study", "volume", "source", "run", "acquisition", "voxels", "pixels", "protocol", "axis", "seed", "iterations",
)  # fmt: skip


def key_of(line: Mapping[str, Any]) -> tuple[Any, ...]:
    """Returns the identity of a run."""
    return tuple(line.get(name) for name in KEY)


class Present:
    """Which runs a results file holds."""

    def __init__(self, lines: Sequence[Line]) -> None:
        self._by_key: dict[tuple[Any, ...], list[Line]] = defaultdict(list)
        for line in lines:
            self.add(line)

    def add(self, line: Line) -> None:
        """Adds a line. Failed runs do not count."""
        if "error" not in line:
            self._by_key[key_of(line)].append(line)

    def has(self, facts: Mapping[str, Any]) -> bool:
        """Returns whether the run that ``facts`` describe was made, with the same options.

        Options that only one of the two has, because the program has changed, are not compared."""
        same = self._by_key.get(key_of(facts), ())
        return any(_agree(line.get("options"), facts.get("options")) for line in same)


def _agree(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return all(_agree(a[name], b[name]) for name in a.keys() & b.keys())
    return bool(a == b)
