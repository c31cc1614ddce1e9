"""MetaImage (.mha, .mhd), volumes and stacks of projections: a text, then voxels, raw or deflated, here or beside."""

from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.reading.bounded import read_head, read_raw
from phyradgs_cl.importers.reading.folder import SafeFolder
from phyradgs_cl.importers.reading.voxels import Voxels, header_numbers

SUFFIXES = (".mha", ".mhd")
_NAMES = ("CHAR", "UCHAR", "SHORT", "USHORT", "INT", "UINT", "LONG_LONG", "ULONG_LONG", "FLOAT", "DOUBLE")
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
_TYPES = {f"MET_{name}": code for name, code in zip(_NAMES, _CODES, strict=True)}


def read_meta_stack(path: Path) -> Voxels:
    """A stack of projections (F, v, u), third axis the frames, which must lie on top of each other; u, v are its x, y."""
    image = read_meta_image(path)
    step = image.steps_mm
    assert step is not None  # every MetaImage has them
    if np.abs(step[:2, 2]).max() + np.abs(step[2, :2]).max() > 1e-9 * np.abs(step).max():
        found = str(step.tolist())[:80]
        raise InputError(f"{path} TransformMatrix", found, "axes of a stack: columns, rows, frames")
    return image


def read_meta_image(path: Path) -> Voxels:
    """An image of three axes."""
    header, start = _header(path)
    subject = str(path)
    if header.get("NDims") != "3":
        raise InputError(f"{subject} NDims", header.get("NDims", "nothing"), "3 axes")
    if header.get("ElementNumberOfChannels", "1") != "1":
        raise InputError(f"{subject} ElementNumberOfChannels", header["ElementNumberOfChannels"], "1")
    shape = tuple(int(n) for n in header_numbers(subject, header, "DimSize", 3)[::-1])
    word = header.get("ElementType", "nothing")
    if word not in _TYPES:
        raise InputError(f"{subject} ElementType", word[:40], ", ".join(_TYPES))
    orders = [header[key] for key in ("BinaryDataByteOrderMSB", "ElementByteOrderMSB") if key in header]
    big = orders[:1] and orders[0] in ("True", "true", "1")
    dtype = np.dtype(_TYPES[word]).newbyteorder(">" if big else "<")
    values = _voxels(path, header, start, shape, dtype)
    spacing = header_numbers(subject, header, "ElementSpacing", 3, "1 1 1")
    if spacing.min() <= 0:
        raise InputError(f"{subject} ElementSpacing", str(spacing.tolist()), "lengths above 0")
    places = [key for key in ("Offset", "Position", "Origin") if key in header]
    origin = header_numbers(subject, header, places[0] if places else "Offset", 3, "0 0 0")
    steps = spacing[:, None] * _axes(subject, header)
    return Voxels(values, steps, origin, header.get("Comment", ""))


def _axes(subject: str, header: dict[str, str]) -> np.ndarray:
    keys = [key for key in ("TransformMatrix", "Rotation", "Orientation") if key in header]
    key = keys[0] if keys else "TransformMatrix"
    axes = header_numbers(subject, header, key, 9, "1 0 0 0 1 0 0 0 1").reshape(3, 3)
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-6):
        raise InputError(f"{subject} {key}", str(axes.tolist())[:80], "three directions at right angles")
    return axes


def _header(path: Path) -> tuple[dict[str, str], int]:
    text = read_head(path)
    header: dict[str, str] = {}
    position = 0
    while (end := text.find(b"\n", position)) >= 0:
        key, sign, value = text[position:end].decode("latin-1").partition("=")
        if not sign:
            break
        header[key.strip()] = value.strip()
        position = end + 1
        if key.strip() == "ElementDataFile":
            return header, position
    raise InputError(str(path), "no ElementDataFile in its header", "a MetaImage (.mha or .mhd)")


def _voxels(
    path: Path, header: dict[str, str], start: int, shape: tuple[int, ...], dtype: np.dtype
) -> np.ndarray:
    data_path, name = path, header["ElementDataFile"]
    if name != "LOCAL":
        if name.split(" ")[0] == "LIST" or "%" in name:
            raise InputError(f"{path} ElementDataFile", name[:60], "LOCAL or one file name")
        data_path, start = SafeFolder(path.parent).file(name, f"{path} ElementDataFile"), 0
    if header.get("HeaderSize", "0") not in ("0", "-1"):
        raise InputError(f"{path} HeaderSize", header["HeaderSize"][:20], "0")
    packed = header.get("CompressedData", "False").lower() in ("true", "1")
    return read_raw(data_path, start, shape, dtype, packed)
