"""Typed reads from an Hdf5Source: numbers with units, words and whole numbers, each checked at once."""

import logging
import math
import posixpath
from collections.abc import Collection, Sequence

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.io.hdf5.source import Hdf5Source
from phyradgs_cl.io.hdf5.units import Quantity
from phyradgs_cl.io.memory import HOST_SHARE, at_most, host_bytes

_BUFFERS = 4  # of a chunk's size: as stored, and between filters
_log = logging.getLogger(__name__)


def read_values(source: Hdf5Source, address: str, dataset: h5py.Dataset, kinds: str = "iuf") -> np.ndarray:
    """All values of a dataset in their own type; InputError unless NumPy's kind of it is in ``kinds``."""
    subject = source.name(address)
    try:
        kind = dataset.dtype.kind
        if kind not in kinds:
            wanted = "numbers" if "f" in kinds else "whole numbers"
            raise InputError(subject, f"type {dataset.dtype}", wanted, "store them as plain HDF5 numbers")
        return np.asarray(_unfolded(dataset))
    except MemoryError as error:
        found = f"shape {dataset.shape}, {dataset.nbytes / 2**30:.3g} GiB"
        raise OutOfMemoryError(subject, found, "data that this machine's memory can hold") from error
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(subject, _damage(error), "readable data") from error


def _unfolded(dataset: h5py.Dataset) -> object:
    if dataset.nbytes > HOST_SHARE * host_bytes():
        raise MemoryError
    chunk_bytes = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize
    with at_most(dataset.nbytes + _BUFFERS * chunk_bytes):
        return dataset[()]


def _damage(error: Exception) -> str:
    bomb = ", or that unfold to more than their header promises" if "filter" in str(error) else ""
    return f"data that HDF5 cannot read{bomb} ({error})"


def read_array(
    source: Hdf5Source, address: str, shape: Sequence[int | None], quantity: Quantity | None = None
) -> np.ndarray:
    """A required numeric dataset as float64 in the package's unit; every value finite."""
    dataset = source.dataset(address)
    checks.shape(source.name(address), dataset, shape)
    values = read_values(source, address, dataset).astype(np.float64)
    checks.finite(source.name(address), values)
    return in_unit(source, address, values, quantity) if quantity else values


def read_length(source: Hdf5Source, address: str, quantity: Quantity) -> float:
    """A required number above zero; a dataset of one element will do."""
    value = read_number(source, address, quantity)
    if value <= 0:
        raise source.error(address, str(value), f"a {quantity.name} above 0", "correct the value")
    if value < 1 / quantity.largest:
        raise source.error(address, str(value), f"a {quantity.name} of a real scanner")
    return value


def read_number(source: Hdf5Source, address: str, quantity: Quantity | None = None) -> float:
    """A required finite number in the package's unit; a dataset of one element will do."""
    dataset = source.dataset(address)
    if dataset.size != 1:
        raise source.error(address, f"shape {dataset.shape}", "one number")
    values = read_values(source, address, dataset).astype(np.float64)
    checks.finite(source.name(address), values)
    return float((in_unit(source, address, values, quantity) if quantity else values).reshape(()))


def read_integers(source: Hdf5Source, address: str, shape: Sequence[int | None]) -> np.ndarray:
    """A required dataset of whole numbers as int64."""
    dataset = source.dataset(address)
    checks.shape(source.name(address), dataset, shape)
    return read_values(source, address, dataset, kinds="iu").astype(np.int64)


def read_word(source: Hdf5Source, address: str, allowed: Collection[str] | None = None) -> str:
    """A required string, one of ``allowed`` where they are given."""
    dataset = source.dataset(address)
    if dataset.size != 1:  # many entries may all be one long text, which the file's size does not bound
        raise source.error(address, f"shape {dataset.shape}", "a string")
    try:
        word = as_text(_unfolded(dataset))
    except (MemoryError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise source.error(address, _damage(error), "a string") from error
    if word is None:
        raise source.error(address, f"type {dataset.dtype}, shape {dataset.shape}", "a string")
    if allowed is not None:
        checks.one_of(source.name(address), word, allowed)
    return word


def read_title(source: Hdf5Source, address: str, default: str) -> str:
    """A string that may be missing or empty."""
    return (read_word(source, address) if source.find(address) is not None else "") or default


def in_unit(source: Hdf5Source, address: str, values: np.ndarray, quantity: Quantity) -> np.ndarray:
    """Finite values (any shape) in the package's unit; InputError for some beyond all reason."""
    values = values * unit_factor(source, address, quantity)
    size = np.abs(values).max(initial=0.0)
    if size > quantity.largest:
        expected = f"at most {quantity.largest:g} of the package's unit for a {quantity.name}"
        raise source.error(address, f"a value of size {size:.6g}", expected, "correct the value or its unit")
    return values


def unit_factor(source: Hdf5Source, address: str, quantity: Quantity) -> float:
    """Factor from the dataset's units to the package's; a missing attribute is assumed, and logged."""
    unit = read_attribute(source, address, "units")
    if unit is None:
        unit = quantity.assumed
        # A name that ends in the unit (time_s, angle_deg) says it well enough.
        if not posixpath.basename(address).endswith(f"_{unit}"):
            _log.warning("%s: no units attribute; %s assumed", source.name(address), unit)
    factor = quantity.factor(unit)
    if factor is None:
        raise InputError(f"{source.name(address)} @units", repr(unit), f"one of {quantity.accepted}")
    return factor


def read_attribute(source: Hdf5Source, address: str, name: str) -> str | None:
    """A text attribute of an object that exists, or None."""
    found = source.find(address)
    if found is None:
        return None
    subject = f"{source.name(address)} @{name}"
    try:
        if name not in found.attrs:
            return None
        shape = found.attrs.get_id(name).shape
        value = found.attrs[name] if math.prod(shape) == 1 else f"shape {shape}"
        text = as_text(value) if math.prod(shape) == 1 else None
    except (OSError, RuntimeError, TypeError, ValueError, LookupError) as error:
        raise InputError(subject, f"an attribute that HDF5 cannot read ({error})", "a string") from error
    if text is None:
        raise InputError(subject, checks.shown(value), "a string")
    return text


def as_text(value: object) -> str | None:
    """A string from what h5py gives for one (str, bytes, an array of one), else None."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value) if isinstance(value, str) else None


def write_number(
    group: h5py.Group, name: str, values: object, units: str | None = None, **attributes: str
) -> h5py.Dataset:
    """A small dataset with its units attribute."""
    dataset = group.create_dataset(name, data=values)
    if units is not None:
        dataset.attrs["units"] = units
    dataset.attrs.update(attributes)
    return dataset


def new_group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    """A group with its NeXus class."""
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group
