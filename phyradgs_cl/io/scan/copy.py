"""A copy of a scan file in which the panel stands elsewhere; everything else stays as it is, raw counts included."""

import shutil
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl.io.hdf5.datasets import new_group, read_array, write_number
from phyradgs_cl.io.hdf5.source import open_hdf5
from phyradgs_cl.io.hdf5.units import LENGTH
from phyradgs_cl.io.output import written_beside
from phyradgs_cl.io.scan import schema
from phyradgs_cl.io.scan.header import read_header


def copy_with_offset(source: str | Path, target: str | Path, shift_u_mm: float) -> None:
    """Copy a scan file with its panel ``shift_u_mm`` further along u: detector_offset, and poses where it has them.
    Raises InputError for a file that is no scan, OutputError where the copy cannot be written."""
    with open_hdf5(source) as opened:
        header = read_header(opened)
        poses = f"{header.entry}/{schema.POSES}/pose"
        table = None if opened.optional(poses) is None else read_array(opened, poses, (None, 12), LENGTH)
    offset_v_mm, offset_u_mm = header.scan.geometry.detector_offset_mm
    with written_beside(target) as temporary:
        shutil.copyfile(source, temporary)
        with h5py.File(temporary, "r+") as file:
            entry = file[header.entry]
            there = schema.EXTRA in entry
            extra = entry[schema.EXTRA] if there else new_group(entry, schema.EXTRA, "NXcollection")
            _replace(extra, "detector_offset", np.array([offset_v_mm, offset_u_mm + shift_u_mm]))
            if table is not None:
                step = table[:, 6:9]
                table[:, 3:6] += shift_u_mm * step / np.linalg.norm(step, axis=1, keepdims=True)
                _replace(entry[schema.POSES], "pose", table)


def _replace(group: h5py.Group, name: str, values: np.ndarray) -> None:
    if name in group:
        del group[name]
    write_number(group, name, values, "mm")
