"""Reads the header of a scan file: everything but its large arrays, which are read only after all checks. Functions raise
InputError, about "FILE:/hdf5/path", for missing and for impossible values."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Saturation, Scan, Shutter
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS, LARGEST_LAG
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.acquisition.trajectory import grid_of_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.deformation import check_truth
from phyradgs_cl.io.hdf5 import Hdf5Source
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.datasets import LENGTH, TIME
from phyradgs_cl.io.scan.motion import has_motion, read_gating, read_trajectory
from phyradgs_cl.io.tables import read_facts

_log = logging.getLogger(__name__)
_JITTER = 0.01  # exposures or readouts measured per frame may differ from their median by this fraction of the median
_DEEPEST_ENTRY = 3  # NXtomo entries and subentries are searched in groups nested this deep at most


@dataclass(frozen=True, eq=False)
class ScanHeader:
    """A checked scan without its arrays: ``scan.projections`` are zeros that take no memory.

    entry: address of the NXtomo group. image_key (F,): types of all stored frames. taken_at (F,): see the function.
    quantity, data_type: of the frames. mask_shape: None without a mask. states: how many times have a true volume. has_grid:
    the file states a grid."""

    scan: Scan
    entry: str
    image_key: np.ndarray
    taken_at: np.ndarray
    quantity: str
    data_type: str
    mask_shape: tuple[int, ...] | None
    has_reference: bool
    states: int
    has_grid: bool


def read_header(source: Hdf5Source) -> ScanHeader:
    """Reads and checks everything but pixels, mask and true volume. Raises InputError, with the HDF5 path, for damage."""
    entry = find_entry(source)
    data, quantity = read_data_kind(source, entry)
    image_key = read_image_key(source, entry, len(data))
    used = image_key == schema.PROJECTION
    geometry = read_geometry(source, entry, (data.shape[1], data.shape[2]))
    moving = has_motion(source, entry)
    shutter = read_shutter(source, entry, used, moving)
    is_fly = moving and shutter.exposure_s > 0
    start_s = read_starts(source, entry, used, shutter, moving)
    shutter.check_resolved(start_s, source.name(f"{entry}/{schema.DETECTOR}/count_time"))
    trajectory = read_trajectory(source, entry, geometry, used, start_s, shutter.exposure_s)
    grid, has_grid = _read_or_derive_grid(source, entry, partial(grid_of_scan, geometry, trajectory, start_s))
    extra = f"{entry}/{schema.EXTRA}"
    provenance = h5.read_word(source, f"{extra}/provenance", default="{}")
    lag = h5.read_number(source, f"{extra}/lag", default=0.0)
    checks.within(source.name(f"{extra}/lag"), lag, 0, LARGEST_LAG)
    scan = Scan(
        projections=np.broadcast_to(np.float32(0), (int(used.sum()), *data.shape[1:])), geometry=geometry,
        trajectory=trajectory, shutter=shutter, frame_start_s=start_s, grid=grid, is_fly=is_fly,
        detector_model=h5.read_word(source, f"{extra}/detector_model", DETECTOR_MODELS, default="log"),
        title=h5.read_title(source, f"{entry}/title", "cone-beam scan"),
        provenance=read_facts(source.name(f"{extra}/provenance"), provenance, {}), lag=lag,
        saturation=_read_saturation(source, entry),
        gating=read_gating(source, entry, used, start_s + shutter.span_s / 2),
    )
    scan.check_timing()
    mask_shape = check_mask(source, entry, data.shape)
    has_reference, states = check_truth(source, entry, grid)
    if not has_grid:
        where, size = source.name(f"{entry}/{schema.GRID}"), " × ".join(str(n) for n in grid.shape)
        sides_mm = " × ".join(f"{side:.4g}" for side in dict.fromkeys(grid.voxel_size_mm))
        _log.warning("%s: no grid; %s voxels of %s mm taken", where, size, sides_mm)
    for address in (f"{entry}/{name}" for name in schema.IGNORED):
        if source.find(address) is not None:
            _log.warning("%s: not read by this package", source.name(address))
    at = taken_at(source, f"{entry}/{schema.DETECTOR}/frame_start_time", image_key)
    return ScanHeader(scan, entry, image_key, at, quantity, str(data.dtype), mask_shape, has_reference, states, has_grid)


def find_entry(source: Hdf5Source, asked: str | None = None) -> str:
    """Returns the address of the NXtomo entry: ``asked``, else the only group that is defined as NXtomo, at most 3 levels
    deep. If there are several, it takes the one that the root's @default names, with a warning. If there is none, it takes
    the root's @default, /entry, or the only NXentry. Raises InputError if nothing fits, or several do."""
    if asked is not None:
        address = f"/{asked.strip('/')}"
        source.group(address)
        return address
    default = f"/{(h5.read_attribute(source, '/', 'default') or 'entry').strip('/')}"
    entries: list[str] = []
    for name in source.groups(_DEEPEST_ENTRY):
        if not any(name.startswith(f"{entry}/") for entry in entries) and _is_nxtomo(source, name):
            entries.append(name)
    if len(entries) > 1 and default in entries:
        _log.warning("%s: %d NXtomo entries; %s is taken: say --entry for another", source.path, len(entries), default)
        return default
    if not entries:
        entries = [name for name in (default, "/entry") if isinstance(source.find(name), h5py.Group)][:1]
    entries = entries or [name for name in source.groups() if h5.read_attribute(source, name, "NX_class") == "NXentry"]
    if len(entries) == 1:
        return entries[0]
    if entries:
        found, remedy = f"several entries: {', '.join(entries)[:200]}", f"say --entry {entries[0]} or another"
        raise source.error("/entry", found, "one scan", remedy)
    raise source.error("/entry", "no NXentry group", "a group 'entry'", source.misspelling("/", "entry"))


def _is_nxtomo(source: Hdf5Source, address: str) -> bool:
    thing = source.find(f"{address}/definition")
    return isinstance(thing, h5py.Dataset) and thing.size == 1 and "nxtomo" in str(thing[()]).lower()


def _read_or_derive_grid(source: Hdf5Source, entry: str, derive: Callable[[], Grid]) -> tuple[Grid, bool]:
    address = f"{entry}/{schema.GRID}"
    if source.optional_group(address) is not None:
        return h5.read_grid(source, address), True
    try:
        grid = derive()
    except InputError as error:
        remedy = "correct the geometry, or store the grid"
        raise source.error(address, "no grid, and none that follows", error.expected, remedy) from error
    return grid, False


def _read_saturation(source: Hdf5Source, entry: str) -> Saturation | None:
    level, share = (f"{entry}/{schema.EXTRA}/saturation_{name}" for name in ("level", "share"))
    if source.optional(level) is None and source.optional(share) is None:
        return None
    found = Saturation(h5.read_number(source, level), h5.read_number(source, share))
    checks.within(source.name(share), found.share, 0, 1)
    return found


def read_data_kind(source: Hdf5Source, entry: str) -> tuple[h5py.Dataset, str]:
    """Returns the dataset of frames (F, v, u), not read yet, and their quantity: "attenuation", "transmission", "counts"."""
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
    to_axis_mm = abs(h5.read_number(source, address, LENGTH))  # NeXus counts the source's distance negative
    if to_axis_mm == 0:
        remedy = f"correct the value, or store 'parallel' as {entry}/{schema.BEAM} and no distance"
        raise source.error(address, "0", "a length other than 0", remedy)
    to_detector_mm = to_axis_mm + h5.read_length(source, f"{detector}/distance", LENGTH)
    return ConeGeometry(to_axis_mm, to_detector_mm, detector_shape, (pitch_v_mm, pitch_u_mm), offset_mm)


def _is_parallel(source: Hdf5Source, entry: str) -> bool:
    """Returns whether the file says that the beam is parallel. The beam of another program's file is taken as parallel, with
    a warning, if the file has no source distance."""
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
    """Reads the shutter. Exposure and readout are required only if the gantry is ``moving``, and the order of lines only if
    lines are read one after the other. used, bool (F,): which stored frames are projections."""
    exposure_s = read_duration(source, f"{entry}/{schema.DETECTOR}/count_time", used, moving)
    needed = moving and exposure_s > 0
    readout_s = read_duration(source, f"{entry}/{schema.DETECTOR}/detector_readout_time", used, needed)
    axis, direction = f"{entry}/{schema.EXTRA}/readout_axis", f"{entry}/{schema.EXTRA}/readout_direction"
    rolling = needed and readout_s > 0  # if lines open together, their order has no effect
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
    """Reads one time in s for all projections, stored once or for every frame. Stored times may differ from their median by
    1 %, and the result is the median. Returns 0 if the dataset is missing and not ``needed``."""
    dataset = source.dataset(address) if needed else source.optional(address)
    if dataset is None:
        return 0.0
    subject = source.name(address)
    if dataset.shape != () and not any(h5.is_list(dataset, count) for count in (1, used.size)):
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
    """Reads the times (P,) in s at which projections' first lines open. If none are stored and nothing moves, returns
    evenly spaced times, which only give the order."""
    address = f"{entry}/{schema.DETECTOR}/frame_start_time"
    if not moving and source.optional(address) is None:
        return np.arange(int(used.sum())) * max(shutter.span_s, 1.0)
    return h5.read_array(source, address, used.shape, TIME)[used]


def taken_at(source: Hdf5Source, address: str, image_key: np.ndarray) -> np.ndarray:
    """Returns when stored frames were taken (F,), for interpolation between flats: their times at ``address``, in any unit,
    else their numbers. Times count if flats and projections all have their own: a writer that knows no time of a flat
    repeats another frame's, or leaves 0."""
    numbers, dataset = np.arange(len(image_key), dtype=np.float64), source.find(address)
    if not isinstance(dataset, h5py.Dataset) or not h5.is_list(dataset, len(image_key)) or dataset.dtype.kind not in "iuf":
        return numbers
    times = h5.read_shaped(source, address, image_key.shape).astype(np.float64)
    own = times[(image_key == schema.PROJECTION) | (image_key == schema.FLAT)]
    return times if np.isfinite(own).all() and len(np.unique(own)) == len(own) else numbers


def check_mask(source: Hdf5Source, entry: str, data_shape: tuple[int, ...]) -> tuple[int, ...] | None:
    """Returns the pixel mask's shape, (v, u) or (F, v, u), or None; does not read its pixels."""
    address = f"{entry}/{schema.DETECTOR}/pixel_mask"
    mask = source.optional(address)
    if mask is None:
        return None
    if mask.shape not in (data_shape, data_shape[1:]):
        raise source.error(address, f"shape {mask.shape}", f"{data_shape[1:]} (v, u) or {data_shape} (frame, v, u)")
    if mask.dtype.kind not in "biu":
        raise source.error(address, f"type {mask.dtype}", "whole numbers", "non-zero marks a bad pixel")
    return mask.shape
