"""NXtomo files of other programs (HDF5). Values that this package's scan files must have may come from options. The format
does not state which row is on top. Row 0 is taken as the lowest, with a warning, after the flips that the file declares in
either way of the nxtomo package. The column of the rotation axis becomes a detector offset. Without a
source distance the beam is parallel."""

import logging
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.options import OF_BARE_FRAMES, ImportOptions
from phyradgs_cl.importers.reading import frames as reading
from phyradgs_cl.importers.reading.frames import line_integrals, oriented
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.datasets import ANGLE, LENGTH, TIME
from phyradgs_cl.io.hdf5.source import Hdf5Source, open_hdf5
from phyradgs_cl.io.scan.detector import read_duration
from phyradgs_cl.io.scan.header import find_entry
from phyradgs_cl.io.scan.reader import united

_log = logging.getLogger(__name__)
_MOVES = ("x_translation", "y_translation", "z_translation")


def recognises(path: Path) -> bool:
    """True for an HDF5 file of no other format. InputError for a volume of this package."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as source:
        if isinstance(source.find("/exchange"), h5py.Group):
            return False
        for member in ("/entry/reconstruction", "/volume"):
            if source.find(member) is not None and source.find("/entry/instrument") is None:
                remedy = "'phyradgs export' writes volumes in other formats, 'phyradgs simulate --volume' projects one"
                raise InputError(f"{path}:{member}", "a volume", "projections with their geometry", remedy)
    return True


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the projections of the file's NXtomo entry, with its flats and darks."""
    options.refuse_unused("nxtomo", OF_BARE_FRAMES)
    with open_hdf5(path) as source:
        entry = find_entry(source)
        if source.find(extra := f"{entry}/{schema.EXTRA}") is not None:  # an import would lose a part of it
            found, expected = "a scan file of this package", "a file of another program"
            raise source.error(extra, found, expected, "use it as it is")
        detector = f"{entry}/{schema.DETECTOR}"
        frames = reading.read_frames(source, f"{detector}/data")
        key = _image_key(source, detector, len(frames))
        used = key == schema.PROJECTION
        turn = _turned(source, detector)
        mask = _mask(source, detector, frames.shape, used)
        geometry = _geometry(source, entry, (frames.shape[1], frames.shape[2]), turn, options)
        timing, trajectory = _motion(source, entry, used, geometry, options)
        quantity = h5.read_attribute(source, f"{detector}/data", "quantity")
        _refuse_moves(source, entry, used)
        title = h5.read_title(source, f"{entry}/title", path.stem)
    if options.row_0 is None:
        text = "%s: row 0 is taken as the lowest, after flips that the file declares; say %s top if the volume is mirrored"
        _log.warning(text, path, options.named("row_0"))
    frames = oriented(turn.frames(frames), options, "bottom")
    flats, darks = (frames[key == kind] for kind in (schema.FLAT, schema.DARK))
    where = f"{path}:{detector}/data"
    integrals = line_integrals(where, frames[used], options, flats=flats, darks=darks, convention=quantity)
    if mask is not None:
        mask = oriented(turn.frames(mask), options, "bottom")
        integrals = replace(integrals, mask=united(mask, integrals.mask))
    parts = integrals, trajectory, geometry, timing, options
    return assemble.assemble_scan(*parts, title=title, source=str(path))


def _image_key(source: Hdf5Source, detector: str, frames: int) -> np.ndarray:
    for name in ("image_key", "image_key_control"):
        if source.find(f"{detector}/{name}") is not None:
            key = h5.read_integers(source, f"{detector}/{name}", (frames,))
            key = np.where(key == -1, schema.INVALID, key)  # of nxtomo's alignment frames
            if not np.any(key == schema.PROJECTION):
                raise source.error(f"{detector}/{name}", "no projection", "at least one 0")
            return key
    return np.full(frames, schema.PROJECTION)


def _turned(source: Hdf5Source, detector: str) -> assemble.Turned:
    """Reads the flips that the file declares: half turns of the detector about its x axis (rows) and y axis (columns)."""
    flips = [False, False]
    for index, address in enumerate((f"{detector}/y_flipped", f"{detector}/x_flipped")):
        if source.find(address) is not None:
            flips[index] = bool(np.any(h5.read_values(source, address, source.dataset(address), kinds="biu")))
    for index, name in enumerate(("rx", "ry")):
        address = f"{detector}/transformations/{name}"
        if source.find(address) is not None:
            half_turns = h5.read_number(source, address, ANGLE) / np.pi
            if abs(half_turns - round(half_turns)) > 1e-6:
                raise source.error(address, f"{half_turns * 180:g}°", "0° or 180°: a flip")
            flips[index] ^= bool(round(half_turns) % 2)
    return assemble.Turned(rows=flips[0], columns=flips[1])


def _mask(source: Hdf5Source, detector: str, shape: tuple[int, ...], used: np.ndarray) -> np.ndarray | None:
    address = f"{detector}/pixel_mask"
    if source.find(address) is None:
        return None
    mask = h5.read_values(source, address, source.dataset(address), kinds="biu") != 0
    if mask.shape not in (shape, shape[1:]):
        raise source.error(address, f"shape {mask.shape}", f"{shape[1:]} or {shape}")
    mask = mask if mask.ndim == 2 else mask[used]
    return mask if mask.any() else None


def _geometry(
    source: Hdf5Source, entry: str, panel: tuple[int, int], turn: assemble.Turned, options: ImportOptions
) -> Geometry:
    detector, where = f"{entry}/{schema.DETECTOR}", f"{entry}/{schema.SOURCE}/distance"
    to_axis_mm = options.source_to_axis_mm
    if to_axis_mm is None and source.find(where) is not None:
        to_axis_mm = abs(h5.read_number(source, where, LENGTH))  # NeXus gives it a minus sign
        if to_axis_mm == 0:
            remedy = f"say {options.named('source_to_axis_mm')}, or remove it: without one the beam is parallel"
            raise source.error(where, "0", "a length other than 0", remedy)
    v, u = f"{detector}/y_pixel_size", f"{detector}/x_pixel_size"
    stored = reading.stored_pitch
    pitch = options.pixel_size_mm or (stored(source, options, v), stored(source, options, u))
    offset = options.detector_offset_mm or _axis_offset(source, detector, pitch, turn, options)
    return assemble.stored_beam(source, (where, f"{detector}/distance"), to_axis_mm, options, panel, pitch, offset)


def _axis_offset(
    source: Hdf5Source, detector: str, pitch: tuple[float, ...], turn: assemble.Turned, options: ImportOptions
) -> tuple[float, float]:
    """Reads the detector offset (v, u) in mm from the axis's column, which nxtomo counts from the panel's middle."""
    for name in ("x_rotation_axis_pixel_position", "estimated_cor_from_motor"):
        address = f"{detector}/{name}"
        if source.find(address) is None:
            continue
        column = h5.read_number(source, address)
        flipped = turn.columns != (options.column_0 == "right")
        if column != 0:
            _log.warning("%s: taken as %g columns from the panel's middle", source.name(address), column)
        return 0.0, (column if flipped else -column) * pitch[1]
    return 0.0, 0.0


def _motion(
    source: Hdf5Source, entry: str, used: np.ndarray, geometry: Geometry, options: ImportOptions
) -> tuple[assemble.Timing, CircularOrbit]:
    """Reads timing and orbit. With ``rotation_angle_end`` every frame has its own sweep; else the angles give the speed."""
    detector, sample = f"{entry}/{schema.DETECTOR}", f"{entry}/{schema.SAMPLE}"
    rotates = h5.read_attribute(source, f"{sample}/rotation_angle", "rotates") or "sample"
    sign = reading.gantry_sign(options, rotates)
    angle = sign * h5.read_array(source, f"{sample}/rotation_angle", used.shape, ANGLE)[used]
    sweeps = source.find(f"{sample}/rotation_angle_end") is not None and options.frame_time_s is None
    start_s = h5.read_array(source, f"{detector}/frame_start_time", used.shape, TIME)[used] if sweeps else None
    stored = assemble.StoredTiming(
        exposure_s=read_duration(source, f"{detector}/count_time", used, needed=False),
        readout_s=read_duration(source, f"{detector}/detector_readout_time", used, needed=False),
        start_s=start_s, angle_at="start" if sweeps else None,
    )
    timing = assemble.make_timing(source.name(entry), int(used.sum()), options, stored)
    if not sweeps:
        return timing, assemble.turning(geometry, angle, timing)
    last = sign * h5.read_array(source, f"{sample}/rotation_angle_end", used.shape, ANGLE)[used]
    sweep = FrameSweeps(timing.start_s, timing.shutter.exposure_s, angle, last)
    return timing, CircularOrbit(geometry, sweep)


def _refuse_moves(source: Hdf5Source, entry: str, used: np.ndarray) -> None:
    """Refuses a sample that moves between projections, which this import cannot express."""
    for name in _MOVES:
        address = f"{entry}/{schema.SAMPLE}/{name}"
        if source.find(address) is None:
            continue
        values = h5.read_array(source, address, (None,), LENGTH)
        values = values[used] if values.shape == used.shape else values
        if np.ptp(values) > 0:
            found = f"{values.min():.6g} to {values.max():.6g} mm"
            raise source.error(address, found, "a sample that stays where it is")
