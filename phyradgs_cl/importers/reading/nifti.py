"""NIfTI-1 volumes (.nii, .nii.gz)."""

import gzip
import math
import zlib
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.bounded import MOST_INFLATION, check_array
from phyradgs_cl.importers.reading.voxels import RAS, Voxels
from phyradgs_cl.io.nifti_header import HEADER, VOXELS_AT
from phyradgs_cl.io.regular import regular_file

_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
_UNITS_MM = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}  # of xyzt_units: not said, m, mm, µm
_MOST_EXTENSION = 1 << 24


def read_nifti(path: Path) -> Voxels:
    """An image of three axes; its frame is that of sform, else of qform."""
    subject = str(path)
    size = regular_file(path, subject).st_size
    packed = path.suffix.lower() == ".gz"
    try:
        with gzip.open(path) if packed else open(path, "rb") as file:
            head = _header(subject, file.read(HEADER.itemsize))
            start, shape, dtype = _layout(subject, head)
            available = size * MOST_INFLATION if packed else size - start
            check_array(subject, shape, dtype, available, 3)
            file.seek(start)
            data = file.read(math.prod(shape) * dtype.itemsize)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(subject, f"data that cannot be read ({error})", "a NIfTI-1 file") from error
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise InputError(subject, f"{len(data)} bytes of voxels", f"{math.prod(shape) * dtype.itemsize}")
    values = np.frombuffer(data, dtype).reshape(shape)
    slope, shift = float(head["scl_slope"]), float(head["scl_inter"])
    if slope not in (0.0, 1.0) or (slope and shift):
        values = values * slope + shift
    steps, origin = _frame(head)
    unit_mm = _UNITS_MM.get(int(head["xyzt_units"]) & 7, 1.0)
    note = bytes(head["descrip"]).decode("latin-1")
    return Voxels(values, steps * RAS * unit_mm, origin * RAS * unit_mm, note)


def _header(subject: str, text: bytes) -> np.void:
    """The header in the byte order in which it says how long it is."""
    for stored in (HEADER.newbyteorder("<"), HEADER.newbyteorder(">")):
        if len(text) == HEADER.itemsize:
            head = np.frombuffer(text, stored)[0]
            if head["sizeof_hdr"] == HEADER.itemsize and head["magic"] == b"n+1":
                return head
    raise InputError(subject, "no header of NIfTI-1", "a single-file NIfTI-1 image (.nii, .nii.gz)")


def _layout(subject: str, head: np.void) -> tuple[int, tuple[int, ...], np.dtype]:
    """Where the voxels begin, their shape (k, j, i) and type."""
    axes, counts = int(head["dim"][0]), head["dim"][1:].tolist()
    if not 3 <= axes <= 7 or any(n != 1 for n in counts[3:axes]):
        raise InputError(f"{subject} dim", str(head["dim"].tolist()), "three axes")
    code, start = int(head["datatype"]), float(head["vox_offset"])
    if code not in _TYPES:
        raise InputError(f"{subject} datatype", str(code), "plain real numbers")
    if not VOXELS_AT <= start <= _MOST_EXTENSION:
        raise InputError(f"{subject} vox_offset", f"{start:g}", f"{VOXELS_AT} to {_MOST_EXTENSION}")
    return int(start), tuple(counts[2::-1]), np.dtype(_TYPES[code]).newbyteorder(head.dtype["dim"].base.byteorder)


def _frame(head: np.void) -> tuple[np.ndarray, np.ndarray]:
    """Steps (3, 3), one row per axis, and the place (3,) of voxel (0, 0, 0), in RAS."""
    if head["sform_code"] > 0:
        matrix = head["srow"].astype(np.float64)
        return matrix[:, :3].T, matrix[:, 3]
    b, c, d = head["quatern"].astype(np.float64)
    a = math.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))
    turn = np.array([
        [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
    ])  # fmt: skip
    sizes = head["pixdim"][1:4] * np.array([1, 1, -1 if head["pixdim"][0] < 0 else 1])
    return (turn * sizes).T, head["qoffset"].astype(np.float64)
