"""Foreign files and folders: names that stay inside the folder, and texts and arrays bounded by the file's own size."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.files import HOST_SHARE, host_bytes, read_regular, regular_file
from phyradgs_cl.io.tables import LARGEST, read_facts

MOST_TEXT_BYTES = 64 << 20
_MOST_FILES = 200_000
_LONGEST_NAME = 4096


def check_room(subject: str, needed_bytes: int) -> None:
    """Raises InputError for more than ``HOST_SHARE`` of this machine's memory."""
    most_bytes = HOST_SHARE * host_bytes()
    if needed_bytes > most_bytes:
        found, expected = (f"{n / 2**30:.3g} GiB" for n in (needed_bytes, most_bytes))
        remedy = "import fewer frames at a time, or bin them"
        raise InputError(subject, f"{found} to unpack", f"at most {expected} on this machine", remedy)


def read_bytes(path: Path) -> bytes:
    """Reads a whole file of at most 64 MiB."""
    return read_regular(path, str(path), MOST_TEXT_BYTES, "a description of a scan")


def read_json(path: Path) -> dict[str, object]:
    return read_facts(str(path), read_bytes(path).decode("utf-8-sig", "replace"), {})


def read_numbers(path: Path, count: int, what: str) -> np.ndarray:
    """Reads (count,) finite numbers of a text file, one per line. Empty lines and text after a # are ignored."""
    values = []
    for number, line in enumerate(read_bytes(path).decode("utf-8-sig", "replace").splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST:
            raise InputError(f"{path} line {number}", repr(text[:40]), "a finite number")
        values.append(value)
    if len(values) != count:
        raise InputError(str(path), f"{len(values)} {what}", f"{count}, one for each frame")
    return np.array(values)


def read_npy(path: Path, ndim: int) -> np.ndarray:
    """Reads a numeric array with ``ndim`` axes from a .npy file, in C order. InputError for a pickle, or for a header that
    announces more than the file holds."""
    subject = str(path)
    regular_file(path, subject)
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # maps no bytes that the file does not have
        dtype, shape = values.dtype, values.shape
    except Exception as error:  # NumPy passes on any exception of Python's parser and tokeniser
        raise InputError(subject, f"a damaged .npy file ({error})", "a NumPy array") from error
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputError(subject, f"type {dtype}", "plain real numbers")
    if len(shape) != ndim or 0 in shape:
        raise InputError(subject, f"shape {shape}", f"{ndim} axes, none of them empty")
    return np.array(values, order="C", subok=False)


@dataclass(frozen=True)
class SafeFolder:
    """A folder that the user named. Its methods reach only files inside it: no absolute path, "..", link or device."""

    root: Path

    def __post_init__(self) -> None:
        if not self.root.is_dir():
            found = "a file" if self.root.exists() else "nothing there"
            raise InputError(str(self.root), found, "a folder", "check the path")

    def file(self, name: object, subject: str) -> Path:
        """Returns the path of the regular file ``name`` below the folder; ``subject`` says where the name stands."""
        text = checked_name(name, subject)
        path = self.root
        for part in PurePosixPath(text).parts:
            path = path / part
            if path.is_symlink():
                raise InputError(subject, f"{text!r}, which leads over a symbolic link", "a plain file")
        regular_file(path, subject)
        return path

    def exists(self, name: str) -> bool:
        return (self.root / name).exists() or (self.root / name).is_symlink()

    def glob(self, pattern: str) -> list[Path]:
        """Returns the regular files that match a pattern below the folder, in natural order of their names."""
        return in_natural_order([self.file(str(path.relative_to(self.root)), str(path)) for path in self._paths(pattern)])

    def matching(self, *suffixes: str) -> list[Path]:
        """Returns the regular files with one of the suffixes in any case, in natural order of their names."""
        paths = [path for path in self._paths("[!.]*") if path.suffix.lower() in suffixes]
        return in_natural_order([self.file(path.name, str(path)) for path in paths])

    def plain(self, *suffixes: str) -> list[Path]:
        """Returns the same without links and folders, which ``matching`` refuses: of suffixes that any folder may have."""
        paths = [path for path in self._paths("[!.]*") if path.suffix.lower() in suffixes]
        return in_natural_order([path for path in paths if path.is_file() and not path.is_symlink()])

    def _paths(self, pattern: str) -> list[Path]:
        paths = list(islice(self.root.glob(pattern), _MOST_FILES + 1))
        if len(paths) > _MOST_FILES:
            raise InputError(str(self.root), f"more than {_MOST_FILES} files", "a folder with one scan")
        return paths

    def only(self, what: str, *suffixes: str) -> Path:
        """Returns the one regular file with one of the suffixes; ``what`` names it in messages."""
        paths = self.matching(*suffixes)
        if len(paths) != 1:
            names = ", ".join(path.name for path in paths[:5]) or "none"
            expected, remedy = f"one {what}", "leave only one, or name the file itself"
            raise InputError(str(self.root), f"{' or '.join(suffixes)} files: {names}", expected, remedy)
        return paths[0]


def checked_name(name: object, subject: str) -> str:
    """Returns a relative path without "..", with forward slashes; InputError for any other."""
    if not isinstance(name, str) or not name.strip() or len(name) > _LONGEST_NAME or "\0" in name:
        raise InputError(subject, repr(name)[:80], "the name of a file in the same folder")
    text = name.replace("\\", "/")
    if PureWindowsPath(name).drive or text.startswith("/") or ".." in PurePosixPath(text).parts:
        expected = "a name inside the folder"
        raise InputError(subject, repr(name)[:80], expected, "copy the file into the folder")
    return text


def in_natural_order(paths: Sequence[Path]) -> list[Path]:
    """Returns the paths sorted by name, numbers by value: 2.tif before 10.tif."""
    return sorted(paths, key=lambda path: _natural(path.name))


def check_numbering(paths: Sequence[Path], remedy: str) -> None:
    """Raises InputError for frames, in natural order, that share a number or leave one out: all later angles would be wrong.
    The numbers are those at the one place where the names differ; names that differ elsewhere too are not checked."""
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
