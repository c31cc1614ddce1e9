"""Damage to one object of an HDF5 file, for tests of what a reader says about it."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

Change = Callable[[h5py.File, str], object]


def on(address: str, change: Change) -> Callable[[Path], None]:
    """The change of one object as damage of a file."""

    def damage(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file, address)

    return damage


def put(file: h5py.File, address: str, value: object = None, **how: object) -> h5py.Dataset:
    """Another dataset with the attributes of the old one."""
    attributes = dict(file[address].attrs)
    del file[address]
    made = file.create_dataset(address, data=value, **how)
    made.attrs.update(attributes)
    return made


def changed(change: Callable[[np.ndarray], object]) -> Change:
    return lambda file, address: put(file, address, change(np.asarray(file[address][()])))


def value(new: object) -> Change:
    """Another value altogether."""
    return lambda file, address: put(file, address, new)


def attribute(name: str, value: object) -> Change:
    """One attribute of an object."""
    return lambda file, address: file[address].attrs.__setitem__(name, value)


def removed(file: h5py.File, address: str) -> None:
    del file[address]
