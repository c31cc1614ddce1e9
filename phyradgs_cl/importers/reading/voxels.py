"""Voxels as another program stored them, and the turn into this package's order, frame and unit."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.io import LoadedVolume
from phyradgs_cl.io.hdf5.datasets import LENGTH
from phyradgs_cl.io.tables import LARGEST

RAS = np.array([-1.0, -1.0, 1.0])  # what turns right, anterior, superior into LPS, and back
_OBLIQUE = 1e-3  # of a step


@dataclass(frozen=True, eq=False)
class Voxels:
    """Values (k, j, i) as stored, and where they are in LPS, the world's x, y, z. steps_mm (3, 3): rows are the ways
    from voxel to voxel along i, j, k; None of bare values. origin_mm (3,): centre of voxel (0, 0, 0); None centres the
    volume on the axis. note: what the file says of its values."""

    values: np.ndarray
    steps_mm: np.ndarray | None = None
    origin_mm: np.ndarray | None = None
    note: str = ""


def along_world_axes(subject: str, stored: Voxels) -> LoadedVolume:
    """The volume (z, y, x) float32 along rising world axes, and its grid; bare integers as shares of their type's
    maximum. InputError: Hounsfield units, axes that are oblique, lengths that are absurd, NaN or infinity."""
    if "HU" in stored.note.split():
        raise InputError(subject, "Hounsfield units", "1/mm", "export it without --mu-water-per-mm")
    values, steps = stored.values, stored.steps_mm
    if steps is None:
        most = np.iinfo(values.dtype).max if values.dtype.kind in "iu" else 1
        return LoadedVolume(_float32(subject, values / np.float32(most)), None)
    sizes = np.abs(steps).max(axis=1)
    for size in sizes:
        checks.within(f"{subject}: voxel size (mm)", float(size), 1 / LENGTH.largest, LENGTH.largest)
    world = np.abs(steps).argmax(axis=1).tolist()
    across = np.abs(steps).sum(axis=1) - sizes
    if sorted(world) != [0, 1, 2] or np.any(across > _OBLIQUE * sizes):
        found = f"voxel steps {np.round(steps, 4).tolist()} mm"
        raise InputError(subject, found, "axes along the world's", "resample it onto such a grid")
    index = [world.index(axis) for axis in (2, 1, 0)]  # of z, y, x among i, j, k
    turned = values.transpose([2 - n for n in index])
    falling = [n for n, axis in zip(index, (2, 1, 0), strict=True) if steps[n, axis] < 0]
    turned = np.flip(turned, tuple(index.index(n) for n in falling))
    size_mm = triple(float(sizes[n]) for n in index)
    if stored.origin_mm is None:
        return LoadedVolume(_float32(subject, turned), Grid(turned.shape, size_mm))
    counts = np.array(values.shape[::-1])
    centre_mm = stored.origin_mm + ((counts - 1) / 2) @ steps
    if not np.all(np.abs(centre_mm) <= LENGTH.largest):
        raise InputError(f"{subject}: origin", str(stored.origin_mm.tolist())[:80], "three lengths in mm")
    return LoadedVolume(_float32(subject, turned), Grid(turned.shape, size_mm, triple(centre_mm[::-1])))


def header_numbers(
    subject: str, header: Mapping[str, str], key: str, count: int, default: str = "nothing"
) -> np.ndarray:
    """(count,) numbers of a text header, with spaces, commas or brackets between."""
    text = header.get(key, default)
    try:
        values = np.array([float(word) for word in re.split(r"[\s,()]+", text) if word])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.all(np.abs(values) <= LARGEST):
        raise InputError(f"{subject} {key}", text[:60] or "nothing", f"{count} numbers")
    return values


def _float32(subject: str, values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):  # what float32 cannot hold is infinite, and refused
        volume = np.ascontiguousarray(values, np.float32)
    checks.finite(subject, volume)
    return volume
