"""HDF5 files from strangers, walked without leaving the file: no link, dataset or declared size leads out of it."""

import difflib
import math
import posixpath
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.hdf5.trial import survive
from phyradgs_cl.io.regular import regular_file

_MOST_SOFT_LINKS = 16
# What scan and volume files have: a name outside this set that nearly is one of them is a misspelling.
_KNOWN = frozenset((
    *("name", "title", "provenance", "data", "image_key", "image_key_control", "pixel_mask", "quantity"),
    *("x_pixel_size", "y_pixel_size", "distance", "count_time", "detector_readout_time", "frame_start_time"),
    *("rotation_angle", "rotation_angle_end", "readout_axis", "readout_direction"),
    *("detector_offset", "detector_model", "pulse_start", "pulse_length", "lag"),
    *("saturation_level", "saturation_share", "reference", "volume", "z", "y", "x"),
    *("kinematics", "poses", "time_s", "angle_deg", "pose", "grid", "shape", "voxel_size", "offset"),
    *("reconstruction", "metrics", "gaussians", "mean", "scale", "quaternion", "density"),
))
# Masks of zeros shrink a thousandfold, frames hardly at all: a file of some size may unfold to so many times that.
_MOST_EXPANSION = 100
_FREE_BYTES = 64 << 20


@contextmanager
def open_hdf5(path: str | Path) -> "Iterator[Hdf5Source]":
    """Open a file for reading; InputError for whatever is no readable HDF5, errors of HDF5 in the body included."""
    path = Path(path)
    if regular_file(path, str(path), "an HDF5 file").st_size == 0:  # of /proc, or cut off
        raise InputError(str(path), "an empty file", "an HDF5 file", "copy or write it again")
    survive(path)
    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise _unreadable(path, error) from error
    try:
        with file:
            yield Hdf5Source(file, path)
    except (OSError, RuntimeError, KeyError, TypeError, UnicodeError) as error:  # damage between datasets
        expected = "readable HDF5"
        raise InputError(str(path), f"a damaged file ({error})", expected, "copy the file again") from error


def _unreadable(path: Path, error: Exception) -> InputError:
    reason = str(error)
    if "truncated" in reason:
        return InputError(str(path), "a truncated HDF5 file", "a complete file", "copy or write it again")
    if "signature not found" in reason:
        expected = "an HDF5 file"
        return InputError(str(path), "a file that is not HDF5", expected, "check the path or convert it")
    return InputError(str(path), f"a file that HDF5 cannot open ({reason})", "a readable HDF5 file")


@dataclass(frozen=True, eq=False)
class Hdf5Source:
    """An open file and the path to name it by."""

    file: h5py.File
    path: Path

    def name(self, address: str) -> str:
        """How messages name an object of the file."""
        return f"{self.path}:{address}"

    def error(self, address: str, found: str, expected: str, remedy: str = "") -> InputError:
        """What to raise about an object of the file."""
        return InputError(self.name(address), found, expected, remedy)

    def find(self, address: str) -> h5py.Group | h5py.Dataset | None:
        """The object at an absolute address, or None; links that lead out of the file are refused."""
        return self._walk(address, _MOST_SOFT_LINKS)

    def root_groups(self) -> list[str]:
        """Addresses of the groups at the root that are in this file and no mere links."""
        links = {name: self._link(self.file, name, "/", False) for name in self.file}
        names = [name for name, link in links.items() if isinstance(link, h5py.HardLink)]
        return [f"/{name}" for name in names if isinstance(self.find(f"/{name}"), h5py.Group)]

    def group(self, address: str) -> h5py.Group:
        """The group at an absolute address; InputError naming the first missing group of it."""
        found = self.find(address)
        if isinstance(found, h5py.Group):
            return found
        parent, name = posixpath.split(address)
        if found is None and parent != "/":
            self.group(parent)
        what = "nothing there" if found is None else "a dataset"
        raise self.error(address, what, f"a group {name!r}", self.near_miss(parent, name))

    def optional_group(self, address: str) -> h5py.Group | None:
        """The group at an address or None; InputError if there is one under a misspelt name instead."""
        found = self.find(address)
        if isinstance(found, h5py.Dataset):
            raise self.error(address, "a dataset", "a group", "store the values inside a group")
        if found is None:
            self._refuse_near_miss(address, "a group")
        return found

    def dataset(self, address: str) -> h5py.Dataset:
        """The dataset at an address; InputError, with the nearest unknown name, where there is none."""
        found = self.optional(address)
        if found is not None:
            return found
        parent, name = posixpath.split(address)
        if parent != "/":
            self.group(parent)
        remedy = self.near_miss(parent, name) or "add it to the file"
        raise self.error(address, "nothing there", f"a dataset {name!r}", remedy)

    def optional(self, address: str) -> h5py.Dataset | None:
        """The dataset at an address or None; InputError if there is one under a misspelt name instead."""
        found = self.find(address)
        if found is None:
            self._refuse_near_miss(address, "a dataset")
            return None
        if not isinstance(found, h5py.Dataset):
            raise self.error(address, "a group", "a dataset", "store the values as a dataset")
        self._check_storage(address, found)
        return found

    def near_miss(self, parent: str, name: str, cutoff: float = 0.6) -> str:
        """What to do about a name that is nearly ``name`` and means nothing else; "" if there is none."""
        group = self.find(parent)
        names = group if isinstance(group, h5py.Group) else ()
        by_lower = {n.lower(): n for n in names if n != name and n not in _KNOWN}
        close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=cutoff)
        return f"rename {by_lower[close[0]]!r} to {name!r}" if close else ""

    def _refuse_near_miss(self, address: str, what: str) -> None:
        parent, name = posixpath.split(address)
        remedy = self.near_miss(parent, name, cutoff=0.8)
        if remedy:
            raise self.error(address, "nothing there", f"{what} {name!r}", remedy)

    def _walk(self, address: str, soft_links_left: int) -> h5py.Group | h5py.Dataset | None:
        here: h5py.Group | h5py.Dataset = self.file["/"]
        walked, parts = "/", [part for part in address.split("/") if part]
        for index, part in enumerate(parts):
            link = self._link(here, part, walked) if isinstance(here, h5py.Group) else None
            if link is None:
                return None
            if isinstance(link, h5py.SoftLink):
                if soft_links_left == 0:
                    raise self.error(address, "a loop of links", "a dataset", "store the data itself")
                target = posixpath.normpath(posixpath.join(walked, link.path, *parts[index + 1 :]))
                return self._walk(target, soft_links_left - 1)
            walked = posixpath.join(walked, part)
            here = self._opened(here, part, walked)
        return here

    def _link(self, group: h5py.Group, part: str, walked: str, strict: bool = True) -> object | None:
        address = posixpath.join(walked, part)
        try:
            link = group.get(part, getlink=True)
        except (TypeError, RuntimeError, OSError) as error:
            raise self.error(address, f"a link that cannot be followed ({error})", "a plain link") from error
        if strict and isinstance(link, h5py.ExternalLink):
            found = f"a link to the file {link.filename!r}"
            raise self.error(address, found, "data inside this file", "copy the data into the file")
        return link

    def _opened(self, group: h5py.Group, part: str, address: str) -> h5py.Group | h5py.Dataset:
        try:
            found = group[part]
        except (KeyError, OSError, RuntimeError) as error:
            raise self.error(address, f"a damaged object ({error})", "a group or dataset") from error
        if not isinstance(found, (h5py.Group, h5py.Dataset)):
            raise self.error(address, "a named type", "a group or dataset")
        return found

    def _check_storage(self, address: str, dataset: h5py.Dataset) -> None:
        """Refuse bytes kept in other files, and sizes that reading would have to invent."""
        try:
            elsewhere = dataset.is_virtual or bool(dataset.external)
            shape, chunks, declared_bytes = dataset.shape, dataset.chunks, dataset.nbytes
            chunk_bytes = math.prod(chunks or ()) * dataset.dtype.itemsize
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            raise self.error(address, f"a damaged dataset ({error})", "numbers or text") from error
        if elsewhere:
            remedy = "copy the data into the file"
            raise self.error(address, "data kept in other files", "data inside this file", remedy)
        if shape is None:
            raise self.error(address, "an empty dataset", "a value")
        file_bytes = self.path.stat().st_size
        most = file_bytes if chunks is None else _MOST_EXPANSION * file_bytes + _FREE_BYTES
        if max(declared_bytes, chunk_bytes) > most:
            what, size = ("shape", shape) if declared_bytes > most else ("chunks of", chunks)
            declared = f"{max(declared_bytes, chunk_bytes) / 2**30:.3g} GiB"
            found = f"{what} {size}, {declared} in a file of {file_bytes} bytes"
            raise self.error(address, found, "a size that the file can hold", "write the file again")
