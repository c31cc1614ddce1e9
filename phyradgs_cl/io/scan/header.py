"""Reads the header of a scan file: everything but its large arrays, checked before those are read."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Saturation, Scan
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS, LARGEST_LAG
from phyradgs_cl.acquisition.trajectory import grid_of_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.deformation import check_truth
from phyradgs_cl.io.hdf5.datasets import read_attribute, read_grid, read_number, read_title, read_word
from phyradgs_cl.io.hdf5.source import Hdf5Source
from phyradgs_cl.io.scan import detector
from phyradgs_cl.io.scan.motion import has_motion, read_gating, read_trajectory
from phyradgs_cl.io.tables import read_facts

_log = logging.getLogger(__name__)
_DEEPEST_ENTRY = 3  # levels of groups searched below the root for NXtomo's definition, which a subentry may hold


@dataclass(frozen=True, eq=False)
class ScanHeader:
    """A checked scan without its arrays: ``scan.projections`` are zeros that take no memory.

    entry: address of the NXtomo group. image_key (F,): of all stored frames. mask_shape: None without a mask. states: the
    number of true states. has_grid: the file states the grid."""

    scan: Scan
    entry: str
    image_key: np.ndarray
    quantity: str
    data_type: str
    mask_shape: tuple[int, ...] | None
    has_reference: bool
    states: int
    has_grid: bool


def read_header(source: Hdf5Source) -> ScanHeader:
    """Reads and checks everything but pixels, mask and reference. Raises InputError, with the HDF5 path, for damage."""
    entry = find_entry(source)
    data, quantity = detector.read_data_kind(source, entry)
    image_key = detector.read_image_key(source, entry, len(data))
    used = image_key == schema.PROJECTION
    geometry = detector.read_geometry(source, entry, (data.shape[1], data.shape[2]))
    moving = has_motion(source, entry)
    shutter = detector.read_shutter(source, entry, used, moving)
    is_fly = moving and shutter.exposure_s > 0
    start_s = detector.read_starts(source, entry, used, shutter, moving)
    shutter.check_resolved(start_s, source.name(f"{entry}/{schema.DETECTOR}/count_time"))
    trajectory = read_trajectory(source, entry, geometry, used, start_s, shutter.exposure_s)
    grid, has_grid = _read_or_derive_grid(source, entry, partial(grid_of_scan, geometry, trajectory, start_s))
    extra = f"{entry}/{schema.EXTRA}"
    provenance = read_word(source, f"{extra}/provenance", default="{}")
    lag = read_number(source, f"{extra}/lag", default=0.0)
    checks.within(source.name(f"{extra}/lag"), lag, 0, LARGEST_LAG)
    scan = Scan(
        projections=np.broadcast_to(np.float32(0), (int(used.sum()), *data.shape[1:])), geometry=geometry,
        trajectory=trajectory, shutter=shutter, frame_start_s=start_s, grid=grid, is_fly=is_fly,
        detector_model=read_word(source, f"{extra}/detector_model", DETECTOR_MODELS, default="log"),
        title=read_title(source, f"{entry}/title", "cone-beam scan"),
        provenance=read_facts(source.name(f"{extra}/provenance"), provenance, {}), lag=lag,
        saturation=_read_saturation(source, entry),
        gating=read_gating(source, entry, used, start_s + shutter.span_s / 2),
    )
    scan.check_timing()
    mask_shape = detector.check_mask(source, entry, data.shape)
    has_reference, states = check_truth(source, entry, grid)
    if not has_grid:
        where, size = source.name(f"{entry}/{schema.GRID}"), " × ".join(str(n) for n in grid.shape)
        sides_mm = " × ".join(f"{side:.4g}" for side in dict.fromkeys(grid.voxel_size_mm))
        _log.warning("%s: no grid; %s voxels of %s mm taken", where, size, sides_mm)
    for address in (f"{entry}/{name}" for name in schema.IGNORED):
        if source.find(address) is not None:
            _log.warning("%s: not read by this package", source.name(address))
    return ScanHeader(scan, entry, image_key, quantity, str(data.dtype), mask_shape, has_reference, states, has_grid)


def find_entry(source: Hdf5Source, asked: str | None = None) -> str:
    """Returns the address of the NXtomo entry: ``asked``, else the only group with that definition, at most 3 levels
    deep. Of several groups it takes the root's @default, with a warning. Without such a group it takes the root's
    @default, /entry, or the only NXentry. Raises InputError where no entry is left, and for several without a default."""
    if asked is not None:
        address = f"/{asked.strip('/')}"
        source.group(address)
        return address
    default = f"/{(read_attribute(source, '/', 'default') or 'entry').strip('/')}"
    entries: list[str] = []
    for name in source.groups(_DEEPEST_ENTRY):
        if not any(name.startswith(f"{entry}/") for entry in entries) and _is_nxtomo(source, name):
            entries.append(name)
    if len(entries) > 1 and default in entries:
        _log.warning("%s: %d NXtomo entries; %s is taken: say --entry for another", source.path, len(entries), default)
        return default
    if not entries:
        entries = [name for name in (default, "/entry") if isinstance(source.find(name), h5py.Group)][:1]
    entries = entries or [name for name in source.groups() if read_attribute(source, name, "NX_class") == "NXentry"]
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
        return read_grid(source, address), True
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
    found = Saturation(read_number(source, level), read_number(source, share))
    checks.within(source.name(share), found.share, 0, 1)
    return found
