"""Which format a file or folder is in, from what is in it; nothing is guessed from numbers."""

from pathlib import Path

import h5py

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.formats import phyradgs_real, phyradgs_synthetic, r2_gaussian
from phyradgs_cl.importers.reading import tiff
from phyradgs_cl.importers.reading.folder import SafeFolder
from phyradgs_cl.importers.reading.images import STACKS
from phyradgs_cl.io.hdf5.source import open_hdf5

_HDF5 = b"\x89HDF\r\n\x1a\n"
_BY_SUFFIX = {".pickle": "naf", ".pkl": "naf", ".xml": "rtk", ".toml": "tiff"}


def recognise(path: Path) -> str:
    """The name of the format; InputError if none fits, or more than one."""
    if not path.exists():
        raise InputError(str(path), "nothing there", "a scan to import", "check the path")
    found = _of_folder(SafeFolder(path)) if path.is_dir() else _of_file(path)
    if len(found) == 1:
        return found[0]
    if not found and _holds_tiffs(path):
        what, expected = "TIFF images and no TOML that describes them", "geometry and angles in a TOML beside them"
        remedy = f"'phyradgs import {path if path.is_dir() else path.parent} --template' prints one to fill in"
        raise InputError(str(path), what, expected, remedy)
    what = f"several: {', '.join(found)}" if found else "no known format"
    raise InputError(str(path), what, "one of the formats of docs/import.md", "say which with --format")


def _holds_tiffs(path: Path) -> bool:
    if path.is_dir():
        return bool(SafeFolder(path).matching(*tiff.SUFFIXES))
    return path.suffix.lower() in tiff.SUFFIXES


def _of_folder(folder: SafeFolder) -> list[str]:
    if folder.exists(phyradgs_synthetic.META):
        return ["phyradgs"]
    if folder.exists(r2_gaussian.META):
        return ["r2"]
    found = []
    if folder.matching(".xml") and folder.matching(*STACKS):
        found.append("rtk")
    if folder.matching(".toml"):
        found.append("tiff")
    if folder.matching(".json") and (
        folder.exists(phyradgs_real.PROJECTIONS) or folder.matching(*tiff.SUFFIXES)
    ):
        found.append("phyradgs-real")
    return found


def _of_file(path: Path) -> list[str]:
    if path.name == phyradgs_synthetic.META:
        return ["phyradgs"]
    if path.name == r2_gaussian.META:
        return ["r2"]
    if path.suffix.lower() == ".json":
        return ["phyradgs-real"]
    if not path.is_file():
        raise InputError(str(path), "something that is not a regular file", "a file or a folder")
    with open(path, "rb") as file:
        is_hdf5 = file.read(len(_HDF5)) == _HDF5
    if is_hdf5:
        return [_of_hdf5(path)]
    kind = _BY_SUFFIX.get(path.suffix.lower())
    return [kind] if kind else []


def _of_hdf5(path: Path) -> str:
    with open_hdf5(path) as source:
        if isinstance(source.find("/exchange"), h5py.Group):
            return "data-exchange"
        for member in ("/entry/reconstruction", "/volume"):
            if source.find(member) is not None and source.find("/entry/instrument") is None:
                remedy = "'phyradgs export' writes volumes in other formats, 'phyradgs simulate --volume' projects one"
                raise InputError(f"{path}:{member}", "a volume", "projections with their geometry", remedy)
    return "nxtomo"
