"""Readout of a panel: in which order lines are read, and how data sheets state this order, frame rate and readout time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import transpose_pose
from phyradgs_cl.errors import InputError

# The readout axis and direction for each side of the panel, seen from the source, at which the readout may begin.
FIRST_LINES = {"bottom": ("rows", 1), "top": ("rows", -1), "left": ("columns", 1), "right": ("columns", -1)}
SIDES = tuple(FIRST_LINES)
Named = Callable[[str], str]
"""Translates a field's name to what the user wrote, for messages: an argument, an option or a key of a TOML file."""


@dataclass(frozen=True)
class Readout:
    """The ``axis`` of readout: whether the panel reads "rows" or "columns" one after the other.

    Operators need frames and poses in the order (lines, width): the rows or columns that are read one after the other, and
    the pixels of each. The methods convert them from (rows, columns) and back."""

    axis: str

    def shape(self, detector_shape: tuple[int, int]) -> tuple[int, int]:
        """Returns (lines, width) of a detector with (rows, columns)."""
        rows, columns = detector_shape
        return (rows, columns) if self.axis == "rows" else (columns, rows)

    def frames(self, frames: np.ndarray) -> np.ndarray:
        """Returns a view of frames (..., rows, columns) as (..., lines, width). A second call converts them back."""
        return frames if self.axis == "rows" else frames.swapaxes(-1, -2)

    def poses(self, pose: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) for frames in the order (lines, width). A second call converts them back."""
        return pose if self.axis == "rows" else transpose_pose(pose)

    def spread(self, by_line: np.ndarray) -> np.ndarray:
        """Returns values (..., lines), one for each line, as a view that broadcasts with frames (..., rows, columns)."""
        return by_line[..., :, None] if self.axis == "rows" else by_line[..., None, :]


def readout_order(
    first: str | None, axis: str | None, direction: int | None, named: Named = str
) -> tuple[str | None, int | None]:
    """Returns the readout axis and direction. ``first``, a key of ``FIRST_LINES``, states both. If it is None, ``axis`` and
    ``direction`` are returned. Raises InputError for another ``first``, and if the other arguments contradict it."""
    if first is None:
        return axis, direction
    checks.one_of(named("first"), first, FIRST_LINES)
    for name, value, meant in zip(("readout_axis", "readout_direction"), (axis, direction), FIRST_LINES[first], strict=True):
        if value not in (None, meant):
            found = f"{first!r} with {named(name)} {value!r}"
            raise InputError(named("first"), found, f"{meant!r}, which {first!r} means", f"leave {named(name)} out")
    return FIRST_LINES[first]


def frame_time_of(fps: float | None, frame_time_s: float | None, named: Named = str) -> float | None:
    """Returns the seconds between frames: 1/``fps``, or ``frame_time_s`` if fps is None. Raises InputError for fps not above
    0, and if both are given and differ. named: translates the names of arguments in messages."""
    if fps is None:
        return frame_time_s
    checks.positive(named("fps"), fps)
    return _agreed(1 / fps, named("fps"), f"{fps:g} (every {1 / fps:.4g} s)", frame_time_s, named("frame_time_s"))


def seconds_of(word: str, in_ms: float | None, in_s: float | None, named: Named = str) -> float | None:
    """Returns a time in s: ``in_ms``/1000, or ``in_s`` if ``in_ms`` is None. Raises InputError for ``in_ms`` below 0, and if
    both are given and differ. word: "exposure" or "readout". named: translates the names of arguments in messages."""
    if in_ms is None:
        return in_s
    checks.at_least(named(f"{word}_ms"), in_ms, 0)
    return _agreed(in_ms / 1000, named(f"{word}_ms"), f"{in_ms:g}", in_s, named(f"{word}_s"))


def check_readout(readout_ms: float | None, readout_ratio: float | None, fps: float | None, named: Named = str) -> None:
    """Raises InputError for ``readout_ratio`` outside 0 to 1000, ``readout_ms`` below 0, without ``fps`` or with a ratio."""
    if readout_ratio is not None:
        checks.within(named("readout_ratio"), readout_ratio, 0, 1000)
    if readout_ms is None:
        return
    checks.at_least(named("readout_ms"), readout_ms, 0)
    if readout_ratio is not None:
        subject = named("readout_ratio")
        raise InputError(named("readout_ms"), f"{readout_ms:g} with {subject}", "one of the two", f"leave {subject} out")
    if fps is None:
        raise InputError(named("readout_ms"), f"{readout_ms:g} without a frame rate", "both", f"give {named('fps')} too")


def _agreed(time_s: float, subject: str, found: str, other_s: float | None, other: str) -> float:
    if other_s not in (None, time_s):
        raise InputError(subject, f"{found} with {other} {other_s:g}", "one of the two", f"leave {other} out")
    return time_s
