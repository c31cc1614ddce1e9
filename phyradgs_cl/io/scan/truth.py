"""The truth in scan files: a reference volume, and of an object that moves its states and its deformation."""

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import Grid, MovingTruth
from phyradgs_cl.io.deformation import read_deformation_group, write_deformation_group
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.source import Hdf5Source
from phyradgs_cl.io.scan import schema


def write_truth(extra: h5py.Group, scan: Scan) -> None:
    """Writes the group ``reference`` of a scan that has a truth."""
    moving = scan.moving_truth
    if scan.reference is None and moving is None:
        return
    group = h5.new_group(extra, "reference", "NXcollection")
    if scan.reference is not None:
        _write_volumes(group, "volume", scan.reference)
    if moving is not None:
        _write_volumes(group, "states", moving.volumes)
        h5.write_number(group, "state_times", moving.times_s, "s")
        if moving.deformation is not None:
            write_deformation_group(group, moving.deformation)


def check_truth(source: Hdf5Source, entry: str, grid: Grid) -> tuple[bool, int]:
    """Returns whether there is a reference, and the number of states; InputError where their shapes do not fit."""
    if source.optional_group(f"{entry}/{schema.REFERENCE}") is None:
        return False, 0
    states, times = (source.optional(f"{entry}/{name}") for name in (schema.STATES, schema.STATE_TIMES))
    if states is None and times is None:
        _check_shape(source, f"{entry}/{schema.TRUTH}", source.dataset(f"{entry}/{schema.TRUTH}").shape, grid.shape)
        return True, 0
    states, times = (source.dataset(f"{entry}/{name}") for name in (schema.STATES, schema.STATE_TIMES))
    _check_shape(source, f"{entry}/{schema.STATES}", states.shape, (times.size, *grid.shape))
    volume = source.optional(f"{entry}/{schema.TRUTH}")
    if volume is not None:
        _check_shape(source, f"{entry}/{schema.TRUTH}", volume.shape, grid.shape)
    return volume is not None, int(times.size)


def read_reference(source: Hdf5Source, entry: str) -> np.ndarray:
    """Reads the reference (nz, ny, nx) float32 in 1/mm. InputError for values that are not finite, or nowhere above 0."""
    return _read_volumes(source, f"{entry}/{schema.TRUTH}")


def read_moving_truth(source: Hdf5Source, entry: str) -> MovingTruth:
    """Reads the states of an object that moves, their times, and its deformation if there is one."""
    times_s = h5.read_array(source, f"{entry}/{schema.STATE_TIMES}", (None,), h5.TIME)
    volumes = _read_volumes(source, f"{entry}/{schema.STATES}")
    address = f"{entry}/{schema.DEFORMATION}"
    moves = source.optional_group(address) is not None
    return MovingTruth(times_s, volumes, read_deformation_group(source, address) if moves else None)


def _check_shape(source: Hdf5Source, address: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if shape != expected:
        remedy = f"store the reference's own grid in {address.split('/reference/')[0]}/grid"
        raise source.error(address, f"shape {shape}", f"the grid's {expected}", remedy)


def _write_volumes(group: h5py.Group, name: str, volumes: np.ndarray) -> None:
    dataset = group.create_dataset(name, data=np.asarray(volumes, np.float32), compression="gzip", shuffle=True)
    dataset.attrs["units"] = "1/mm"


def _read_volumes(source: Hdf5Source, address: str) -> np.ndarray:
    values = h5.read_values(source, address, source.dataset(address))
    checks.finite(source.name(address), values)
    if values.max() <= 0:
        found = f"no voxel above 0 (the largest is {values.max() + 0.0:g})"
        raise source.error(address, found, "a truth to compare with", "take the reference out of the file")
    return h5.in_unit(source, address, values, h5.ATTENUATION).astype(np.float32)
