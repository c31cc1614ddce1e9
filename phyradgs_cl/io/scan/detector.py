"""Reads the detector's part of a scan file: kinds of frames, geometry, shutter and mask, without the pixels. Functions raise
InputError, about "FILE:/hdf5/path", for missing and for impossible values."""

import logging

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.datasets import LENGTH, TIME
from phyradgs_cl.io.hdf5.source import Hdf5Source

_log = logging.getLogger(__name__)
_JITTER = 0.01  # largest deviation of a measured time from the median of all frames' times, as a fraction of the median


def read_data_kind(source: Hdf5Source, entry: str) -> tuple[h5py.Dataset, str]:
    """Returns the dataset of frames (F, v, u), unread, and their quantity: "attenuation", "transmission" or "counts"."""
    address = f"{entry}/{schema.DETECTOR}/data"
    data, subject = source.dataset(address), source.name(address)
    if data.ndim != 3 or min(data.shape) < 1:
        raise InputError(subject, f"shape {data.shape}", "three axes (frame, v, u), none of them empty")
    if (data.dtype.kind, data.dtype.itemsize) not in (("f", 4), ("u", 2)):
        raise InputError(subject, f"type {data.dtype}", "float32 or uint16", "convert the frames")
    quantity = h5.read_attribute(source, address, "quantity")
    if quantity is None:
        expected = "one of " + ", ".join(schema.QUANTITIES)
        raise InputError(f"{subject} @quantity", "no attribute", expected, "add the attribute to the dataset")
    checks.one_of(f"{subject} @quantity", quantity, schema.QUANTITIES)
    if quantity != "counts" and data.dtype.kind == "u":
        raise InputError(subject, f"{quantity} as {data.dtype}", "float32", "store float32, or counts as uint16")
    return data, quantity


def read_image_key(source: Hdf5Source, entry: str, frames: int) -> np.ndarray:
    """Reads the image key (F,) of all stored frames: 0 projection, 1 flat, 2 dark, 3 invalid, and at least one 0."""
    address = f"{entry}/{schema.DETECTOR}/image_key"
    image_key = h5.read_integers(source, address, (frames,))
    wrong = ~np.isin(image_key, (schema.PROJECTION, schema.FLAT, schema.DARK, schema.INVALID))
    if wrong.any():
        at = int(np.argmax(wrong))
        raise source.error(address, f"{image_key[at]} at index {at}", "0 projection, 1 flat, 2 dark or 3 invalid")
    if not np.any(image_key == schema.PROJECTION):
        raise source.error(address, "no projection", "at least one 0", "mark the projections with 0")
    return image_key


def read_geometry(source: Hdf5Source, entry: str, detector_shape: tuple[int, int]) -> Geometry:
    """Reads the circular geometry from distances, pixel sizes and offset. A parallel beam has no distances."""
    detector, address = f"{entry}/{schema.DETECTOR}", f"{entry}/{schema.SOURCE}/distance"
    pitch_v_mm = h5.read_length(source, f"{detector}/y_pixel_size", LENGTH)
    pitch_u_mm = h5.read_length(source, f"{detector}/x_pixel_size", LENGTH)
    offset = f"{entry}/{schema.EXTRA}/detector_offset"
    offset_mm = tuple(h5.read_array(source, offset, (2,), LENGTH, default=np.zeros(2)).tolist())
    if _is_parallel(source, entry):
        return ParallelGeometry(detector_shape, (pitch_v_mm, pitch_u_mm), offset_mm)
    to_axis_mm = abs(h5.read_number(source, address, LENGTH))  # in NeXus the source's distance is negative
    if to_axis_mm == 0:
        remedy = f"correct the value, or store 'parallel' as {entry}/{schema.BEAM} and no distance"
        raise source.error(address, "0", "a length other than 0", remedy)
    to_detector_mm = to_axis_mm + h5.read_length(source, f"{detector}/distance", LENGTH)
    return ConeGeometry(to_axis_mm, to_detector_mm, detector_shape, (pitch_v_mm, pitch_u_mm), offset_mm)


def _is_parallel(source: Hdf5Source, entry: str) -> bool:
    """Returns whether the beam is parallel: as stated or, with a warning, in another program's file without a source
    distance."""
    beam, distance = f"{entry}/{schema.BEAM}", f"{entry}/{schema.SOURCE}/distance"
    has_distance = source.optional(distance) is not None
    if source.optional(beam) is not None:
        is_parallel = h5.read_word(source, beam, schema.BEAMS) == "parallel"
        if is_parallel and has_distance:
            expected = "no source distance in a file with a parallel beam"
            raise source.error(distance, "a distance", expected, f"remove it, or {entry}/{schema.BEAM}")
        return is_parallel
    if has_distance or source.find(f"{entry}/{schema.EXTRA}") is not None:
        return False
    _log.warning("%s: no source distance: a parallel beam", source.name(distance))
    return True


def read_shutter(source: Hdf5Source, entry: str, used: np.ndarray, moving: bool) -> Shutter:
    """Reads exposure and readout, which must be there only where the gantry moves; their order only for a rolling readout.
    used, bool (F,): the stored frames that are projections."""
    exposure_s = read_duration(source, f"{entry}/{schema.DETECTOR}/count_time", used, moving)
    needed = moving and exposure_s > 0
    readout_s = read_duration(source, f"{entry}/{schema.DETECTOR}/detector_readout_time", used, needed)
    axis, direction = f"{entry}/{schema.EXTRA}/readout_axis", f"{entry}/{schema.EXTRA}/readout_direction"
    rolling = needed and readout_s > 0  # only then the order of lines matters
    word = h5.read_word(source, axis, AXES, default=None if rolling else "rows")
    number = h5.read_number(source, direction, default=None if rolling else 1.0)
    checks.one_of(source.name(direction), number, (1, -1))
    pulse_s = _read_pulse(source, entry, exposure_s + readout_s)
    return Shutter(exposure_s, readout_s, word, int(number), pulse_s)


def _read_pulse(source: Hdf5Source, entry: str, span_s: float) -> tuple[float, float] | None:
    start, length = f"{entry}/{schema.EXTRA}/pulse_start", f"{entry}/{schema.EXTRA}/pulse_length"
    if source.optional(start) is None and source.optional(length) is None:
        return None
    start_s = h5.read_number(source, start, TIME)
    length_s = h5.read_length(source, length, TIME)
    if start_s >= span_s or start_s + length_s <= 0:
        found = f"a pulse from {start_s:g} to {start_s + length_s:g} s"
        expected = f"one that meets the frame's window, 0 to {span_s:g} s"
        raise source.error(start, found, expected, "correct the pulse, or remove both datasets")
    return start_s, length_s


def read_duration(source: Hdf5Source, address: str, used: np.ndarray, needed: bool) -> float:
    """Reads one time in s for all projections, stored once or for every frame. Measured times may differ by a percent; their
    median is returned. Returns 0 where it is missing and not ``needed``."""
    dataset = source.dataset(address) if needed else source.optional(address)
    if dataset is None:
        return 0.0
    subject = source.name(address)
    if dataset.shape not in ((), (1,), used.shape):
        raise InputError(subject, f"shape {dataset.shape}", f"one number or shape {used.shape}")
    values = h5.read_values(source, address, dataset).astype(np.float64).reshape(-1)
    values = values if values.shape != used.shape else values[used]
    checks.finite(subject, values)
    values = h5.in_unit(source, address, values, TIME)
    if values.min() < 0:
        raise InputError(subject, f"{values.min():.6g} s", "a time of at least 0 s", "correct the value")
    usual_s = float(np.median(values))
    if np.abs(values - usual_s).max() > _JITTER * usual_s:
        raise InputError(subject, f"{values.min():.6g} to {values.max():.6g} s", "one time for all projections")
    return usual_s


def read_starts(
    source: Hdf5Source, entry: str, used: np.ndarray, shutter: Shutter, moving: bool
) -> np.ndarray:
    """Reads the opening times (P,) in s of the projections; returns evenly spaced times where nothing moves and none are
    stored."""
    address = f"{entry}/{schema.DETECTOR}/frame_start_time"
    if not moving and source.optional(address) is None:
        return np.arange(int(used.sum())) * max(shutter.span_s, 1.0)
    return h5.read_array(source, address, used.shape, TIME)[used]


def check_mask(source: Hdf5Source, entry: str, data_shape: tuple[int, ...]) -> tuple[int, ...] | None:
    """Returns the shape, (v, u) or (F, v, u), of the pixel mask without reading it; None without a mask."""
    address = f"{entry}/{schema.DETECTOR}/pixel_mask"
    mask = source.optional(address)
    if mask is None:
        return None
    if mask.shape not in (data_shape, data_shape[1:]):
        raise source.error(address, f"shape {mask.shape}", f"{data_shape[1:]} (v, u) or {data_shape} (frame, v, u)")
    if mask.dtype.kind not in "biu":
        raise source.error(address, f"type {mask.dtype}", "whole numbers", "non-zero marks a bad pixel")
    return mask.shape
