"""Voxel volumes of any origin: HDF5 files of ours or bare, and what `phyradgs export` and other programs write."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from phyradgs_cl import io
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading import tiff
from phyradgs_cl.importers.reading.bounded import read_json, read_npy
from phyradgs_cl.importers.reading.meta_image import read_meta_image
from phyradgs_cl.importers.reading.nifti import read_nifti
from phyradgs_cl.importers.reading.nrrd import read_nrrd
from phyradgs_cl.importers.reading.voxels import Voxels, along_world_axes
from phyradgs_cl.io import LoadedVolume
from phyradgs_cl.io.tables import Fields


def foreign_volume(path: str | Path) -> str | None:
    """The format of a volume that is not HDF5, by its name's ending; None of everything else."""
    found = _format(path)
    return found[0] if found else None


def load_volume(path: str | Path) -> LoadedVolume:
    """A volume (nz, ny, nx) float32 in 1/mm and its grid; axes are turned to rise with the world's, as LPS
    (docs/export.md). Bare values have no grid: HDF5 datasets `/volume`, NRRD and TIFF without voxel sizes, .npy without
    its .json. InputError: not such a file, damaged, not three axes, oblique, Hounsfield units, NaN or infinity."""
    found = _format(path)
    return along_world_axes(str(path), found[1](Path(path))) if found else io.load_volume(path)


def load_attenuation(path: str | Path) -> LoadedVolume:
    """``load_volume`` for a volume that rays are to be sent through; see ``io.load_attenuation``."""
    return io.load_attenuation(path, load=load_volume)


def _format(path: str | Path) -> tuple[str, Callable[[Path], Voxels]] | None:
    name = Path(path).name.lower()
    return next((form for ending, form in _READERS.items() if name.endswith(ending)), None)


def _read_npy(path: Path) -> Voxels:
    """An array (z, y, x), with the grid that `phyradgs export` writes beside it."""
    values, beside = read_npy(path, 3), path.with_suffix(".json")
    facts = read_json(beside) if beside.is_file() else {}
    if "voxel_size_mm" not in facts:
        return Voxels(values)
    if facts.get("axes") != ["z", "y", "x"] or facts.get("shape") != list(values.shape):
        found = f"axes {facts.get('axes')}, shape {facts.get('shape')}"
        raise InputError(str(beside), found[:80], f"axes z, y, x, shape {list(values.shape)}")
    size, first = (Fields(str(beside), facts).numbers(key, 3)[::-1] for key in ("voxel_size_mm", "first_centre_mm"))
    return Voxels(values, np.diag(size), first, str(facts.get("values", "")))


def _read_tiff(path: Path) -> Voxels:
    """Pages from the lowest slice up, row 0 the smallest y, with sizes as ImageJ states them."""
    values = tiff.read_tiffs([path])
    size_mm, origin, note = tiff.imagej_calibration(path)
    if size_mm is None:
        return Voxels(values)
    return Voxels(values, np.diag(size_mm), None if origin is None else -origin * size_mm, note)


_READERS: dict[str, tuple[str, Callable[[Path], Voxels]]] = {
    ".mha": ("MetaImage", read_meta_image),
    ".mhd": ("MetaImage", read_meta_image),
    ".nii": ("NIfTI", read_nifti),
    ".nii.gz": ("NIfTI", read_nifti),
    ".nrrd": ("NRRD", read_nrrd),
    ".npy": ("NumPy", _read_npy),
    ".tif": ("TIFF", _read_tiff),
    ".tiff": ("TIFF", _read_tiff),
}
