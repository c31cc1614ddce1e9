"""Copies of a scan file with another geometry or timing and the same frames, raw counts included."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl.acquisition import PoseTable, Scan
from phyradgs_cl.io.hdf5.datasets import LENGTH, TIME, new_group, read_array, write_number
from phyradgs_cl.io.hdf5.source import open_hdf5
from phyradgs_cl.io.output import written_beside
from phyradgs_cl.io.scan import schema
from phyradgs_cl.io.scan.header import read_header
from phyradgs_cl.io.scan.motion import storable, write_motion, write_poses


def copy_with_offset(source: str | Path, target: str | Path, shift_u_mm: float) -> None:
    """Copies a scan file with its panel ``shift_u_mm`` further along u: changes detector_offset, and poses where it has
    them. InputError for a file that is no scan, OutputError where the copy cannot be written."""
    with open_hdf5(source) as opened:
        header = read_header(opened)
        poses = f"{header.entry}/{schema.POSES}/pose"
        table = None if opened.optional(poses) is None else read_array(opened, poses, (None, 12), LENGTH)
    offset_v_mm, offset_u_mm = header.scan.geometry.detector_offset_mm
    with _copied(source, target, header.entry) as entry:
        _replace(entry[schema.EXTRA], "detector_offset", np.array([offset_v_mm, offset_u_mm + shift_u_mm]), "mm")
        if table is not None:
            step = table[:, 6:9]
            table[:, 3:6] += shift_u_mm * step / np.linalg.norm(step, axis=1, keepdims=True)
            _replace(entry[schema.POSES], "pose", table, "mm")


def copy_with_motion(source: str | Path, target: str | Path, scan: Scan) -> None:
    """Copies a scan file with geometry, timing, lag, trajectory and provenance of ``scan``, which has its frames; equal
    values are not touched. InputError for a file that is no scan, OutputError where the copy cannot be written."""
    with open_hdf5(source) as opened:
        header = read_header(opened)
        start = f"{header.entry}/{schema.DETECTOR}/frame_start_time"
        there = opened.optional(start) is not None
        starts_s = read_array(opened, start, header.image_key.shape, TIME) if there else None
    stated, scan = header.scan, storable(scan)
    later_s = np.asarray(scan.frame_start_s) - np.asarray(stated.frame_start_s)
    frame_of = np.clip(np.cumsum(header.image_key == schema.PROJECTION) - 1, 0, None)
    with _copied(source, target, header.entry) as entry:
        if scan.geometry != stated.geometry:
            _replace_geometry(entry, scan)
        if scan.shutter != stated.shutter or later_s.any():
            detector = entry[schema.DETECTOR]
            _replace(detector, "count_time", scan.shutter.exposure_s, "s")
            _replace(detector, "detector_readout_time", scan.shutter.readout_s, "s")
            if scan.shutter.direction != stated.shutter.direction:
                _remove(entry[schema.EXTRA], "readout_direction")
                write_number(entry[schema.EXTRA], "readout_direction", scan.shutter.direction)
            if starts_s is not None:
                starts_s[header.image_key == schema.PROJECTION] += later_s
                _replace(detector, "frame_start_time", starts_s, "s")
            _remove(entry, f"{schema.SAMPLE}/rotation_angle", f"{schema.SAMPLE}/rotation_angle_end")
            _remove(entry, schema.KINEMATICS, schema.POSES)
            write_motion(entry, scan, frame_of)
        elif isinstance(scan.trajectory, PoseTable):
            _remove(entry, schema.POSES)
            if not scan.is_fly:  # with poses and an exposure it would be read as moving; poses need the times of frames
                detector = entry[schema.DETECTOR]
                _replace(detector, "count_time", 0.0, "s")
                _replace(detector, "detector_readout_time", 0.0, "s")
                _replace(detector, "frame_start_time", np.asarray(scan.frame_start_s)[frame_of], "s")
            write_poses(entry, scan)
        if scan.lag != stated.lag:
            _remove(entry[schema.EXTRA], "lag")
            write_number(entry[schema.EXTRA], "lag", scan.lag)
        _remove(entry, f"{schema.EXTRA}/provenance")
        entry[schema.EXTRA]["provenance"] = json.dumps(scan.provenance, default=str)


@contextmanager
def _copied(source: str | Path, target: str | Path, entry: str) -> Iterator[h5py.Group]:
    """Yields the entry of a copy, with the package's own group; the copy replaces ``target`` after the body."""
    with written_beside(target) as temporary:
        shutil.copyfile(source, temporary)
        with h5py.File(temporary, "r+") as file:
            group = file[entry]
            if schema.EXTRA not in group:
                new_group(group, schema.EXTRA, "NXcollection")
            yield group


def _replace_geometry(entry: h5py.Group, scan: Scan) -> None:
    geometry = scan.geometry
    behind_mm = geometry.source_to_detector_mm - geometry.source_to_axis_mm
    _replace(entry[schema.EXTRA], "detector_offset", np.array(geometry.detector_offset_mm), "mm")
    _replace(entry[schema.SOURCE], "distance", -geometry.source_to_axis_mm, "mm")
    _replace(entry[schema.DETECTOR], "distance", behind_mm, "mm")


def _remove(group: h5py.Group, *names: str) -> None:
    for name in names:
        if name in group:
            del group[name]


def _replace(group: h5py.Group, name: str, values: object, units: str) -> None:
    _remove(group, name)
    write_number(group, name, values, units)
