"""Opens HDF5 files of any origin. Links to other files and sizes that the file cannot hold are refused before a read."""

import difflib
import math
import posixpath
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.files import regular_file

_MOST_SOFT_LINKS = 16
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
# Compression shrinks masks of zeros a thousandfold and frames hardly at all. Small files may expand by _FREE_BYTES.
_MOST_EXPANSION = 100
_FREE_BYTES = 64 << 20
_DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError)  # what h5py raises for damaged objects


@contextmanager
def open_hdf5(path: str | Path) -> "Iterator[Hdf5Source]":
    """Opens a file for reading. InputError for a file that is not readable HDF5, and for errors of HDF5 in the body."""
    path = Path(path)
    if regular_file(path, str(path), "an HDF5 file").st_size == 0:
        raise InputError(str(path), "an empty file", "an HDF5 file", "copy or write it again")
    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise _unreadable(path, str(error)) from error
    try:
        with file:
            yield Hdf5Source(file, path)
    except (OSError, RuntimeError, KeyError, TypeError, UnicodeError) as error:
        remedy = "copy the file again"
        raise InputError(str(path), f"a damaged file ({error})", "readable HDF5", remedy) from error


def _unreadable(path: Path, reason: str) -> InputError:
    if "truncated" in reason:
        return InputError(str(path), "a truncated HDF5 file", "a complete file", "copy or write it again")
    if "signature not found" in reason:
        remedy = "check the path or convert it"
        return InputError(str(path), "a file that is not HDF5", "an HDF5 file", remedy)
    return InputError(str(path), f"a file that HDF5 cannot open ({reason})", "a readable HDF5 file")


@dataclass(frozen=True, eq=False)
class Hdf5Source:
    """An open file, and the path by which messages name it."""

    file: h5py.File
    path: Path

    def name(self, address: str) -> str:
        """Returns the name of an object in messages: FILE:/address."""
        return f"{self.path}:{address}"

    def error(self, address: str, found: str, expected: str, remedy: str = "") -> InputError:
        return InputError(self.name(address), found, expected, remedy)

    def find(self, address: str) -> h5py.Group | h5py.Dataset | None:
        """Returns the object at an absolute address, or None. InputError for a link to another file."""
        return self._walk(address, _MOST_SOFT_LINKS)

    def root_groups(self) -> list[str]:
        """Returns the addresses of the groups at the root, links excepted."""
        links = {name: self.file.get(name, getlink=True) for name in self.file}
        names = [name for name, link in links.items() if isinstance(link, h5py.HardLink)]
        return [f"/{name}" for name in names if isinstance(self.find(f"/{name}"), h5py.Group)]

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
        self._check_storage(address, thing)
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

    def _walk(self, address: str, soft_links_left: int) -> h5py.Group | h5py.Dataset | None:
        here: h5py.Group | h5py.Dataset = self.file["/"]
        walked, parts = "/", [part for part in address.split("/") if part]
        for index, part in enumerate(parts):
            inside = posixpath.join(walked, part)
            try:
                link = here.get(part, getlink=True) if isinstance(here, h5py.Group) else None
            except _DAMAGE as error:
                raise self.error(inside, f"a link that cannot be followed ({error})", "a plain link") from error
            if link is None:
                return None
            if isinstance(link, h5py.ExternalLink):
                remedy = "copy the data into the file"
                raise self.error(inside, f"a link to the file {link.filename!r}", "data inside this file", remedy)
            if isinstance(link, h5py.SoftLink):
                if soft_links_left == 0:
                    raise self.error(address, "a loop of links", "a dataset", "store the data itself")
                target = posixpath.normpath(posixpath.join(walked, link.path, *parts[index + 1 :]))
                return self._walk(target, soft_links_left - 1)
            here, walked = self._opened(here, part, inside), inside
        return here

    def _opened(self, group: h5py.Group, part: str, address: str) -> h5py.Group | h5py.Dataset:
        try:
            thing = group[part]
        except _DAMAGE as error:
            raise self.error(address, f"a damaged object ({error})", "a group or dataset") from error
        if not isinstance(thing, (h5py.Group, h5py.Dataset)):
            raise self.error(address, "a named type", "a group or dataset")
        return thing

    def _check_storage(self, address: str, dataset: h5py.Dataset) -> None:
        """Refuses data in other files, and shapes or chunks that are larger than the file could hold."""
        try:
            elsewhere = dataset.is_virtual or bool(dataset.external)
            shape, chunks, declared_bytes = dataset.shape, dataset.chunks, dataset.nbytes
            chunk_bytes = math.prod(chunks or ()) * dataset.dtype.itemsize
        except _DAMAGE as error:
            raise self.error(address, f"a damaged dataset ({error})", "numbers or text") from error
        if elsewhere:
            remedy = "copy the data into the file"
            raise self.error(address, "data kept in other files", "data inside this file", remedy)
        if shape is None:
            raise self.error(address, "an empty dataset", "a value")
        file_bytes = self.path.stat().st_size
        most_bytes = file_bytes if chunks is None else _MOST_EXPANSION * file_bytes + _FREE_BYTES
        if max(declared_bytes, chunk_bytes) > most_bytes:
            what, size = ("shape", shape) if declared_bytes > most_bytes else ("chunks of", chunks)
            declared = f"{max(declared_bytes, chunk_bytes) / 2**30:.3g} GiB"
            found = f"{what} {size}, {declared} in a file of {file_bytes} bytes"
            raise self.error(address, found, "a size that the file can hold", "write the file again")
