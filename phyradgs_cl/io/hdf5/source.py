"""Opens HDF5 files of any origin, and finds what an address names: over links and virtual datasets too, as far as their
files lie in the folder of the first file or in one that the user named."""

import difflib
import errno
import os
import posixpath
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import h5py

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.files import regular_file

_MOST_LINKS = 16  # one after the other, as HDF5 has it; also of virtual datasets made of virtual datasets
# Names in scan and volume files. A name outside this set that is close to one of them is taken for a misspelling.
_KNOWN = frozenset((
    *("name", "title", "provenance", "data", "image_key", "image_key_control", "pixel_mask", "quantity"),
    *("x_pixel_size", "y_pixel_size", "distance", "count_time", "detector_readout_time", "frame_start_time"),
    *("rotation_angle", "rotation_angle_end", "readout_axis", "readout_direction"),
    *("detector_offset", "detector_model", "pulse_start", "pulse_length", "lag"),
    *("saturation_level", "saturation_share", "reference", "volume", "z", "y", "x"),
    *("kinematics", "poses", "time_s", "angle_deg", "pose", "grid", "shape", "voxel_size", "offset"),
    *("reconstruction", "metrics", "gaussians", "mean", "scale", "quaternion", "density"),
    *("deformation", "control", "origin", "spacing", "times", "weights", "states", "state_times", "time_series"),
    *("gating", "signal", "phase"),
))
LINKED = "--linked-folder"
_UNLOCK = "set HDF5_USE_FILE_LOCKING=FALSE"
BEING_WRITTEN = "a file that another program has open for writing"
_REASONS = {  # by words of HDF5's answer: what was found, what helps
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
    """Opens a file for reading. ``linked_folder``: a folder whose files it may link to, besides its own. InputError for a
    file that is not readable HDF5, and for errors of HDF5 in the body."""
    path = Path(path)
    with _opened_file(path) as file:
        try:
            yield Hdf5Source(file, path, tuple(_folders(path, linked_folder)))
        except (OSError, RuntimeError, KeyError, TypeError, UnicodeError) as error:
            remedy = "copy the file again"
            raise InputError(str(path), f"a damaged file ({error})", "readable HDF5", remedy) from error


@contextmanager
def _opened_file(path: Path, subject: str = "") -> Iterator[h5py.File]:
    """Yields an open file. InputError about ``subject``, or the path, for one that HDF5 cannot open."""
    subject, where = subject or str(path), f" {path}" if subject else ""
    if regular_file(path, subject, "an HDF5 file").st_size == 0:
        raise InputError(subject, f"an empty file{where}", "an HDF5 file", "copy or write it again")
    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        unknown = f"a file that HDF5 cannot open ({error})", ""
        found, remedy = next((known for words, known in _REASONS.items() if words in str(error)), unknown)
        raise InputError(subject, f"{found}{where}", "a readable HDF5 file", remedy) from error
    with file:
        yield file


def _folders(path: Path, linked_folder: Path | None) -> Iterator[Path]:
    """Yields the folders of linked files. A file that is itself a link has two of its own."""
    for folder in filter(None, (path.parent, path.resolve().parent, linked_folder)):
        yield from (Path(os.path.abspath(folder)), folder.resolve())


@dataclass(frozen=True, eq=False)
class Hdf5Source:
    """An open file, the path by which messages name it, and the folders where files may lie to which it links."""

    file: h5py.File
    path: Path
    folders: tuple[Path, ...]

    def name(self, address: str) -> str:
        """Returns the name of an object in messages: FILE:/address."""
        return f"{self.path}:{address}"

    def error(self, address: str, found: str, expected: str, remedy: str = "") -> InputError:
        return InputError(self.name(address), found, expected, remedy)

    def find(self, address: str) -> h5py.Group | h5py.Dataset | None:
        """Returns the object at an absolute address, or None. InputError for damage, and for a link to a file that is not
        there or lies in another folder."""
        here, walked = self.file["/"], "/"
        for part in filter(None, address.split("/")):
            walked = posixpath.join(walked, part)
            try:
                link = here.get(part, getlink=True) if isinstance(here, h5py.Group) else None
                here = None if link is None else here[part]
            except _DAMAGE as error:
                if self._leads_nowhere(here, part, walked, error):
                    return None
                raise self.error(walked, f"a damaged object ({error})", "a group or dataset") from error
            if here is None:
                return None
            if not isinstance(here, (h5py.Group, h5py.Dataset)):
                raise self.error(walked, "a named type", "a group or dataset")
            self._check_place(walked, here.file.filename)
        return here

    def groups(self, depth: int = 1) -> Iterator[str]:
        """Yields the addresses of the groups at most ``depth`` below the root, links to nowhere excepted."""
        yield from self._below("/", self.file["/"], depth)

    def _below(self, address: str, group: h5py.Group, depth: int) -> Iterator[str]:
        for name in group if depth else ():
            with suppress(InputError):
                inside = posixpath.join(address, name)
                if isinstance(thing := self.find(inside), h5py.Group):
                    yield inside
                    yield from self._below(inside, thing, depth - 1)

    def group(self, address: str) -> h5py.Group:
        """Returns the group at an address; InputError about the first group on the way that is missing."""
        thing = self.find(address)
        if isinstance(thing, h5py.Group):
            return thing
        parent, name = posixpath.split(address)
        if thing is None and parent != "/":
            self.group(parent)
        found = "nothing there" if thing is None else "a dataset"
        raise self.error(address, found, f"a group {name!r}", self.misspelling(parent, name))

    def optional_group(self, address: str) -> h5py.Group | None:
        """Returns the group at an address, or None. InputError where its name is misspelt."""
        thing = self.find(address)
        if isinstance(thing, h5py.Dataset):
            raise self.error(address, "a dataset", "a group", "store the values inside a group")
        if thing is None:
            self._refuse_misspelling(address, "a group")
        return thing

    def dataset(self, address: str) -> h5py.Dataset:
        """Returns the dataset at an address. InputError, with the closest unknown name, where there is none."""
        dataset = self.optional(address)
        if dataset is not None:
            return dataset
        parent, name = posixpath.split(address)
        if parent != "/":
            self.group(parent)
        remedy = self.misspelling(parent, name) or "add it to the file"
        raise self.error(address, "nothing there", f"a dataset {name!r}", remedy)

    def optional(self, address: str) -> h5py.Dataset | None:
        """Returns the dataset at an address, or None. InputError where its name is misspelt."""
        thing = self.find(address)
        if thing is None:
            self._refuse_misspelling(address, "a dataset")
            return None
        if not isinstance(thing, h5py.Dataset):
            raise self.error(address, "a group", "a dataset", "store the values as a dataset")
        try:
            self._check_parts(address, thing)
        except _DAMAGE as error:
            raise self.error(address, f"a damaged dataset ({error})", "numbers or text") from error
        return thing

    def misspelling(self, parent: str, name: str, cutoff: float = 0.6) -> str:
        """Returns a remedy for an unknown name in the group ``parent`` that is close to ``name``; "" if there is none."""
        group = self.find(parent)
        names = group if isinstance(group, h5py.Group) else ()
        unknown = {n.lower(): n for n in names if n != name and n not in _KNOWN}
        close = difflib.get_close_matches(name.lower(), unknown, n=1, cutoff=cutoff)
        return f"rename {unknown[close[0]]!r} to {name!r}" if close else ""

    def _refuse_misspelling(self, address: str, what: str) -> None:
        parent, name = posixpath.split(address)
        remedy = self.misspelling(parent, name, cutoff=0.8)
        if remedy:
            raise self.error(address, "nothing there", f"{what} {name!r}", remedy)

    def _leads_nowhere(self, group: h5py.Group, part: str, address: str, error: Exception) -> bool:
        """Whether a member that cannot be opened is a link inside the file to nothing. InputError for a link to another
        file, or in a circle."""
        link = group.get(part, getlink=True)
        if isinstance(link, h5py.ExternalLink):
            raise self._unlinked(address, group.file, link.filename, link.path) from error
        if not isinstance(link, h5py.SoftLink):
            return False
        if isinstance(error, RuntimeError):
            raise self.error(address, "a loop of links", "a dataset", "store the data itself") from error
        return group.file != self.file or self.find(posixpath.join(group.name, link.path)) is None

    def _unlinked(self, address: str, file: h5py.File, name: str, inside: str) -> InputError:
        """Returns why what a link names in another file cannot be read."""
        place = _place_of(file, name)
        self._check_place(address, str(place))
        with _opened_file(place, self.name(address)):
            return self.error(address, f"a link to {inside} of {name}, where nothing is", "a group or dataset there")

    def _check_place(self, address: str, name: str) -> None:
        place = Path(os.path.abspath(name))
        if not any(place.is_relative_to(folder) for folder in self.folders):
            expected = f"files in {self.folders[0]}"
            raise self.error(address, f"a link to the file {name}", expected, f"say {LINKED} {place.parent} to trust it")

    def _check_parts(self, address: str, dataset: h5py.Dataset, links_left: int = _MOST_LINKS) -> None:
        """Checks what HDF5 answers with zeros, or not at all: that the parts of a virtual dataset are there and fill it, and
        that its filters are known. InputError where not."""
        if dataset.shape is None:
            raise self.error(address, "an empty dataset", "a value")
        if dataset.external:
            raise self.error(address, "data kept in files that are not HDF5", "HDF5", "copy them with 'h5repack'")
        _check_filters(self.name(address), dataset)
        if not dataset.is_virtual:
            return
        sources = dataset.virtual_sources()
        with suppress(RuntimeError):  # a part without an end has no number of values
            filled = sum(part.vspace.get_select_npoints() for part in sources)
            if filled < dataset.size:
                found = f"a virtual dataset of which {100 * (1 - filled / dataset.size):.3g} % are kept nowhere"
                raise self.error(address, found, "parts for all of it", "link the parts that are missing")
        for name, inside in dict.fromkeys((part.file_name, part.dset_name) for part in sources):
            place = Path(dataset.file.filename) if name == "." else _place_of(dataset.file, name)
            self._check_place(address, str(place))
            if "%" in name:  # one file after the other as far as there are any: nothing is missing
                continue
            with _opened_file(place, self.name(address)) as file:
                part = file.get(inside)
                if not isinstance(part, h5py.Dataset) or links_left == 0:
                    raise self.error(address, f"a part {inside} of {name}, where no data are", "a dataset there")
                self._check_parts(address, part, links_left - 1)


def _place_of(file: h5py.File, name: str) -> Path:
    """Returns where HDF5 looks for a file named in another: beside that one, also where an absolute name leads nowhere."""
    folder = Path(file.filename).parent
    return folder / name if not os.path.isabs(name) or os.path.exists(name) else folder / os.path.basename(name)


def _check_filters(subject: str, dataset: h5py.Dataset) -> None:
    """Loads the package hdf5plugin where a dataset's compression needs it; InputError where nothing can read it."""
    plist = dataset.id.get_create_plist()
    for code, _, _, name in (plist.get_filter(index) for index in range(plist.get_nfilters())):
        if not h5py.h5z.filter_avail(code):
            with suppress(ImportError):
                import_module("hdf5plugin")
        if not h5py.h5z.filter_avail(code):
            found = f"data compressed by the filter {code} {name.decode(errors='replace')[:40]!r}"
            raise InputError(subject, found, "a filter that HDF5 has", "pip install hdf5plugin")
