"""NIfTI, NRRD and MetaImage files, read by SimpleITK, with what it does not see: Hounsfield units, units of NRRD."""

import gzip
import math
import os
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.importers.reading.files import SafeFolder, check_room
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.io.hdf5.datasets import LENGTH
from phyradgs_cl.io.volume import Volume, finite_float32, shares_of_maximum

STACKS = (".mha", ".mhd")
_READERS = {
    **dict.fromkeys((".nii", ".nii.gz"), "NiftiImageIO"),
    **dict.fromkeys(STACKS, "MetaImageIO"),
    ".nrrd": "NrrdImageIO",
}
_BYTES = {"Int8": 1, "UInt8": 1, "Int16": 2, "UInt16": 2, "Int32": 4, "UInt32": 4, "Float32": 4}
_BYTES |= {"Int64": 8, "UInt64": 8, "Float64": 8}
_SPACES = ("left-posterior-superior", "lps", "right-anterior-superior", "ras", "left-anterior-superior", "las", "")
_HEAD_BYTES = 1 << 16
_DATA_FILE = re.compile(rb"^(?:ElementDataFile *=|data ?file:) *(\S.*?)\s*$", re.M)
_OBLIQUE = 1e-3  # largest sine of an angle between an axis and the world's


def read_image(path: Path, state: int | None = None) -> Any:
    """Reads a SimpleITK image of three axes with one real number per voxel; ``state``: the place along a fourth axis.
    InputError: a damaged file, other axes or voxels, a size that the file cannot hold, data in a file outside of the folder,
    Hounsfield units."""
    subject = str(path)
    regular_file(path, subject)
    sitk, reader = _reader_of(path)
    try:
        reader.ReadImageInformation()
        _check_header(sitk, subject, reader, _voxel_bytes(path, reader), state)
        return reader.Execute()
    except (RuntimeError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise _damage(subject, error) from error


def image_times_s(path: Path) -> list[float]:
    """Returns the times of the volumes along the fourth axis of a file; [] for three axes. InputError: a damaged file."""
    regular_file(path, str(path))
    _, reader = _reader_of(path)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise _damage(str(path), error) from error
    if reader.GetDimension() < 4 or reader.GetSize()[3] == 1:
        return []
    return [reader.GetOrigin()[3] + k * reader.GetSpacing()[3] for k in range(reader.GetSize()[3])]


def _reader_of(path: Path) -> tuple[Any, Any]:
    """Returns SimpleITK and its reader of a file."""
    sitk = checks.package("SimpleITK", "the package that reads NIfTI, NRRD and MetaImage", "phyradgs-cl[formats]")
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO(_READERS[_suffix(path)])
    return sitk, reader


def _damage(subject: str, error: Exception) -> InputError:
    reason = re.sub(r"^\w+\(0x\w+\): ", "", str(error).rpartition("ERROR: ")[2].strip()).replace(subject, "")[:100]
    return InputError(subject, f"a damaged file ({reason})", "an image of three axes")


def read_image_volume(path: Path, state: int | None = None) -> Volume:
    """Reads a volume with its axes turned to rise with the world's, which are LPS. A NRRD file without voxel sizes has no
    grid; its integers are divided by the maximum of their type. ``state``, InputError: see ``read_image``; oblique axes."""
    subject, image = str(path), read_image(path, state)
    sitk = checks.package("SimpleITK", "the package that reads this file", "phyradgs-cl[formats]")
    header = _nrrd_header(path) if _suffix(path) == ".nrrd" else {}
    if header and not {"space directions", "spacings"} & set(header):
        return Volume(finite_float32(subject, shares_of_maximum(sitk.GetArrayFromImage(image))), None)
    unit_mm = _nrrd_unit_mm(subject, header)
    image = sitk.DICOMOrient(image, "LPS")
    if not np.allclose(np.reshape(image.GetDirection(), (3, 3)), np.eye(3), rtol=0, atol=_OBLIQUE):
        found = f"directions {np.round(image.GetDirection(), 4).tolist()}"
        raise InputError(subject, found, "axes along the world's", "resample it onto such a grid")
    size_mm = unit_mm * np.array(image.GetSpacing())
    for size in size_mm:
        checks.within(f"{subject}: voxel size (mm)", float(size), 1 / LENGTH.largest, LENGTH.largest)
    centre_mm = np.zeros(3)
    if not header or "space origin" in header:
        middle = [(count - 1) / 2 for count in image.GetSize()]
        centre_mm = unit_mm * np.array(image.TransformContinuousIndexToPhysicalPoint(middle))
    if not np.all(np.abs(centre_mm) <= LENGTH.largest):
        raise InputError(f"{subject}: origin", str(list(image.GetOrigin()))[:80], "three lengths in mm")
    values = finite_float32(subject, sitk.GetArrayFromImage(image))
    return Volume(values, Grid(triple(values.shape), triple(size_mm[::-1].tolist()), triple(centre_mm[::-1].tolist())))


def _suffix(path: Path) -> str:
    return next(suffix for suffix in _READERS if path.name.lower().endswith(suffix))


def _check_header(sitk: Any, subject: str, reader: Any, file_bytes: int | None, state: int | None) -> None:
    """Refuses images without three axes, or larger than the ``file_bytes`` of their voxels (None: unknown). Axes of one
    voxel beyond the third are dropped; ``state`` chooses along a longer fourth one."""
    counts, axes = reader.GetSize(), reader.GetDimension()
    if axes < 3 or any(count != 1 for count in counts[3 if state is None else 4 :]) or min(counts) < 1:
        remedy = "'phyradgs info' reads volumes at several times" if axes == 4 else ""
        raise InputError(f"{subject}: shape", str(counts), "three axes, none of them empty", remedy)
    if axes > 3:
        reader.SetExtractSize([*counts[:3], *[0] * (axes - 3)])
        reader.SetExtractIndex([0, 0, 0, state or 0, *[0] * (axes - 4)])
    bytes_of = {getattr(sitk, f"sitk{name}"): size for name, size in _BYTES.items()}
    voxel_bytes = bytes_of.get(reader.GetPixelIDValue())
    if voxel_bytes is None or reader.GetNumberOfComponents() != 1:
        found = sitk.GetPixelIDValueAsString(reader.GetPixelIDValue())
        raise InputError(f"{subject}: voxels", found, "plain real numbers")
    stored_bytes = voxel_bytes
    if reader.HasMetaDataKey("bitpix"):  # NIfTI, in which scaled integers come out as floats
        stored_bytes = int(reader.GetMetaData("bitpix")) // 8
    needed = math.prod(counts) * stored_bytes
    if file_bytes is not None and needed > file_bytes:
        found = f"shape {counts}, {needed} bytes, in {file_bytes} bytes of data"
        raise InputError(subject, found, "as many bytes as its header announces", "copy the file again")
    check_room(subject, math.prod(counts[:3]) * voxel_bytes)


def _voxel_bytes(path: Path, reader: Any) -> int | None:
    """Returns how many bytes of voxels a file holds, unpacked: SimpleITK fills missing or damaged ones without an error, in
    NIfTI and in packed MetaImages. None where it refuses them. InputError: Hounsfield units, data outside of the folder."""
    is_nifti = _suffix(path).startswith(".nii")
    with gzip.open(path) if path.suffix.lower() == ".gz" else open(path, "rb") as file:
        head = file.read(_HEAD_BYTES)
        if b"values in HU" in head:
            raise InputError(str(path), "Hounsfield units", "1/mm", "export it without --mu-water-per-mm")
        if is_nifti:
            return file.seek(0, os.SEEK_END) - int(float(reader.GetMetaData("vox_offset")))
    found = _DATA_FILE.search(head)
    name, start = (found[1].decode("latin-1"), head.find(b"\n", found.end(1)) + 1) if found else ("LOCAL", 0)
    if name.startswith("LIST") or "%" in name:  # SimpleITK returns undefined voxels where one file is missing
        raise InputError(f"{path} data file", name[:60], "LOCAL or one file name", "write it as one file")
    is_nrrd = _suffix(path) == ".nrrd"
    if name != "LOCAL":
        path, start = SafeFolder(path.parent).file(name, f"{path} data file"), 0
    if is_nrrd:
        return None
    if not re.search(rb"^CompressedData *= *True", head, re.I | re.M):
        return path.stat().st_size - start
    if not re.search(rb"^CompressedDataSize *= *\d", head, re.M):  # SimpleITK returns undefined voxels then
        raise InputError(f"{path} CompressedDataSize", "nothing", "the bytes of packed voxels", "write it unpacked")
    return _unpacked_bytes(path, start)


def _unpacked_bytes(path: Path, start: int) -> int:
    """Returns how many bytes the deflated data of a file hold from the byte ``start`` on."""
    machine, count = zlib.decompressobj(), 0
    with open(path, "rb") as file:
        file.seek(start)
        while not machine.eof and (part := file.read(_HEAD_BYTES)):
            count += len(machine.decompress(part))
    return count


def _nrrd_header(path: Path) -> dict[str, str]:
    """Returns the fields of a NRRD file, of which SimpleITK shows only some."""
    with open(path, "rb") as file:
        lines = file.read(_HEAD_BYTES).split(b"\n\n")[0].decode("latin-1").splitlines()
    fields = (line.partition(":") for line in lines)
    header = {key.strip().lower(): value.strip() for key, sign, value in fields if sign}
    if header.get("space", "").lower() not in _SPACES:
        expected = ", ".join(name for name in _SPACES if "-" in name)
        raise InputError(f"{path} space", header["space"][:40], expected)
    return header


def _nrrd_unit_mm(subject: str, header: dict[str, str]) -> float:
    """Returns the length of the header's unit, which SimpleITK does not read."""
    units = set(header.get("space units", '"mm"').replace('"', " ").split())
    factor = LENGTH.factor(units.pop()) if len(units) == 1 else None
    if factor is None:
        raise InputError(f"{subject} space units", header["space units"][:40], LENGTH.accepted)
    return factor
