"""Reads other programs' files safely: names cannot lead out of a folder, nor headers claim more data than a file has."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.files import HOST_SHARE, decoded, host_bytes, read_regular, regular_file
from phyradgs_cl.io.tables import read_facts

_MOST_TEXT_BYTES = 64 << 20  # no text that describes a scan is larger: such a file holds images


def check_room(subject: str, needed_bytes: int) -> None:
    """Raises InputError where ``needed_bytes`` exceed the fraction ``HOST_SHARE`` of this machine's memory."""
    found, most = (f"{n / 2**30:.3g} GiB" for n in (needed_bytes, HOST_SHARE * host_bytes()))
    if needed_bytes > HOST_SHARE * host_bytes():
        remedy = "import fewer frames at a time, or bin them"
        raise InputError(subject, f"{found} to unpack", f"at most {most} on this machine", remedy)


@contextmanager
def naming_damage(path: Path, found: str, expected: str, remedy: str = "") -> Iterator[None]:
    """Turns any exception of the body but InputError and MemoryError into InputError about ``path``, because libraries raise
    all kinds for damaged files. found, expected, remedy: words of the message."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        text = f"{found} ({type(error).__name__}: {' '.join(str(error).split())[-120:]})"
        raise InputError(str(path), text, expected, remedy) from error


def read_bytes(path: Path) -> bytes:
    """Reads a whole regular file. Raises InputError for one of more than 64 MiB."""
    return read_regular(path, str(path), _MOST_TEXT_BYTES, "a description of a scan")


def read_text(path: Path) -> str:
    return decoded(read_bytes(path))


def read_json(path: Path) -> dict[str, object]:
    return read_facts(str(path), read_text(path), {})


def read_npy(path: Path, ndim: int) -> np.ndarray:
    """Reads an array of real numbers with ``ndim`` axes from a .npy file, in C order. Raises InputError for a pickle, a
    header that announces more than the file holds, other types, and other or empty axes."""
    subject = str(path)
    regular_file(path, subject)
    with open(path, "rb") as file:
        if file.read(6) != b"\x93NUMPY":
            raise InputError(subject, "another kind of file", "a NumPy array")
    with naming_damage(path, "a damaged .npy file", "a NumPy array"):
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # fails if the header announces more than the file holds
        dtype, shape = values.dtype, values.shape
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputError(subject, f"type {dtype}", "plain real numbers")
    if len(shape) != ndim or 0 in shape:
        raise InputError(subject, f"shape {shape}", f"{ndim} axes, none of them empty")
    return np.array(values, order="C", subok=False)


@dataclass(frozen=True)
class SafeFolder:
    """A folder that the user named. ``file`` accepts only names inside it: no absolute path, no "..". Links in the folder
    are followed, because the user has put them there. Raises InputError for a path that is no folder."""

    root: Path

    def __post_init__(self) -> None:
        if not self.root.is_dir():
            found = "a file" if self.root.exists() else "nothing there"
            raise InputError(str(self.root), found, "a folder", "check the path")

    def file(self, name: object, subject: str) -> Path:
        """Returns the path of the file ``name`` in the folder or below. subject: where the name stands, for messages. Raises
        InputError for a name that leads out of the folder, and for anything but a regular file."""
        path = self.root / checked_name(name, subject)
        regular_file(path, subject)
        return path

    def exists(self, name: str) -> bool:
        return (self.root / name).exists()

    def glob(self, pattern: str, *suffixes: str) -> list[Path]:
        """Returns the files that match a pattern, upper case or lower, in natural order. If ``suffixes`` are given,
        wildcards match only files with one of these suffixes, and no hidden files."""
        name = PurePosixPath(pattern).name.lower()
        paths = [path for path in _files((self.root / pattern).parent) if fnmatchcase(path.name.lower(), name)]
        is_plain = not suffixes or not set(name) & set("*?[")
        return [path for path in paths if is_plain or _is_one_of(path, suffixes)]

    def matching(self, *suffixes: str) -> list[Path]:
        """Returns the folder's files with one of the suffixes, upper case or lower, in natural order; no hidden files."""
        return [path for path in _files(self.root) if _is_one_of(path, suffixes)]

    def only(self, what: str, *suffixes: str) -> Path:
        """Returns the only file with one of the suffixes. Raises InputError, which calls it ``what``, for none or
        several."""
        paths = self.matching(*suffixes)
        if len(paths) != 1:
            names = ", ".join(path.name for path in paths[:5]) or "none"
            expected, remedy = f"one {what}", "leave only one, or name the file itself"
            raise InputError(str(self.root), f"{' or '.join(suffixes)} files: {names}", expected, remedy)
        return paths[0]


def _files(folder: Path) -> list[Path]:
    """Returns a folder's files in natural order. Links that lead nowhere are among them: reading one raises an error, while
    leaving it out would lose a frame unnoticed."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return in_natural_order([path for path in paths if path.is_file() or (path.is_symlink() and not path.exists())])


def _is_one_of(path: Path, suffixes: tuple[str, ...]) -> bool:
    return path.suffix.lower() in suffixes and not path.name.startswith(".")


def checked_name(name: object, subject: str) -> str:
    """Returns ``name`` with forward slashes. Raises InputError about ``subject`` for empty or absolute names, and ".."."""
    text = name.replace("\\", "/") if isinstance(name, str) else ""
    leads_out = PureWindowsPath(text).drive or text.startswith("/") or ".." in PurePosixPath(text).parts
    if not text.strip() or "\0" in text or leads_out:
        raise InputError(subject, repr(name)[:80], "a name inside the folder", "copy the file into the folder")
    return text


def in_natural_order(paths: Sequence[Path]) -> list[Path]:
    """Returns the paths sorted by name, numbers by value: 2.tif before 10.tif."""
    parts = {path: re.split(r"(\d+)", path.name) for path in paths}  # of each name: text at even indices, digits at odd ones
    return sorted(paths, key=lambda path: [int(part) if i % 2 else part for i, part in enumerate(parts[path])])
