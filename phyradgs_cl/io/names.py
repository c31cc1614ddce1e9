"""Names of the files that go with another: its checkpoint, its lock, its message."""

import hashlib
import os
from pathlib import Path

_LONGEST_BYTES = 255  # of a name, in every file system that is common


def shortened(name: str, most_bytes: int) -> str:
    """``name``, or as much of it as fits in front of a digest of all of it."""
    raw = os.fsencode(name)
    if len(raw) <= most_bytes:
        return name
    ending = f"~{hashlib.sha256(raw).hexdigest()[:12]}"
    return raw[: most_bytes - len(ending)].decode("utf-8", "ignore") + ending


def beside(path: str | Path, ending: str, beginning: str = "") -> Path:
    """The path ``beginning`` + name + ``ending`` in the same folder, shortened where no file system would take it."""
    room = _LONGEST_BYTES - len(os.fsencode(beginning + ending))
    path = Path(path)
    return path.with_name(f"{beginning}{shortened(path.name, room)}{ending}")
