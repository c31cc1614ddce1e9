"""Finds the volumes of a folder, and chooses the projected one of several resolutions."""

import re
from collections.abc import Sequence
from pathlib import Path

from phyradgs_cl.errors import InputError
from phyradgs_cl.text import suggest_name

_COUNTED = re.compile(r"(?P<name>.+)_(?P<count>\d+)")


def find_volumes(folder: Path, names: Sequence[str] | None, voxels: int) -> dict[str, Path]:
    """Returns name to file of the volumes in ``folder``, in alphabetical order, or of those in ``names``.

    Files are NAME_COUNT.h5 or NAME.h5. Of files with one name, the one with twice ``voxels`` per side is taken, otherwise
    the largest. Raises InputError for a missing folder, a folder without volumes, and a name that is not there."""
    if not folder.is_dir():
        raise InputError("--volumes", str(folder), "a folder of HDF5 volumes", "check the path")
    found: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.glob("*.h5")):
        match = _COUNTED.fullmatch(path.stem)
        name, count = (match["name"], int(match["count"])) if match else (path.stem, 0)
        found.setdefault(name, {})[count] = path
    if not found:
        expected = "files NAME_COUNT.h5 or NAME.h5 with a dataset /volume (z, y, x)"
        raise InputError("--volumes", f"no .h5 file in {folder}", expected)
    for name in names or ():
        if name not in found:
            raise InputError("--names", repr(name), f"one of {', '.join(found)}", suggest_name(name, found, ""))
    chosen = list(dict.fromkeys(names)) if names else list(found)
    return {name: _best(found[name], 2 * voxels) for name in chosen}


def _best(files: dict[int, Path], wanted: int) -> Path:
    return files.get(wanted) or files[max(files)]
