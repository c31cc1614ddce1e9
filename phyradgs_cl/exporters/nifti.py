"""NIfTI-1 (.nii, .nii.gz): a header of 348 bytes, whose frame is RAS, then voxels with x running fastest.

The header is that of https://nifti.nimh.nih.gov/nifti-1 (nifti1.h).
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters.placed import Placed
from phyradgs_cl.io import written_beside

_LARGEST = 32_767
_FLOAT32, _MILLIMETRES, _SCANNER = 16, 2, 1
_VOXELS_AT = 352  # the header and four bytes that say: no extension
_HEADER = np.dtype([
    ("sizeof_hdr", "<i4"), ("unused_1", "V35"), ("dim_info", "u1"), ("dim", "<i2", 8), ("intent_p", "<f4", 3),
    ("intent_code", "<i2"), ("datatype", "<i2"), ("bitpix", "<i2"), ("slice_start", "<i2"), ("pixdim", "<f4", 8),
    ("vox_offset", "<f4"), ("scl_slope", "<f4"), ("scl_inter", "<f4"), ("slice_end", "<i2"), ("slice_code", "u1"),
    ("xyzt_units", "u1"), ("cal_max", "<f4"), ("cal_min", "<f4"), ("slice_duration", "<f4"), ("toffset", "<f4"),
    ("unused_2", "V8"), ("descrip", "S80"), ("aux_file", "S24"), ("qform_code", "<i2"), ("sform_code", "<i2"),
    ("quatern", "<f4", 3), ("qoffset", "<f4", 3), ("srow", "<f4", (3, 4)), ("intent_name", "S16"), ("magic", "S4"),
])  # fmt: skip


def write_nifti(path: Path, volume: Placed) -> None:
    """One file, compressed if its name ends in .gz."""
    if max(volume.shape_xyz) > _LARGEST:
        raise InputError(
            "--to nii", f"{max(volume.shape_xyz)} voxels", f"at most {_LARGEST}", "use --to nrrd"
        )
    head = header(volume).tobytes() + bytes(_VOXELS_AT - _HEADER.itemsize)
    data = memoryview(volume.values.astype("<f4", copy=False)).cast("B")
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        if path.suffix.lower() == ".gz":
            with gzip.GzipFile(
                "", "wb", 4, file, mtime=0
            ) as packed:  # no name, no time: the same bytes again
                packed.write(head)
                packed.write(data)
        else:
            file.write(head)
            file.write(data)


def header(volume: Placed) -> np.ndarray:
    """The header (1,): LPS becomes RAS by half a turn about z, in both of the ways in which NIfTI says it."""
    (dx, dy, dz), (x, y, z) = volume.spacing_mm, volume.origin_mm
    head = np.zeros(1, _HEADER)
    head["sizeof_hdr"], head["magic"] = _HEADER.itemsize, b"n+1"
    head["dim"] = (3, *volume.shape_xyz, 1, 1, 1, 1)
    head["pixdim"] = (1, dx, dy, dz, 0, 0, 0, 0)
    head["datatype"], head["bitpix"], head["vox_offset"] = _FLOAT32, 32, _VOXELS_AT
    head["scl_slope"], head["xyzt_units"] = 1, _MILLIMETRES
    head["descrip"] = f"values in {volume.unit}".encode()
    head["qform_code"] = head["sform_code"] = _SCANNER
    head["quatern"], head["qoffset"] = (0, 0, 1), (-x, -y, z)
    head["srow"] = [[(-dx, 0, 0, -x), (0, -dy, 0, -y), (0, 0, dz, z)]]
    return head
