"""Reads OME-Zarr of versions 0.4 and 0.5: one volume at full resolution, with its voxel sizes and position."""

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.files import check_room
from phyradgs_cl.io.hdf5.datasets import LENGTH

log = logging.getLogger(__name__)


def read_zarr(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, str]:
    """Returns values (z, y, x) in their own type, sizes (3,) of a voxel and the first one's centre (3,), both (z, y, x) in
    mm, and the folder's note on its values. Sizes and centre are both None, with a warning, where an axis has no unit of
    length, a number is not finite, or a size is not above 0. Raises InputError for what is no OME-Zarr of real numbers, for
    damage, for several times or channels, and for more than the machine's memory."""
    subject = str(path)
    zarr = checks.package("zarr", "the package that reads OME-Zarr", "phyradgs-cl[zarr]")
    try:
        group = zarr.open_group(subject, mode="r")
        facts: Any = group.attrs.get("ome", group.attrs)["multiscales"][0]
        array = group[facts["datasets"][0]["path"]]
        axes = {axis["name"]: axis.get("unit") for axis in facts["axes"]}
        sizes, first = _sizes_and_first(facts, len(axes))
        note = str((facts.get("metadata") or {}).get("values", ""))
        missing = math.prod(array.cdata_shape) - array.nchunks_initialized
        long = [name for name, count in zip(axes, array.shape, strict=True) if name not in "zyx" and count > 1]
        order = [list(axes).index(name) for name in "zyx"]
    except Exception as error:  # zarr and its stores raise exceptions of every kind
        found = f"no OME-Zarr ({type(error).__name__}: {str(error)[:100]})"
        raise InputError(subject, found, "a folder with multiscales, axes z, y and x") from error
    if array.dtype.kind not in "iuf" or long or 0 in array.shape:
        found = f"axes {', '.join(axes)} of {array.shape} voxels, {array.dtype}"
        raise InputError(subject, found, "real numbers of one volume, one time and channel", "save one of them")
    check_room(subject, max(math.prod(array.shape), math.prod(array.chunks)) * max(array.dtype.itemsize, 4))
    if missing:
        log.warning("%s: %d chunks are missing and read as %s: were they lost?", path, missing, array.fill_value)
    try:
        values = np.asarray(array[...])
    except Exception as error:
        raise InputError(subject, f"a damaged chunk ({str(error)[:100]})", "a complete OME-Zarr", "copy it again") from error
    values = np.moveaxis(values, order, (-3, -2, -1)).reshape([array.shape[i] for i in order])
    units = [axes[name] for name in "zyx"]
    in_mm = np.array([LENGTH.factor(str(unit)) for unit in units], np.float64)
    size_mm, first_mm = sizes[order] * in_mm, first[order] * in_mm
    if not (np.isfinite(size_mm).all() and np.isfinite(first_mm).all() and size_mm.min() > 0):
        text = "%s: no voxel sizes can be made of %s in units %s: the scale is left out"
        log.warning(text, path, sizes[order].tolist(), units)
        return values, None, None, note
    return values, size_mm, first_mm, note


def _sizes_and_first(facts: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns a voxel's sizes and the first voxel's centre, each (count,), at full resolution, in the axes' units."""
    sizes, first = np.ones(count), np.zeros(count)
    for change in (*facts["datasets"][0]["coordinateTransformations"], *facts.get("coordinateTransformations", ())):
        by = np.asarray(change[change["type"]], np.float64)
        if change["type"] == "scale":
            sizes, first = sizes * by, first * by
        elif change["type"] == "translation":
            first = first + by
        else:
            raise ValueError(f"transformation {change['type']}")
    return sizes, first
