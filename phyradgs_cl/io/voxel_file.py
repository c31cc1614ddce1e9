"""Voxels of any origin from an HDF5 file: a bare `volume`, or one of this package's volume files."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io.datasets import read_attribute, read_values
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.volume_file import read_provenance

_BARE = "/volume"
_ENTRY = "/entry/reconstruction"
log = logging.getLogger(__name__)
_AXIS_TOLERANCE = 1e-3  # of a voxel: what float32 axes of a thousand voxels need


class LoadedVolume(NamedTuple):
    """Volume (nz, ny, nx) float32, and its grid where the file has axes in mm."""

    volume: NDArray[np.float32]
    grid: Grid | None


def load_volume(path: str | Path) -> LoadedVolume:
    """Read a 3D volume.

    Either a dataset `/volume` (z, y, x) at the root (integers are divided by their type's maximum,
    floats stay as they are; no grid), or `/entry/reconstruction/volume` in 1/mm with axes `z`, `y`,
    `x` in mm beside it. Negative values are allowed: real reconstructions have them.

    Raises:
        InputError: no such file, not HDF5, no such dataset, not 3D, empty, not numbers, NaN or infinity, larger than
            the file can hold, kept in another file, axes that do not fit; names the file and the dataset.
    """
    with open_hdf5(path) as source:
        name = _dataset_name(source)
        volume = _read(source, name)
        grid = None
        if name != _BARE:
            grid = _read_grid(source, volume.shape)
            read_provenance(source)
    return LoadedVolume(volume, grid)


def load_attenuation(path: str | Path, *, warn: bool = True) -> LoadedVolume:
    """``load_volume``, for a volume that rays are to be sent through.

    Where a tenth as much lies below 0 as above, that is worth a warning: noise about 0 in air has less.

    Raises:
        InputError: as ``load_volume``; no voxel above 0, or less attenuation than its opposite, as in Hounsfield units.
    """
    loaded = load_volume(path)
    volume = loaded.volume
    positive = float(np.sum(volume, where=volume > 0, dtype=np.float64))
    negative = float(-np.sum(volume, where=volume < 0, dtype=np.float64))
    found = f"values from {volume.min():g} to {volume.max():g}"
    expected = "attenuation: 0 in air, above 0 in matter"
    remedy = "of Hounsfield units it is µ(water) (1 + HU / 1000)"
    if positive <= negative:
        raise InputError(f"volume of {path}", found, expected, remedy)
    if warn and negative > 0.1 * positive:
        share = f"{100 * negative / positive:.0f} % as much below 0 as above"
        log.warning("volume of %s: %s, %s; expected %s; %s", path, found, share, expected, remedy)
    return loaded


def _dataset_name(source: Hdf5Source) -> str:
    for name in (_BARE, f"{_ENTRY}/volume"):
        if isinstance(source.find(name), h5py.Dataset):
            return name
    found = "root members " + (", ".join(sorted(source.file)[:10]) or "none")
    raise InputError(str(source.path), found, f"a 3D dataset {_BARE} or {_ENTRY}/volume")


def _read(source: Hdf5Source, name: str) -> NDArray[np.float32]:
    dataset, culprit = source.dataset(name), source.name(name)
    if dataset.ndim != 3 or 0 in dataset.shape:
        raise InputError(culprit, f"shape {dataset.shape}", "three axes (z, y, x), none of them empty")
    raw = read_values(source, name, dataset)
    if raw.dtype.kind in "iu":
        return (raw / np.float32(np.iinfo(raw.dtype).max)).astype(np.float32)
    with np.errstate(over="ignore"):
        volume = raw.astype(np.float32)  # float64 beyond float32's range becomes infinite: caught below
    bad = int(volume.size - np.count_nonzero(np.isfinite(volume)))
    if bad:
        raise InputError(
            culprit, f"{bad} voxels that are NaN, infinite or too large", "finite float32 values"
        )
    return volume


def _read_grid(source: Hdf5Source, shape: tuple[int, ...]) -> Grid:
    axes = [_read_axis(source, f"{_ENTRY}/{axis}", n) for axis, n in zip("zyx", shape, strict=True)]
    # One voxel along an axis has no spacing of its own: take that of the axis that has one.
    known = [s for _, s in axes if s is not None]
    sizes = tuple(s if s is not None else (known[0] if known else 1.0) for _, s in axes)
    nz, ny, nx = shape
    return Grid((nz, ny, nx), (sizes[0], sizes[1], sizes[2]), (axes[0][0], axes[1][0], axes[2][0]))


def _read_axis(source: Hdf5Source, name: str, count: int) -> tuple[float, float | None]:
    """Centre and spacing in mm of an axis of voxel centres; the spacing is None for a single voxel."""
    culprit, dataset = source.name(name), source.optional(name)
    if dataset is None or dataset.shape != (count,):
        found = getattr(dataset, "shape", "nothing")
        raise InputError(culprit, str(found), f"{count} voxel centres in mm")
    axis = read_values(source, name, dataset).astype(np.float64)
    unit = read_attribute(source, name, "units") or "mm"
    if unit != "mm":
        raise InputError(culprit, f"units {unit!r}", "units 'mm'")
    if count == 1 and np.isfinite(axis[0]):
        return float(axis[0]), None
    with np.errstate(all="ignore"):  # ends at infinity are found below
        spacing = (axis[-1] - axis[0]) / (count - 1) if count > 1 else np.nan
        straight = np.abs(np.diff(axis) - spacing) <= _AXIS_TOLERANCE * abs(spacing)
    if not (np.isfinite(spacing) and spacing > 0 and straight.all()):
        raise InputError(culprit, "values that are not evenly rising", "voxel centres at even distances")
    return float(axis[0] + axis[-1]) / 2, float(spacing)
