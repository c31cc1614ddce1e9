"""Writes scan files: an NXtomo entry, which other programs read too."""

import json
import logging
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import PoseTable, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io.hdf5.datasets import new_group, new_hdf5, write_grid, write_number
from phyradgs_cl.io.scan import schema
from phyradgs_cl.io.scan.motion import storable, write_motion
from phyradgs_cl.text import plain_text

_log = logging.getLogger(__name__)


def write_scan(
    path: str | Path,
    scan: Scan,
    *,
    data: np.ndarray | None = None,
    image_key: np.ndarray | None = None,
    quantity: str = "attenuation",
) -> None:
    """Writes a scan file, whole or not at all, in place of an existing one.

    Without ``data`` the line integrals of ``scan`` are written. ``data``: (F, v, u) float32 or uint16 raw frames with flats
    and darks, whose ``quantity`` is "attenuation", "transmission" or "counts"; image_key (F,): 0 projection, 1 flat, 2
    dark, 3 invalid, with as many 0 as ``scan`` has frames. A user's own trajectory becomes a table of poses.

    Raises: InputError for arguments that contradict each other, or a scan that the format cannot express; OutputError where
    the file cannot be written.
    """
    frames, key = _checked_frames(scan, data, image_key, quantity)
    if scan.is_fly and scan.shutter.exposure_s == 0 and scan.shutter.readout_s > 0:  # in a file the gantry would stand
        remedy = "give the exposure its real length"
        raise InputError("exposure_s", "0 in a fly-scan with a readout", "a time above 0 s", remedy)
    scan = storable(scan)
    with new_hdf5(path, frames.nbytes) as file:
        entry = new_group(file, "entry", "NXentry")
        entry.attrs["default"], entry.attrs["definition"] = "data", "NXtomo"
        entry["definition"], entry["title"] = "NXtomo", plain_text(scan.title)
        new_group(entry, schema.SAMPLE, "NXsample")["name"] = plain_text(scan.title)
        # Frames between projections (flats, darks) get the values of the projection before them.
        frame_of = np.clip(np.cumsum(key == schema.PROJECTION) - 1, 0, None)
        _write_instrument(entry, scan, frames, key, quantity, frame_of)
        _write_extra(entry, scan)
        write_motion(entry, scan, frame_of)
        _write_links(entry)


def _checked_frames(
    scan: Scan, data: np.ndarray | None, image_key: np.ndarray | None, quantity: str
) -> tuple[np.ndarray, np.ndarray]:
    checks.one_of("quantity", quantity, schema.QUANTITIES)
    if data is None:
        if quantity != "attenuation" or image_key is not None:
            expected = "raw frames with an image_key"
            raise InputError("data", "None", expected, "pass the frames of this quantity")
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
    geometry, instrument = scan.geometry, new_group(entry, "instrument", "NXinstrument")
    source = new_group(instrument, "source", "NXsource")
    write_number(source, "distance", -geometry.source_to_axis_mm, "mm")
    detector = new_group(instrument, "detector", "NXdetector")
    detector.create_dataset("data", data=frames).attrs.update(quantity=quantity, interpretation="image")
    write_number(detector, "image_key", key.astype(np.int32))
    pitch_v_mm, pitch_u_mm = geometry.pixel_size_mm
    write_number(detector, "x_pixel_size", pitch_u_mm, "mm")
    write_number(detector, "y_pixel_size", pitch_v_mm, "mm")
    write_number(detector, "distance", geometry.source_to_detector_mm - geometry.source_to_axis_mm, "mm")
    exposure_s, readout_s = _stored_durations(scan)
    if exposure_s + readout_s < scan.shutter.span_s:
        _log.warning("a stop-and-shoot scan with a pose table is stored without exposure and readout times")
    write_number(detector, "count_time", exposure_s, "s")
    write_number(detector, "detector_readout_time", readout_s, "s")
    write_number(detector, "frame_start_time", np.asarray(scan.frame_start_s, np.float64)[frame_of], "s")
    if scan.pixel_mask is not None:
        mask = np.asarray(scan.pixel_mask) != 0
        mask = (mask if mask.ndim == 2 else mask[frame_of]).astype(np.uint8)
        detector.create_dataset("pixel_mask", data=mask, compression="gzip", shuffle=True)


def _stored_durations(scan: Scan) -> tuple[float, float]:
    """Returns exposure and readout in s for the file: 0 for a gantry that stops along a pose table, which would be read as
    moving."""
    if not scan.is_fly and isinstance(scan.trajectory, PoseTable):
        return 0.0, 0.0
    return scan.shutter.exposure_s, scan.shutter.readout_s


def _write_extra(entry: h5py.Group, scan: Scan) -> None:
    extra = new_group(entry, schema.EXTRA, "NXcollection")
    extra["readout_axis"] = scan.shutter.axis
    write_number(extra, "readout_direction", scan.shutter.direction)
    write_number(extra, "detector_offset", scan.geometry.detector_offset_mm, "mm")
    extra["detector_model"] = scan.detector_model
    if scan.lag > 0:
        write_number(extra, "lag", scan.lag)
    if scan.saturation is not None:
        write_number(extra, "saturation_level", scan.saturation.level)
        write_number(extra, "saturation_share", scan.saturation.share)
    if scan.shutter.pulse_s is not None and _stored_durations(scan)[0] > 0:
        start_s, length_s = scan.shutter.pulse_s
        write_number(extra, "pulse_start", start_s, "s")
        write_number(extra, "pulse_length", length_s, "s")
    if scan.provenance:
        extra["provenance"] = json.dumps(scan.provenance, default=str)
    write_grid(extra, scan.grid)
    if scan.reference is not None:
        volume = np.asarray(scan.reference, np.float32)
        group = new_group(extra, "reference", "NXcollection")
        dataset = group.create_dataset("volume", data=volume, compression="gzip", shuffle=True)
        dataset.attrs["units"] = "1/mm"


def _write_links(entry: h5py.Group) -> None:
    group = new_group(entry, "data", "NXdata")
    group.attrs["signal"] = "data"
    group.attrs["axes"] = ["rotation_angle", ".", "."]
    group["data"] = h5py.SoftLink(f"/entry/{schema.DETECTOR}/data")
    group["image_key"] = h5py.SoftLink(f"/entry/{schema.DETECTOR}/image_key")
    group["rotation_angle"] = h5py.SoftLink(f"/entry/{schema.SAMPLE}/rotation_angle")
