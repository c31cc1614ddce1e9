"""NRRD volumes (.nrrd) with their data in the same file: https://teem.sourceforge.net/nrrd/format.html"""

import re
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.bounded import read_head, read_raw
from phyradgs_cl.importers.reading.voxels import RAS, Voxels, header_numbers
from phyradgs_cl.io.hdf5.datasets import LENGTH

_NAMES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_TYPES = {name: code for code, names in _NAMES.items() for name in names}
_LAS = np.array([1.0, -1.0, 1.0])
_SPACES = {
    **dict.fromkeys(("", "left-posterior-superior", "lps"), np.ones(3)),
    **dict.fromkeys(("right-anterior-superior", "ras"), RAS),
    **dict.fromkeys(("left-anterior-superior", "las"), _LAS),
}


def read_nrrd(path: Path) -> Voxels:
    """An image of three axes; without "space directions" or "spacings" it is bare."""
    subject = str(path)
    header, start = _header(path)
    for key, accepted in (("dimension", ("3",)), ("encoding", ("raw", "gzip", "gz"))):
        if header.get(key, "").lower() not in accepted:
            raise InputError(f"{subject} {key}", header.get(key, "nothing")[:40], " or ".join(accepted))
    for key in ("data file", "datafile", "line skip", "byte skip"):
        if header.get(key, "0") != "0":
            raise InputError(f"{subject} {key}", header[key][:40], "the data behind the header, in one file")
    kind = header.get("type", "").lower()
    if kind not in _TYPES:
        raise InputError(f"{subject} type", kind[:40] or "nothing", "plain real numbers")
    dtype = np.dtype(_TYPES[kind]).newbyteorder(">" if header.get("endian", "").lower() == "big" else "<")
    shape = tuple(int(n) for n in header_numbers(subject, header, "sizes", 3)[::-1])
    values = read_raw(path, start, shape, dtype, header["encoding"].lower() != "raw")
    return Voxels(values, *_frame(subject, header), header.get("content", ""))


def _frame(subject: str, header: dict[str, str]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Steps (3, 3), one row per axis, and the place (3,) of voxel (0, 0, 0) in LPS mm, where the header has them."""
    space = header.get("space", "").lower()
    if space not in _SPACES:
        raise InputError(f"{subject} space", space[:40], ", ".join(name for name in _SPACES if "-" in name))
    unit = header.get("space units", '"mm"').replace('"', " ").split()
    factor = LENGTH.factor(unit[0]) if len(set(unit)) == 1 else None
    if factor is None:
        raise InputError(f"{subject} space units", header["space units"][:40], LENGTH.accepted)
    to_lps = _SPACES[space] * factor
    origin = header_numbers(subject, header, "space origin", 3) * to_lps if "space origin" in header else None
    if "space directions" in header:
        return header_numbers(subject, header, "space directions", 9).reshape(3, 3) * to_lps, origin
    return (np.diag(header_numbers(subject, header, "spacings", 3)) if "spacings" in header else None), origin


def _header(path: Path) -> tuple[dict[str, str], int]:
    text = read_head(path)
    end = re.search(rb"\r?\n\r?\n", text)
    if not re.match(rb"NRRD000\d\r?\n", text) or end is None:
        raise InputError(str(path), "no header of NRRD", "a NRRD file with its data in it")
    lines = text[: end.start()].decode("latin-1").splitlines()[1:]
    fields = (line.partition(":") for line in lines if not line.startswith("#"))
    return {name.strip().lower(): value.strip() for name, _, value in fields}, end.end()
