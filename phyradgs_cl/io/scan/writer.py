"""Writes scan files, which other programs can read as NXtomo, and copies of them with another geometry or timing."""

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry, PoseTable, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.deformation import write_packed, write_truth
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5 import open_hdf5
from phyradgs_cl.io.output import written_beside
from phyradgs_cl.io.scan.header import read_header
from phyradgs_cl.io.scan.motion import storable, write_gating, write_motion, write_poses
from phyradgs_cl.text import plain_text

_log = logging.getLogger(__name__)


def write_scan(
    path: str | Path, scan: Scan, *, data: np.ndarray | None = None, image_key: np.ndarray | None = None,
    quantity: str = "attenuation",
) -> None:
    """Writes a scan file, completely or not at all; it replaces an existing one. data: raw frames (F, v, u), float32 or
    uint16, with flats and darks; None writes the line integrals of ``scan``. quantity: what ``data`` are, "attenuation",
    "transmission" or "counts". image_key (F,): 0 projection, 1 flat, 2 dark, 3 invalid, with as many 0 as ``scan`` has
    frames. A user's own class of trajectory becomes a table of poses. Raises InputError for arguments that contradict each
    other, and for a scan that the format cannot express; OutputError if the file cannot be written."""
    frames, key = _checked_frames(scan, data, image_key, quantity)
    if scan.is_fly and scan.shutter.exposure_s == 0 and scan.shutter.readout_s > 0:  # readers would take the scan as at rest
        remedy = "give the exposure its real length"
        raise InputError("exposure_s", "0 in a fly-scan with a readout", "a time above 0 s", remedy)
    scan = storable(scan)
    with h5.new_hdf5(path, frames.nbytes) as file:
        entry = h5.new_group(file, "entry", "NXentry")
        entry.attrs["default"], entry.attrs["definition"] = "data", "NXtomo"
        entry["definition"], entry["title"] = "NXtomo", plain_text(scan.title)
        h5.new_group(entry, schema.SAMPLE, "NXsample")["name"] = plain_text(scan.title)
        # Flats and darks get the angle and time of the projection before them.
        frame_of = np.clip(np.cumsum(key == schema.PROJECTION) - 1, 0, None)
        _write_instrument(entry, scan, frames, key, quantity, frame_of)
        _write_extra(entry, scan, frame_of)
        write_motion(entry, scan, frame_of)
        links = h5.new_group(entry, "data", "NXdata")
        links.attrs["signal"] = "data"
        links.attrs["axes"] = ["rotation_angle", ".", "."]
        for place in (schema.DATA, f"{schema.DETECTOR}/image_key", f"{schema.SAMPLE}/rotation_angle"):
            links[place.rpartition("/")[2]] = h5py.SoftLink(f"/entry/{place}")


def _checked_frames(
    scan: Scan, data: np.ndarray | None, image_key: np.ndarray | None, quantity: str
) -> tuple[np.ndarray, np.ndarray]:
    checks.one_of("quantity", quantity, schema.QUANTITIES)
    if data is None:
        if quantity != "attenuation" or image_key is not None:
            raise InputError("data", "None", "raw frames with an image_key", "pass the frames of this quantity")
        data = scan.projections
    key = np.zeros(len(data), np.int64) if image_key is None else np.asarray(image_key)
    frames = data if data.dtype == np.uint16 else data.astype(np.float32, copy=False)
    checks.shape("data", frames, (None, *scan.geometry.detector_shape))
    checks.shape("image_key", key, (len(frames),))
    if int(np.count_nonzero(key == schema.PROJECTION)) != scan.frames or not np.isin(key, range(4)).all():
        expected = f"keys 0 to 3, {scan.frames} of them 0 (the scan's frames)"
        raise InputError("image_key", f"{np.count_nonzero(key == schema.PROJECTION)} projections", expected)
    if frames.dtype == np.uint16 and quantity != "counts":
        raise InputError("data", f"{quantity} as uint16", "float32", "only counts may be whole numbers")
    return frames, key


def _write_instrument(
    entry: h5py.Group, scan: Scan, frames: np.ndarray, key: np.ndarray, quantity: str, frame_of: np.ndarray
) -> None:
    geometry, instrument = scan.geometry, h5.new_group(entry, "instrument", "NXinstrument")
    source = h5.new_group(instrument, "source", "NXsource")
    if isinstance(geometry, ConeGeometry):
        h5.write_number(source, "distance", -geometry.source_to_axis_mm, "mm")
    detector = h5.new_group(instrument, "detector", "NXdetector")
    detector.create_dataset("data", data=frames).attrs.update(quantity=quantity, interpretation="image")
    h5.write_number(detector, "image_key", key.astype(np.int32))
    pitch_v_mm, pitch_u_mm = geometry.pixel_size_mm
    h5.write_number(detector, "x_pixel_size", pitch_u_mm, "mm")
    h5.write_number(detector, "y_pixel_size", pitch_v_mm, "mm")
    if isinstance(geometry, ConeGeometry):
        h5.write_number(detector, "distance", geometry.source_to_detector_mm - geometry.source_to_axis_mm, "mm")
    exposure_s, readout_s = _stored_durations(scan)
    if exposure_s + readout_s < scan.shutter.span_s:
        _log.warning("a stop-and-shoot scan with a pose table is stored without exposure and readout times")
    h5.write_number(detector, "count_time", exposure_s, "s")
    h5.write_number(detector, "detector_readout_time", readout_s, "s")
    h5.write_number(detector, "frame_start_time", np.asarray(scan.frame_start_s, np.float64)[frame_of], "s")
    if scan.pixel_mask is not None:
        mask = np.asarray(scan.pixel_mask) != 0
        mask = (mask if mask.ndim == 2 else mask[frame_of]).astype(np.uint8)
        detector.create_dataset("pixel_mask", data=mask, compression="gzip", shuffle=True)


def _stored_durations(scan: Scan) -> tuple[float, float]:
    """Returns exposure and readout in s for the file. Both are 0 for a stop-and-shoot scan with a pose table, because
    readers take a pose table with an exposure for a fly-scan."""
    if not scan.is_fly and isinstance(scan.trajectory, PoseTable):
        return 0.0, 0.0
    return scan.shutter.exposure_s, scan.shutter.readout_s


def _write_extra(entry: h5py.Group, scan: Scan, frame_of: np.ndarray) -> None:
    extra = h5.new_group(entry, schema.EXTRA, "NXcollection")
    if scan.is_parallel:
        extra["beam"] = "parallel"
    extra["readout_axis"] = scan.shutter.axis
    h5.write_number(extra, "readout_direction", scan.shutter.direction)
    h5.write_number(extra, "detector_offset", scan.geometry.detector_offset_mm, "mm")
    extra["detector_model"] = scan.detector_model
    if scan.lag > 0:
        h5.write_number(extra, "lag", scan.lag)
    if scan.saturation is not None:
        h5.write_number(extra, "saturation_level", scan.saturation.level)
        h5.write_number(extra, "saturation_share", scan.saturation.share)
    if scan.shutter.pulse_s is not None and _stored_durations(scan)[0] > 0:
        start_s, length_s = scan.shutter.pulse_s
        h5.write_number(extra, "pulse_start", start_s, "s")
        h5.write_number(extra, "pulse_length", length_s, "s")
    if scan.provenance:
        extra["provenance"] = json.dumps(scan.provenance, default=str)
    h5.write_grid(extra, scan.grid)
    write_truth(extra, scan)
    if scan.metal is not None:
        group = h5.new_group(extra, "metal", "NXcollection")
        h5.write_grid(group, scan.metal.grid)
        write_packed(group, "volume", scan.metal.values)
    write_gating(extra, scan, frame_of)


def copy_with_offset(source: str | Path, target: str | Path, shift_u_mm: float) -> None:
    """Copies a scan file and shifts the panel by ``shift_u_mm`` along u, in detector_offset and, if there are any, in the
    poses. Raises InputError for a file that is no scan, OutputError if the copy cannot be written."""
    with open_hdf5(source) as opened:
        header = read_header(opened)
        poses = f"{header.entry}/{schema.POSES}/pose"
        table = None if opened.optional(poses) is None else h5.read_array(opened, poses, (None, 12), h5.LENGTH)
    offset_v_mm, offset_u_mm = header.scan.geometry.detector_offset_mm
    with _copied(source, target, header.entry) as entry:
        _replace(entry[schema.EXTRA], "detector_offset", np.array([offset_v_mm, offset_u_mm + shift_u_mm]), "mm")
        if table is not None:
            step = table[:, 6:9]
            table[:, 3:6] += shift_u_mm * step / np.linalg.norm(step, axis=1, keepdims=True)
            _replace(entry[schema.POSES], "pose", table, "mm")


def copy_with_motion(source: str | Path, target: str | Path, scan: Scan) -> None:
    """Copies a scan file with the geometry, shutter, trajectory and provenance of ``scan``, which has the same frames.
    Changes only what differs. Raises InputError for a file that is no scan, OutputError if the copy cannot be written."""
    with open_hdf5(source) as opened:
        header = read_header(opened)
    stated, scan = header.scan, storable(scan)
    frame_of = np.clip(np.cumsum(header.image_key == schema.PROJECTION) - 1, 0, None)
    with _copied(source, target, header.entry) as entry:
        if (geometry := scan.geometry) != stated.geometry:
            _replace(entry[schema.EXTRA], "detector_offset", np.array(geometry.detector_offset_mm), "mm")
            if isinstance(geometry, ConeGeometry):
                behind_mm = geometry.source_to_detector_mm - geometry.source_to_axis_mm
                _replace(entry[schema.SOURCE], "distance", -geometry.source_to_axis_mm, "mm")
                _replace(entry[schema.DETECTOR], "distance", behind_mm, "mm")
        if scan.shutter != stated.shutter:
            detector = entry[schema.DETECTOR]
            _replace(detector, "count_time", scan.shutter.exposure_s, "s")
            _replace(detector, "detector_readout_time", scan.shutter.readout_s, "s")
            if scan.shutter.direction != stated.shutter.direction:
                _remove(entry[schema.EXTRA], "readout_direction")
                h5.write_number(entry[schema.EXTRA], "readout_direction", scan.shutter.direction)
            _remove(entry, f"{schema.SAMPLE}/rotation_angle", f"{schema.SAMPLE}/rotation_angle_end")
            _remove(entry, schema.KINEMATICS, schema.POSES)
            write_motion(entry, scan, frame_of)
        elif isinstance(scan.trajectory, PoseTable):
            _remove(entry, schema.POSES)
            if not scan.is_fly:  # poses at rest are stored with their times and without exposure (_stored_durations)
                detector = entry[schema.DETECTOR]
                _replace(detector, "count_time", 0.0, "s")
                _replace(detector, "detector_readout_time", 0.0, "s")
                _replace(detector, "frame_start_time", np.asarray(scan.frame_start_s)[frame_of], "s")
            write_poses(entry, scan)
        if scan.shutter != stated.shutter or not scan.is_fly:  # the middles of the file's frames may have moved
            _remove(entry, schema.GATING)
            write_gating(entry[schema.EXTRA], scan, frame_of)
        _remove(entry, f"{schema.EXTRA}/provenance")
        entry[schema.EXTRA]["provenance"] = json.dumps(scan.provenance, default=str)


@contextmanager
def _copied(source: str | Path, target: str | Path, entry: str) -> Iterator[h5py.Group]:
    """Yields the group ``entry`` of a copy of ``source``, in which the group ``EXTRA`` is made if it is missing. On success
    the copy replaces ``target``."""
    with written_beside(target) as temporary:
        shutil.copyfile(source, temporary)
        with h5py.File(temporary, "r+") as file:
            group = file[entry]
            if schema.EXTRA not in group:
                h5.new_group(group, schema.EXTRA, "NXcollection")
            yield group


def _remove(group: h5py.Group, *names: str) -> None:
    for name in names:
        if name in group:
            del group[name]


def _replace(group: h5py.Group, name: str, values: object, units: str) -> None:
    _remove(group, name)
    h5.write_number(group, name, values, units)
