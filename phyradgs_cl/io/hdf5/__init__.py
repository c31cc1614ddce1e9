"""Opens HDF5 files of any program, and finds the object at an address. HDF5 follows links to other files. These must lie in
the folder of the first file or in one that the user named, so that a file cannot read others unasked."""

import difflib
import errno
import os
import posixpath
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import h5py

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.files import regular_file

_ALIKE = (  # names that look similar but mean different things, so none is a misspelling of another
    *("x_pixel_size", "y_pixel_size", "rotation_angle", "rotation_angle_end", "image_key", "image_key_control"),
    *("poses", "pose", "time_s", "times"),
)
_CLOSE = 0.8  # a name this similar to another (0 to 1, by difflib) is a misspelling
LINKED = "--linked-folder"
_UNLOCK = "set HDF5_USE_FILE_LOCKING=FALSE"
BEING_WRITTEN = "a file that another program has open for writing"
_REASONS = {  # for words in HDF5's message: what our message says was found, and the remedy
    "truncated": ("a truncated HDF5 file", "copy or write it again"),
    "signature not found": ("a file that is not HDF5", "check the path or convert it"),
    **{f"unable to lock file, errno = {number}": (BEING_WRITTEN,
       f"close it there, or {_UNLOCK} to read what is in it by now") for number in (errno.EAGAIN, errno.EACCES)},
    "unable to lock file": ("a file system that does not lock files", f"{_UNLOCK} and run the command again"),
    "already open for": ("a file that its writer has not closed", "close it there; after a crash, run 'h5clear -s' on it"),
}
_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError)  # what h5py raises for damaged objects


@contextmanager
def open_hdf5(path: str | Path, linked_folder: Path | None = None) -> "Iterator[Hdf5Source]":
    """Opens a file for reading. linked_folder: a folder, besides the file's own, with files to which it may link. Raises
    InputError for a file that is not readable HDF5, and for HDF5's errors while the file is open."""
    path, subject = Path(path), str(path)
    if regular_file(path, subject, "an HDF5 file").st_size == 0:
        raise InputError(subject, "an empty file", "an HDF5 file", "copy or write it again")
    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        unknown = f"a file that HDF5 cannot open ({error})", ""
        found, remedy = next((known for words, known in _REASONS.items() if words in str(error)), unknown)
        raise InputError(subject, found, "a readable HDF5 file", remedy) from error
    folders = filter(None, (path.parent, path.resolve().parent, linked_folder))  # path may be a link into another folder
    places = tuple(Path(place) for one in folders for place in (os.path.abspath(one), one.resolve()))
    with file:
        try:
            yield Hdf5Source(file, path, places)
        except (OSError, RuntimeError, KeyError, TypeError, UnicodeError) as error:
            raise InputError(subject, f"a damaged file ({error})", "readable HDF5", "copy the file again") from error


@dataclass(frozen=True, eq=False)
class Hdf5Source:
    """An open HDF5 file. path: the file's name in messages. folders: the only folders in which linked files may lie."""

    file: h5py.File
    path: Path
    folders: tuple[Path, ...]

    def name(self, address: str) -> str:
        """Returns what messages call an object: FILE:/address."""
        return f"{self.path}:{address}"

    def error(self, address: str, found: str, expected: str, remedy: str = "") -> InputError:
        return InputError(self.name(address), found, expected, remedy)

    def find(self, address: str) -> h5py.Group | h5py.Dataset | None:
        """Returns the object at an absolute address; None if there is nothing. Raises InputError for damage, and for a link
        to a file that is missing or outside ``folders``."""
        try:
            thing = self.file[address]
        except _DAMAGE as error:
            self._refuse_broken(address, error)
            return None
        if not isinstance(thing, (h5py.Group, h5py.Dataset)):
            raise self.error(address, "a named type", "a group or dataset")
        self._check_place(address, Path(thing.file.filename))
        return thing

    def groups(self, depth: int = 1, below: str = "/") -> Iterator[str]:
        """Yields addresses of groups, at most ``depth`` levels below the group ``below``; leaves out broken links."""
        for name in self.file[below] if depth else ():
            with suppress(InputError):
                if isinstance(self.find(inside := posixpath.join(below, name)), h5py.Group):
                    yield inside
                    yield from self.groups(depth - 1, inside)

    def group(self, address: str) -> h5py.Group:
        """Returns the group at an address. Raises InputError that names the first missing group of the address."""
        thing = self.find(address)
        if isinstance(thing, h5py.Group):
            return thing
        parent, name = posixpath.split(address)
        if thing is None and parent != "/":
            self.group(parent)
        found = "nothing there" if thing is None else "a dataset"
        raise self.error(address, found, f"a group {name!r}", self.misspelling(parent, name))

    def optional_group(self, address: str) -> h5py.Group | None:
        """Returns the group at an address, or None. Raises InputError for a dataset there, and if the address is missing but
        a similar name exists, which must be a misspelling."""
        return self._optional(address, h5py.Group, "a dataset", "a group")

    def optional(self, address: str) -> h5py.Dataset | None:
        """Returns the dataset at an address; None if there is nothing. Raises InputError for a misspelling, as
        ``optional_group`` does, and for data that are missing, outside HDF5, or compressed by an unknown filter."""
        if (dataset := self._optional(address, h5py.Dataset, "a group", "a dataset")) is not None:
            try:
                self._check_stored(address, dataset)
            except _DAMAGE as error:
                raise self.error(address, f"a damaged dataset ({error})", "numbers or text") from error
        return dataset

    def _optional(self, address: str, kind: type, other: str, what: str) -> h5py.Group | h5py.Dataset | None:
        thing = self.find(address)
        parent, name = posixpath.split(address)
        if thing is None and (remedy := self.misspelling(parent, name)):
            raise self.error(address, "nothing there", f"{what} {name!r}", remedy)
        if not isinstance(thing, (kind, type(None))):
            raise self.error(address, other, what, f"store the values as {what}")
        return thing

    def dataset(self, address: str) -> h5py.Dataset:
        """Returns the dataset at an address. Raises InputError if there is none, and names a similar one."""
        if (dataset := self.optional(address)) is not None:
            return dataset
        parent, name = posixpath.split(address)
        if parent != "/":
            self.group(parent)
        remedy = self.misspelling(parent, name) or "add it to the file"
        raise self.error(address, "nothing there", f"a dataset {name!r}", remedy)

    def misspelling(self, parent: str, name: str) -> str:
        """Returns the remedy "rename A to B" if the group ``parent`` has a name A similar to ``name``, B; else ""."""
        group = self.find(parent)
        others = {n.lower(): n for n in group if n not in _ALIKE} if isinstance(group, h5py.Group) else {}
        close = [others[n] for n in difflib.get_close_matches(name.lower(), others, n=1, cutoff=_CLOSE) if others[n] != name]
        return f"rename {close[0]!r} to {name!r}" if close else ""

    def _refuse_broken(self, address: str, error: Exception) -> None:
        """Raises InputError for an object or link that HDF5 cannot open. A soft link to nothing is no error."""
        parent, name = posixpath.split(address)
        group = self.find(parent) if name else None
        link = group.get(name, getlink=True) if isinstance(group, h5py.Group) else None
        if group is None or link is None:
            return
        if isinstance(link, h5py.ExternalLink):
            self._check_linked(address, group.file, link.filename, link.path)
        if isinstance(link, h5py.SoftLink) and isinstance(error, KeyError):
            self.find(posixpath.join(parent, link.path))
        else:
            raise self.error(address, f"a damaged object ({error})", "a group or dataset") from error

    def _check_place(self, address: str, place: Path) -> None:
        place = Path(os.path.abspath(place))
        if not any(place.is_relative_to(folder) for folder in self.folders):
            expected = f"files in {self.folders[0]}"
            raise self.error(address, f"a link to the file {place}", expected, f"say {LINKED} {place.parent} to trust it")

    def _check_linked(self, address: str, file: h5py.File, name: str, inside: str) -> None:
        """Raises InputError if a linked file has no data at ``inside``, where HDF5 itself would return nothing, or zeros."""
        own = Path(file.filename)
        place = own if name == "." else own.parent / name
        if os.path.isabs(name) and not place.exists():  # HDF5 then looks for the name next to the linking file
            place = own.parent / place.name
        self._check_place(address, place)
        if "%" in name:  # a pattern of numbered files, as part_%b.h5: HDF5 itself finds which exist, so none is opened here
            return
        try:
            with open_hdf5(place) as other:
                replace(other, folders=self.folders).dataset(f"/{inside.lstrip('/')}")
        except InputError as error:
            raise self.error(address, f"a link to {inside} of {name} ({error})", "data there", error.remedy) from error

    def _check_stored(self, address: str, dataset: h5py.Dataset) -> None:
        """Raises InputError for data that HDF5 would return as zeros, or not at all: an empty dataset, data in external
        files that are not HDF5, data compressed by an unknown filter, and a virtual dataset with missing parts."""
        if dataset.shape is None:
            raise self.error(address, "an empty dataset", "a value")
        if dataset.external:
            raise self.error(address, "data kept in files that are not HDF5", "HDF5", "copy them with 'h5repack'")
        _check_filters(self.name(address), dataset)
        parts = dataset.virtual_sources() if dataset.is_virtual else ()
        with suppress(RuntimeError):  # HDF5 cannot count the values of a part of unlimited size
            filled = sum(part.vspace.get_select_npoints() for part in parts)
            if parts and filled < dataset.size:
                found = f"a virtual dataset of which {100 * (1 - filled / dataset.size):.3g} % are kept nowhere"
                raise self.error(address, found, "parts for all of it", "link the parts that are missing")
        for name, inside in dict.fromkeys((part.file_name, part.dset_name) for part in parts):
            self._check_linked(address, dataset.file, name, inside)


def _check_filters(subject: str, dataset: h5py.Dataset) -> None:
    """Loads hdf5plugin if a dataset's compression needs it. Raises InputError if no filter can read the dataset."""
    plist = dataset.id.get_create_plist()
    for code, _, _, name in (plist.get_filter(index) for index in range(plist.get_nfilters())):
        if not h5py.h5z.filter_avail(code):
            with suppress(ImportError):
                import_module("hdf5plugin")
        if not h5py.h5z.filter_avail(code):
            found = f"data compressed by the filter {code} {name.decode(errors='replace')[:40]!r}"
            raise InputError(subject, found, "a filter that HDF5 has", "pip install hdf5plugin")
