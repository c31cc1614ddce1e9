"""What importers of HDF5 share: numeric frames of any type, optional numbers with units, the sense of angles."""

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions, needed
from phyradgs_cl.io.hdf5.datasets import LENGTH, Quantity, read_length, read_values
from phyradgs_cl.io.hdf5.source import Hdf5Source


def read_frames(source: Hdf5Source, address: str, panel: tuple[int, int] | None = None) -> np.ndarray:
    """Frames (F, v, u) in their own type; with ``panel``, all of that shape, and one alone may come as (v, u)."""
    dataset, subject = source.dataset(address), source.name(address)
    if dataset.dtype.kind not in "iuf":
        raise InputError(subject, f"type {dataset.dtype}", "real numbers")
    if panel is not None and dataset.shape == panel:
        return read_values(source, address, dataset)[None]
    if dataset.ndim != 3 or min(dataset.shape) < 1:
        raise InputError(subject, f"shape {dataset.shape}", "three axes (frame, v, u), none of them empty")
    if panel is not None and dataset.shape[1:] != panel:
        expected = f"(any, {panel[0]}, {panel[1]}), as the projections"
        raise InputError(subject, f"shape {dataset.shape}", expected)
    return read_values(source, address, dataset)


def optional_length(source: Hdf5Source, *addresses: str, quantity: Quantity = LENGTH) -> float | None:
    """The first of some datasets that is there, as a number above 0 in the package's unit."""
    for address in addresses:
        if source.find(address) is not None:
            return read_length(source, address, quantity)
    return None


def stored_pitch(source: Hdf5Source, options: ImportOptions, *addresses: str) -> float:
    """The size of a pixel in mm at the first of some addresses; InputError where none has it."""
    size = optional_length(source, *addresses)
    if size is None:
        raise source.error(addresses[0], "nothing", "a length", f"say {options.named('pixel_size_mm')}")
    return size


def distance_to_detector(source: Hdf5Source, address: str, to_axis_mm: float, options: ImportOptions) -> float:
    """From the source, mm: the option's, else behind the axis by what is stored at ``address``."""
    behind_mm = None if options.source_to_detector_mm else optional_length(source, address)
    to_detector_mm = options.source_to_detector_mm if behind_mm is None else to_axis_mm + behind_mm
    return needed(to_detector_mm, "source_to_detector_mm", source.name(address), options.named)


def gantry_sign(options: ImportOptions, custom: str) -> float:
    """+1 where stored angles are the gantry's, −1 where they are the sample's."""
    return 1.0 if (options.rotates or custom) == "gantry" else -1.0
