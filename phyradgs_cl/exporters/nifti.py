"""NIfTI-1 (.nii, .nii.gz): a header of 348 bytes, whose frame is RAS, then voxels with x running fastest."""

import gzip
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters.placed import Placed
from phyradgs_cl.io import written_beside
from phyradgs_cl.io.nifti_header import HEADER, VOXELS_AT

_LARGEST = 32_767
_FLOAT32, _MILLIMETRES, _SCANNER = 16, 2, 1


def write_nifti(path: Path, volume: Placed) -> None:
    """One file, compressed if its name ends in .gz."""
    if max(volume.shape_xyz) > _LARGEST:
        found = f"{max(volume.shape_xyz)} voxels"
        raise InputError("--to nii", found, f"at most {_LARGEST}", "use --to nrrd")
    head = header(volume).tobytes() + bytes(VOXELS_AT - HEADER.itemsize)
    data = volume.values.astype("<f4", copy=False).data.cast("B")
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        if path.suffix.lower() == ".gz":
            with gzip.GzipFile("", "wb", 4, file, mtime=0) as packed:  # no name, no time: the same bytes again
                packed.write(head)
                packed.write(data)
        else:
            file.write(head)
            file.write(data)


def header(volume: Placed) -> np.ndarray:
    """The header (1,): LPS becomes RAS by half a turn about z, in both of the ways in which NIfTI says it."""
    (dx, dy, dz), (x, y, z) = volume.spacing_mm, volume.origin_mm
    head = np.zeros(1, HEADER)
    head["sizeof_hdr"], head["magic"] = HEADER.itemsize, b"n+1"
    head["dim"] = (3, *volume.shape_xyz, 1, 1, 1, 1)
    head["pixdim"] = (1, dx, dy, dz, 0, 0, 0, 0)
    head["datatype"], head["bitpix"], head["vox_offset"] = _FLOAT32, 32, VOXELS_AT
    head["scl_slope"], head["xyzt_units"] = 1, _MILLIMETRES
    head["descrip"] = f"values in {volume.unit}".encode()
    head["qform_code"] = head["sform_code"] = _SCANNER
    head["quatern"], head["qoffset"] = (0, 0, 1), (-x, -y, z)
    head["srow"] = [[(-dx, 0, 0, -x), (0, -dy, 0, -y), (0, 0, dz, z)]]
    return head
