"""NIfTI, NRRD and MetaImage files, read by SimpleITK. Sizes in their headers are checked before the voxels are read."""

import gzip
import math
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.importers.reading.files import SafeFolder, check_room
from phyradgs_cl.io.files import HOST_SHARE, host_bytes, regular_file
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
_HEAD_BYTES, _BLOCK_BYTES = 1 << 16, 1 << 20
_NIFTI_START = 352  # the first byte of voxels
_OBLIQUE = 1e-3  # largest sine of an angle between an axis and the world's


def read_image(path: Path, state: int | None = None) -> Any:
    """Reads a SimpleITK image of three axes with one real number per voxel; ``state``: the place along a fourth axis.
    InputError: a damaged file, other axes or voxels, a size that the file cannot hold, data in a file outside of the folder,
    Hounsfield units."""
    subject = str(path)
    regular_file(path, subject)
    sitk, reader = _reader_of(path)
    available = _available_bytes(path)
    try:
        reader.ReadImageInformation()
        _check_header(sitk, subject, reader, available, state)
        return reader.Execute()
    except RuntimeError as error:
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


def _damage(subject: str, error: RuntimeError) -> InputError:
    reason = re.sub(r"^\w+\(0x\w+\): ", "", str(error).rpartition("ERROR: ")[2].strip()).replace(subject, "")[:100]
    return InputError(subject, f"a damaged file ({reason})", "an image of three axes")


def read_image_volume(path: Path, state: int | None = None) -> Volume:
    """Reads a volume with its axes turned to rise with the world's, which are LPS. A NRRD file without voxel sizes has no
    grid; its integers are divided by the maximum of their type. ``state``, InputError: see ``read_image``; oblique axes."""
    subject, image = str(path), read_image(path, state)
    sitk = checks.package("SimpleITK", "the package that reads this file", "phyradgs-cl[formats]")
    header = _text_header(path)[0] if _suffix(path) == ".nrrd" else {}
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


def _check_header(sitk: Any, subject: str, reader: Any, available: tuple[int, bool], state: int | None) -> None:
    """Refuses images without three axes or larger than their file: ``available`` is its bytes, and whether the image must
    fill them. Axes of one voxel beyond the third are dropped; ``state`` chooses along a longer fourth one."""
    (available_bytes, is_exact), counts, axes = available, reader.GetSize(), reader.GetDimension()
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
    if reader.HasMetaDataKey("vox_offset"):  # NIfTI, in which scaled integers come out as floats
        stored_bytes, start = int(reader.GetMetaData("bitpix")) // 8, float(reader.GetMetaData("vox_offset"))
        if not _NIFTI_START <= start <= available_bytes:
            raise InputError(f"{subject} vox_offset", f"{start:g}", f"a byte from {_NIFTI_START} on within the file")
        available_bytes -= int(start)
    needed = math.prod(counts) * stored_bytes
    if needed > available_bytes or (is_exact and needed != available_bytes):
        found = f"shape {counts}, {needed} bytes, in {available_bytes} bytes of data"
        raise InputError(subject, found, "as many bytes as its header announces", "copy the file again")
    check_room(subject, math.prod(counts[:3]) * voxel_bytes)


def _available_bytes(path: Path) -> tuple[int, bool]:
    """Returns how many bytes of voxels the file holds, unpacked, and whether the image must fill them; for NIfTI the header
    counts too. InputError: no header, Hounsfield units, damaged compression, data outside of the folder."""
    subject, is_packed = str(path), path.suffix.lower() == ".gz"
    if _suffix(path).startswith(".nii"):
        available_bytes = _inflated_bytes(path, 0) if is_packed else path.stat().st_size
        if available_bytes < _NIFTI_START:
            raise InputError(subject, f"{available_bytes} bytes", "a NIfTI-1 header and voxels")
        with gzip.open(path) if is_packed else open(path, "rb") as file:
            _refuse_hounsfield(subject, file.read(_NIFTI_START))
        return available_bytes, False
    header, start = _text_header(path)
    if _suffix(path) == ".nrrd":
        _check_nrrd(subject, header)
        is_packed = header.get("encoding", "").lower() in ("gzip", "gz")
        return (_inflated_bytes(path, start) if is_packed else path.stat().st_size - start), is_packed
    name, is_packed = header["ElementDataFile"], header.get("CompressedData", "").lower() in ("true", "1")
    if name != "LOCAL":
        if name.split(" ")[0] == "LIST" or "%" in name:
            raise InputError(f"{subject} ElementDataFile", name[:60], "LOCAL or one file name")
        path, start = SafeFolder(path.parent).file(name, f"{subject} ElementDataFile"), 0
    # MetaIO returns undefined voxels where compressed data are longer or shorter than the image
    return (_inflated_bytes(path, start) if is_packed else path.stat().st_size - start), is_packed


def _inflated_bytes(path: Path, start: int) -> int:
    """Counts the bytes that zlib or gzip data unpack to, block by block. The libraries do not report damage in them."""
    machine, count, most_bytes = zlib.decompressobj(wbits=47), 0, HOST_SHARE * host_bytes()
    try:
        with open(path, "rb") as file:
            file.seek(start)
            data = file.read(_BLOCK_BYTES)
            while data and count <= most_bytes:
                count += len(machine.decompress(data, _BLOCK_BYTES))
                rest = machine.unconsumed_tail
                if machine.eof:  # gzip files may have several members
                    machine, rest = zlib.decompressobj(wbits=47), machine.unused_data
                data = rest or file.read(_BLOCK_BYTES)
    except zlib.error as error:
        raise InputError(str(path), f"compressed data that are damaged ({error})", "zlib or gzip data") from error
    return count


def _refuse_hounsfield(subject: str, header: bytes) -> None:
    if b"values in HU" in header:
        raise InputError(subject, "Hounsfield units", "1/mm", "export it without --mu-water-per-mm")


def _text_header(path: Path) -> tuple[dict[str, str], int]:
    """Parses the header of a NRRD or MetaImage file; returns its fields and the position of the byte after it."""
    is_nrrd = _suffix(path) == ".nrrd"
    with open(path, "rb") as file:
        text = file.read(_HEAD_BYTES)
    _refuse_hounsfield(str(path), text)
    header: dict[str, str] = {}
    position = 0
    while (end := text.find(b"\n", position)) >= 0:
        key, sign, value = text[position:end].decode("latin-1").strip().partition(":" if is_nrrd else "=")
        position = end + 1
        if is_nrrd and not key:
            return header, position
        header[key.strip().lower() if is_nrrd else key.strip()] = value.strip()
        if not is_nrrd and (key.strip() == "ElementDataFile" or not sign):
            break
    if "ElementDataFile" not in header:
        expected = "a NRRD file with its data in it" if is_nrrd else "a MetaImage with its ElementDataFile"
        raise InputError(str(path), "no end of a header", expected)
    return header, position


def _check_nrrd(subject: str, header: dict[str, str]) -> None:
    for key in ("data file", "datafile", "line skip", "byte skip"):
        if header.get(key, "0") != "0":
            raise InputError(f"{subject} {key}", header[key][:40], "the data behind the header, in one file")
    if header.get("space", "").lower() not in _SPACES:
        expected = ", ".join(name for name in _SPACES if "-" in name)
        raise InputError(f"{subject} space", header["space"][:40], expected)
    _nrrd_unit_mm(subject, header)


def _nrrd_unit_mm(subject: str, header: dict[str, str]) -> float:
    """Returns the length of the header's unit, which SimpleITK does not read."""
    units = set(header.get("space units", '"mm"').replace('"', " ").split())
    factor = LENGTH.factor(units.pop()) if len(units) == 1 else None
    if factor is None:
        raise InputError(f"{subject} space units", header["space units"][:40], LENGTH.accepted)
    return factor
