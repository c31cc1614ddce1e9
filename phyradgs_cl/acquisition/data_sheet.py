"""A panel's data sheet in this package's terms: which line is read first, frames per second, readout in ms."""

from collections.abc import Callable

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

# by the side of the panel that is read first, seen from the source: readout axis and direction
FIRST_LINES = {"bottom": ("rows", 1), "top": ("rows", -1), "left": ("columns", 1), "right": ("columns", -1)}
Named = Callable[[str], str]
"""How a message calls a field: an argument of Python, an option of the command line or a key of a TOML file."""


def readout_order(
    first: str | None, axis: str | None, direction: int | None, named: Named = str
) -> tuple[str | None, int | None]:
    """Readout axis and direction; ``first``, a key of ``FIRST_LINES``, states both. InputError where they contradict."""
    if first is None:
        return axis, direction
    checks.one_of(named("first"), first, FIRST_LINES)
    for name, value, meant in zip(("readout_axis", "readout_direction"), (axis, direction), FIRST_LINES[first], strict=True):
        if value not in (None, meant):
            found = f"{first!r} with {named(name)} {value!r}"
            raise InputError(named("first"), found, f"{meant!r}, which {first!r} means", f"leave {named(name)} out")
    return FIRST_LINES[first]


def frame_time_of(fps: float | None, frame_time_s: float | None, named: Named = str) -> float | None:
    """Seconds from frame to frame, from frames per second or as given. InputError where the two differ."""
    if fps is None:
        return frame_time_s
    checks.positive(named("fps"), fps)
    return _agreed(1 / fps, named("fps"), f"{fps:g} (every {1 / fps:.4g} s)", frame_time_s, named("frame_time_s"))


def readout_of(readout_ms: float | None, readout_s: float | None, named: Named = str) -> float | None:
    """Readout time in s, from ms or as given. InputError where the two differ."""
    if readout_ms is None:
        return readout_s
    checks.at_least(named("readout_ms"), readout_ms, 0)
    return _agreed(readout_ms / 1000, named("readout_ms"), f"{readout_ms:g}", readout_s, named("readout_s"))


def _agreed(time_s: float, subject: str, found: str, other_s: float | None, other: str) -> float:
    if other_s not in (None, time_s):
        raise InputError(subject, f"{found} with {other} {other_s:g}", "one of the two", f"leave {other} out")
    return time_s
