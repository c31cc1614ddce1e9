"""Reads, checks and writes values in HDF5: numbers with units, text, whole numbers and voxel grids."""

import logging
import math
import posixpath
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.fields.volume import MOST_VOXELS
from phyradgs_cl.io.files import HOST_SHARE, decoded, host_bytes
from phyradgs_cl.io.hdf5 import Hdf5Source
from phyradgs_cl.io.output import written_beside

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Quantity:
    """A physical quantity. factors: for each unit, the factor that converts to the package's unit. assumed: the unit of
    datasets that state none. largest: limit in the package's unit; larger numbers are damage and would overflow later."""

    name: str
    assumed: str
    largest: float
    factors: MappingProxyType[str, float]

    def factor(self, unit: str) -> float | None:
        """Returns the factor from ``unit``, in upper or lower case, to the package's unit; None for an unknown unit."""
        return self.factors.get(unit.strip().rstrip(".").casefold())

    @property
    def accepted(self) -> str:
        """The units' names of up to four ASCII characters, for messages."""
        return ", ".join(name for name in self.factors if len(name) <= 4 and name.isascii())


def _quantity(name: str, assumed: str, largest: float, factors: dict[tuple[str, ...], float]) -> Quantity:
    flat = {unit.casefold(): factor for names, factor in factors.items() for unit in names}
    return Quantity(name, assumed, largest, MappingProxyType(flat))


LENGTH = _quantity("length", "mm", 1e9, {
    ("mm", "millimeter", "millimetre", "millimeters", "millimetres"): 1.0,
    ("cm", "centimeter", "centimetre", "centimeters", "centimetres"): 10.0,
    ("m", "meter", "metre", "meters", "metres"): 1000.0,
    ("um", "\u00b5m", "\\u00b5m", "micron", "microns", "micrometer", "micrometre", "micrometers", "micrometres"): 1e-3,
    ("nm", "nanometer", "nanometre", "nanometers", "nanometres"): 1e-6,
})  # fmt: skip
TIME = _quantity("time", "s", 1e12, {
    ("s", "sec", "second", "seconds"): 1.0,
    ("ms", "millisecond", "milliseconds"): 1e-3,
    ("us", "\u00b5s", "microsecond", "microseconds"): 1e-6,
})  # fmt: skip
ANGLE = _quantity("angle", "deg", 1e8, {
    ("deg", "degs", "degree", "degrees", "\u00b0"): math.pi / 180, ("rad", "rads", "radian", "radians"): 1.0,
    ("mdeg", "millidegree", "millidegrees"): math.pi / 180e3, ("mrad", "milliradian", "milliradians"): 1e-3,
    ("urad", "\u00b5rad", "microradian", "microradians"): 1e-6, ("gon", "gons", "gradian", "gradians"): math.pi / 200,
    ("arcmin", "arcminute", "arcminutes"): math.pi / 10800, ("arcsec", "arcsecond", "arcseconds"): math.pi / 648000,
    ("turn", "turns", "rev", "revs", "revolution", "revolutions"): 2 * math.pi,
})  # fmt: skip
PHASE = _quantity("phase", "cycle", 1e9, {
    ("cycle", "cycles"): 1.0, ("deg", "degree", "degrees", "\u00b0"): 1 / 360, ("rad", "radian", "radians"): 0.5 / math.pi
})  # fmt: skip
ATTENUATION = _quantity("attenuation", "1/mm", 1e9, {
    ("1/mm", "mm^-1", "mm-1"): 1.0, ("1/cm", "cm^-1", "cm-1"): 0.1, ("1/m", "m^-1", "m-1"): 1e-3,
    ("1/µm", "1/um", "µm^-1", "um^-1", "µm-1", "um-1"): 1e3,
})  # fmt: skip


def read_values(
    source: Hdf5Source, address: str, dataset: h5py.Dataset, kinds: str = "iuf", rows: slice | None = None
) -> np.ndarray:
    """Reads a dataset in its own type. kinds: the allowed letters of NumPy's ``dtype.kind``. rows: the only rows that are
    read of a stack (..., v, u). Raises InputError for damage and other types, OutOfMemoryError for more data than this
    machine's memory holds."""
    if dataset.dtype.kind not in kinds:
        expected = "numbers" if "f" in kinds else "whole numbers"
        raise source.error(address, f"type {dataset.dtype}", expected, "store them as plain HDF5 numbers")
    try:
        share = 1 if rows is None else (rows.stop - rows.start) / dataset.shape[-2]
        chunk_bytes = math.prod(dataset.chunks or ()) * dataset.dtype.itemsize  # HDF5 unpacks whole chunks
        if max(share * dataset.nbytes, chunk_bytes) > HOST_SHARE * host_bytes():
            raise MemoryError
        return np.asarray(dataset[()] if rows is None else dataset[..., rows, :])
    except MemoryError as error:
        found = f"shape {dataset.shape}, {dataset.nbytes / 2**30:.3g} GiB"
        raise OutOfMemoryError(source.name(address), found, "data that this machine's memory can hold") from error
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise source.error(address, f"data that HDF5 cannot read ({error})", "readable data") from error


def is_list(dataset: h5py.Dataset, count: int | None) -> bool:
    """Returns whether a dataset has ``count`` values (None: any number) along one axis. Others may have length 1, since
    MATLAB stores lists as rows or columns."""
    return dataset.size in dataset.shape and count in (None, dataset.size)


def read_shaped(source: Hdf5Source, address: str, shape: Sequence[int | None], kinds: str = "iuf") -> np.ndarray:
    """Reads a required dataset in its own type. Raises InputError unless it has the ``shape``, in which None stands for any
    length, or is such a list. kinds: see ``read_values``."""
    dataset = source.dataset(address)
    if not (of_list := len(shape) == 1 and is_list(dataset, shape[0])):
        checks.shape(source.name(address), dataset, shape)
    values = read_values(source, address, dataset, kinds)
    return values.ravel() if of_list else values


def read_array(
    source: Hdf5Source, address: str, shape: Sequence[int | None], quantity: Quantity | None = None,
    default: np.ndarray | None = None,
) -> np.ndarray:
    """Reads a numeric dataset as finite float64, in the package's unit of ``quantity``. Raises InputError for another
    shape, values that are not finite, unknown units, and a missing dataset that has no ``default``."""
    if default is not None and source.optional(address) is None:
        return default
    return _finite(source, address, read_shaped(source, address, shape), quantity)


def read_per_frame(source: Hdf5Source, address: str, used: np.ndarray, quantity: Quantity) -> np.ndarray:
    """Reads one finite number, in the package's unit, for each frame marked in ``used``, bool (F,). The dataset may have
    numbers for all frames or for the marked ones alone."""
    is_of_all = not is_list(source.dataset(address), int(used.sum()))
    values = read_shaped(source, address, used.shape if is_of_all else (None,))
    return _finite(source, address, values[used] if is_of_all else values, quantity)


def _finite(source: Hdf5Source, address: str, values: np.ndarray, quantity: Quantity | None) -> np.ndarray:
    checks.finite(source.name(address), values)
    values = values.astype(np.float64)
    return in_unit(source, address, values, quantity) if quantity else values


def read_number(
    source: Hdf5Source, address: str, quantity: Quantity | None = None, default: float | None = None
) -> float:
    """Reads a finite number from a dataset of one element, in the package's unit of ``quantity``. Raises InputError for more
    elements, other values, and a missing dataset that has no ``default``."""
    if default is not None and source.optional(address) is None:
        return default
    dataset = source.dataset(address)
    if dataset.size != 1:
        raise source.error(address, f"shape {dataset.shape}", "one number")
    return float(read_array(source, address, dataset.shape, quantity).reshape(()))


def read_length(source: Hdf5Source, address: str, quantity: Quantity) -> float:
    """Reads a required number from a dataset of one element, in the package's unit. Raises InputError for a number below
    1 / ``quantity.largest``, such as 0."""
    value = read_number(source, address, quantity)
    if value < 1 / quantity.largest:
        raise source.error(address, str(value), f"a {quantity.name} above 0, of a real scanner", "correct the value")
    return value


def read_integers(source: Hdf5Source, address: str, shape: Sequence[int | None]) -> np.ndarray:
    """Reads a required dataset of whole numbers as int64. Raises InputError for another shape or type."""
    return read_shaped(source, address, shape, kinds="iu").astype(np.int64)


def read_word(
    source: Hdf5Source, address: str, allowed: Collection[str] | None = None, default: str | None = None
) -> str:
    """Reads a string, one of ``allowed`` if given. Raises InputError for another value, and for none without ``default``."""
    if default is not None and source.optional(address) is None:
        return default
    dataset, word = source.dataset(address), None
    try:
        word = _text(dataset[()]) if dataset.size == 1 else None
    except (MemoryError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise source.error(address, f"data that HDF5 cannot read ({error})", "a string") from error
    if word is None:
        raise source.error(address, f"type {dataset.dtype}, shape {dataset.shape}", "a string")
    if allowed is not None:
        checks.one_of(source.name(address), word, allowed)
    return word


def read_title(source: Hdf5Source, address: str, default: str) -> str:
    """Reads a string; returns ``default`` if it is missing or empty."""
    return (read_word(source, address) if source.find(address) is not None else "") or default


def read_attribute(source: Hdf5Source, address: str, name: str) -> str | None:
    """Reads a text attribute; returns None if the object or the attribute is missing."""
    if (thing := source.find(address)) is None:
        return None
    subject = f"{source.name(address)} @{name}"
    try:
        value = thing.attrs.get(name)
    except (OSError, RuntimeError, TypeError, ValueError, LookupError) as error:
        raise InputError(subject, f"an attribute that HDF5 cannot read ({error})", "a string") from error
    if value is not None and (text := _text(value)) is None:
        raise InputError(subject, checks.short_repr(value), "a string")
    return None if value is None else text


def _text(value: object) -> str | None:
    """Returns the string in a value of h5py: str, bytes or an array with one of either; None for anything else."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, str):
        value = value.encode("utf-8", "surrogateescape")
    return decoded(value) if isinstance(value, bytes) else None


def in_unit(source: Hdf5Source, address: str, values: np.ndarray, quantity: Quantity) -> np.ndarray:
    """Converts finite values of any shape to the package's unit from the unit in the dataset's attribute "units" or "unit".
    Without it, assumes ``quantity.assumed``, and warns unless the dataset's name ends in that unit. Raises InputError for an
    unknown unit, and for values beyond ``quantity.largest``."""
    unit = (read_attribute(source, address, "units") or read_attribute(source, address, "unit") or "").strip()
    if not unit:
        unit = quantity.assumed
        # a name such as time_s or angle_deg states the unit
        if not posixpath.basename(address).endswith(f"_{unit}"):
            _log.warning("%s: no units attribute; %s assumed", source.name(address), unit)
    if (factor := quantity.factor(unit)) is None:
        raise InputError(f"{source.name(address)} @units", repr(unit), f"one of {quantity.accepted}")
    if (size := np.abs(values * factor).max(initial=0.0)) > quantity.largest:
        expected = f"at most {quantity.largest:g} of the package's unit of {quantity.name}"
        raise source.error(address, f"a value of size {size:.6g}", expected, "correct the value or its unit")
    return values * factor


def read_attenuation(source: Hdf5Source, address: str, dataset: h5py.Dataset) -> np.ndarray:
    """Reads finite values in 1/mm, float32, of a dataset of any shape."""
    values = read_values(source, address, dataset)
    checks.finite(source.name(address), values)
    return in_unit(source, address, values, ATTENUATION).astype(np.float32)


def read_grid(source: Hdf5Source, address: str) -> Grid:
    """Reads the voxel grid in the group ``address``: shape, voxel_size and offset (0 if missing), each (z, y, x). Raises
    InputError for impossible values."""
    shape = read_integers(source, f"{address}/shape", (3,)).tolist()
    voxel_size_mm = read_array(source, f"{address}/voxel_size", (3,), LENGTH)
    offset_mm = read_array(source, f"{address}/offset", (3,), LENGTH, default=np.zeros(3))
    if min(shape) < 1 or math.prod(shape) > MOST_VOXELS:
        raise source.error(f"{address}/shape", str(shape), f"three counts of at least 1, at most {MOST_VOXELS:.3g} voxels")
    if voxel_size_mm.min() < 1 / LENGTH.largest:
        raise source.error(f"{address}/voxel_size", str(voxel_size_mm.tolist()), "three lengths above 0")
    return Grid(triple(shape), triple(voxel_size_mm.tolist()), triple(offset_mm.tolist()))


@contextmanager
def new_hdf5(path: str | Path, size_bytes: int) -> Iterator[h5py.File]:
    """Yields a new HDF5 file for arrays of ``size_bytes``. It replaces ``path`` only on success; see ``written_beside``."""
    with written_beside(path, size_bytes) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["NX_class"], file.attrs["default"] = "NXroot", "entry"
        yield file


def write_grid(parent: h5py.Group, grid: Grid) -> None:
    group = new_group(parent, "grid", "NXcollection")
    write_number(group, "shape", grid.shape)
    write_number(group, "voxel_size", grid.voxel_size_mm, "mm")
    write_number(group, "offset", grid.offset_mm, "mm")


def write_number(
    group: h5py.Group, name: str, values: object, units: str | None = None, **attributes: str
) -> h5py.Dataset:
    dataset = group.create_dataset(name, data=values)
    if units is not None:
        dataset.attrs["units"] = units
    dataset.attrs.update(attributes)
    return dataset


def new_group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group
