"""Files of a foreign folder, opened only where they really lie in it: no absolute path, "..", link or device."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.regular import regular_file

_MOST_FILES = 200_000
_LONGEST_NAME = 4096


@dataclass(frozen=True)
class SafeFolder:
    """A folder that the user named; only what is inside can be reached through it."""

    root: Path

    def __post_init__(self) -> None:
        if not self.root.is_dir():
            what = "a file" if self.root.exists() else "nothing there"
            raise InputError(str(self.root), what, "a folder", "check the path")

    def file(self, name: object, subject: str) -> Path:
        """The regular file ``name`` below the folder; ``subject`` says where the name was found."""
        text = checked_name(name, subject)
        path = self.root
        for part in PurePosixPath(text).parts:
            path = path / part
            if path.is_symlink():
                raise InputError(subject, f"{text!r}, which leads over a symbolic link", "a plain file")
        regular_file(path, subject)
        return path

    def exists(self, name: str) -> bool:
        """Whether there is an entry of this plain name, whatever it is."""
        return (self.root / name).exists() or (self.root / name).is_symlink()

    def matching(self, *suffixes: str) -> list[Path]:
        """Regular files of the folder itself whose names end so (any case), in natural order of their names."""
        found = []
        for number, path in enumerate(self.root.iterdir()):
            if number >= _MOST_FILES:
                raise InputError(str(self.root), f"more than {_MOST_FILES} files", "a folder with one scan")
            if path.suffix.lower() in suffixes and not path.name.startswith("."):
                found.append(self.file(path.name, f"{self.root}/{path.name}"))
        return in_natural_order(found)

    def only(self, what: str, *suffixes: str) -> Path:
        """The folder's one regular file whose name ends so, which is ``what``."""
        found = self.matching(*suffixes)
        if len(found) != 1:
            names = ", ".join(path.name for path in found[:5]) or "none"
            expected, remedy = f"one {what}", "leave only one, or name the file itself"
            raise InputError(str(self.root), f"{' or '.join(suffixes)} files: {names}", expected, remedy)
        return found[0]


def checked_name(name: object, subject: str) -> str:
    """A relative path without "..", with forward slashes; InputError for everything else."""
    if not isinstance(name, str) or not name.strip() or len(name) > _LONGEST_NAME or "\0" in name:
        raise InputError(subject, repr(name)[:80], "the name of a file in the same folder")
    text = name.replace("\\", "/")
    outside = PureWindowsPath(name).drive or text.startswith("/") or ".." in PurePosixPath(text).parts
    if outside:
        expected = "a name inside the folder"
        raise InputError(subject, repr(name)[:80], expected, "copy the file into the folder")
    return text


def in_natural_order(paths: Sequence[Path]) -> list[Path]:
    """Sorted by name with numbers by value: 2.tif before 10.tif."""
    return sorted(paths, key=lambda path: _natural(path.name))


def check_numbering(paths: Sequence[Path], remedy: str) -> None:
    """InputError for frames, in natural order, that share a number or leave one out: all later angles would be wrong.
    Numbers are those in the one place where names differ; names that differ elsewhere too are no numbering."""
    names = [_natural(path.stem) for path in paths]
    places = [place for place in zip(*names, strict=False) if len(set(place)) > 1]
    if len({len(name) for name in names}) > 1 or len(places) > 1 or any(word for _, _, word in sum(places, ())):
        return
    numbers = [number for _, number, _ in places[0]] if places else [0] * len(names)
    steps = [after - before for before, after in pairwise(numbers)]
    usual = min((step for step in steps if step > 0), default=1)
    for (before, after), step in zip(pairwise(paths), steps, strict=True):
        if step != usual:
            found = f"{after.name} after {before.name}: {'one number' if step == 0 else 'a hole'} in the numbering"
            raise InputError(str(after.parent), found, "every number once", remedy)


def _natural(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d{1,18})", name)
    return [(0, int(p), "") if p.isdecimal() and p.isascii() else (1, 0, p) for p in parts if p]
