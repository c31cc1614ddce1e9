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
        units = {axis["name"]: LENGTH.factor(str(axis.get("unit"))) for axis in facts["axes"]}
        order = [list(units).index(name) for name in "zyx"]
        sizes, first = _sizes_and_first(facts, array.ndim)
        shape = [array.shape[axis] for axis in order]
        if array.dtype.kind not in "iuf" or len(units) != array.ndim or not 0 < math.prod(shape) == array.size:
            raise ValueError(f"axes {', '.join(units)} of {array.shape} voxels, {array.dtype}")
        check_room(subject, max(array.size, math.prod(array.chunks)) * max(array.dtype.itemsize, 4))
        if missing := math.prod(array.cdata_shape) - array.nchunks_initialized:
            log.warning("%s: %d chunks are missing and read as %s: were they lost?", path, missing, array.fill_value)
        values = np.moveaxis(np.asarray(array[...]), order, (-3, -2, -1)).reshape(shape)
        note = str((facts.get("metadata") or {}).get("values", ""))
    except InputError:
        raise
    except Exception as error:  # zarr and its stores pass on errors of every kind
        found = f"{type(error).__name__}: {str(error)[:150]}"
        raise InputError(subject, found, "an OME-Zarr with real numbers of one volume along z, y and x") from error
    in_mm = np.array([units[name] for name in "zyx"], np.float64)  # None becomes NaN
    size_mm, first_mm = sizes[order] * in_mm, first[order] * in_mm
    if not (np.isfinite([size_mm, first_mm]).all() and size_mm.min() > 0):
        log.warning("%s: its axes have no sizes in a unit of length: the scale is left out", path)
        return values, None, None, note
    return values, size_mm, first_mm, note


def _sizes_and_first(facts: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns a voxel's sizes and the first voxel's centre, each (count,), at full resolution, in the axes' units."""
    sizes, first = np.ones(count), np.zeros(count)
    for change in (*facts["datasets"][0]["coordinateTransformations"], *facts.get("coordinateTransformations", ())):
        if change["type"] not in ("scale", "translation"):
            raise ValueError(f"transformation {change['type']}")
        by = np.asarray(change[change["type"]], np.float64)
        sizes, first = (sizes * by, first * by) if change["type"] == "scale" else (sizes, first + by)
    return sizes, first
