"""The voxel grid in files, and the one that a scan without a grid gets."""

import math

import h5py

from phyradgs_cl.acquisition.field_of_view import default_grid as default_grid
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.volume import MOST_VOXELS
from phyradgs_cl.io.hdf5.datasets import new_group, read_array, read_integers, write_number
from phyradgs_cl.io.hdf5.source import Hdf5Source
from phyradgs_cl.io.hdf5.units import LENGTH


def read_grid(source: Hdf5Source, address: str) -> Grid:
    """The grid stored in the group at ``address``: shape, voxel_size and offset, each (z, y, x)."""
    shape = read_integers(source, f"{address}/shape", (3,))
    voxel_size_mm = read_array(source, f"{address}/voxel_size", (3,), LENGTH)
    offset_mm = (0.0, 0.0, 0.0)
    if source.optional(f"{address}/offset") is not None:
        offset_mm = tuple(read_array(source, f"{address}/offset", (3,), LENGTH).tolist())
    if shape.min() < 1:
        raise source.error(f"{address}/shape", str(shape.tolist()), "three counts of at least 1")
    if math.prod(shape.tolist()) > MOST_VOXELS:
        expected = f"at most {MOST_VOXELS:.3g} voxels"
        raise source.error(f"{address}/shape", str(shape.tolist()), expected, "correct the counts")
    if voxel_size_mm.min() < 1 / LENGTH.largest:
        raise source.error(f"{address}/voxel_size", str(voxel_size_mm.tolist()), "three lengths above 0")
    return Grid(tuple(shape.tolist()), tuple(voxel_size_mm.tolist()), offset_mm)


def write_grid(parent: h5py.Group, grid: Grid) -> None:
    """Add the group ``grid`` to ``parent``."""
    group = new_group(parent, "grid", "NXcollection")
    write_number(group, "shape", grid.shape)
    write_number(group, "voxel_size", grid.voxel_size_mm, "mm")
    write_number(group, "offset", grid.offset_mm, "mm")
