"""Reads NIfTI, NRRD and MetaImage files by SimpleITK, and OME-Zarr 0.4 and 0.5 by zarr: one volume at full resolution, with
its voxel sizes and position.

Checks what SimpleITK passes over: missing voxels, data in another folder, notes of Hounsfield units, and NRRD's units."""

import gzip
import logging
import math
import os
import re
import shutil
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.fields.hounsfield import of_note
from phyradgs_cl.importers.files import SafeFolder, check_room
from phyradgs_cl.io.attenuation import PER_MM, VALUES
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.io.hdf5.datasets import LENGTH
from phyradgs_cl.io.volume import Volume, finite_float32, shares_of_maximum

_log = logging.getLogger(__name__)
STACKS = (".mha", ".mhd")
_SPACES = ("left-posterior-superior", "lps", "right-anterior-superior", "ras", "left-anterior-superior", "las", "")
_HEAD_BYTES = 1 << 16  # a header is read from this many bytes at the file's start
# Bytes of memory per voxel for which there must be room while a file is read: as much as two copies in float32.
_VOXEL_BYTES = 8
_NOTE = "ITK_FileNotes"  # SimpleITK's name for a file's comment, which is NIfTI's field descrip
_NRRD = (".nrrd", ".nhdr")
_READERS = {".nii": "Nifti", ".gz": "Nifti", ".mha": "Meta", ".mhd": "Meta", **dict.fromkeys(_NRRD, "Nrrd")}
_DATA_FILE = re.compile(rb"^(?:ElementDataFile *=|data ?file:) *(\S.*?)\s*$", re.M)
_LIKE = 1e-3  # relative difference up to which two statements of a voxel's size agree
_OBLIQUE = 1e-3  # an axis that is tilted by less than this (the sine of 0.06°) counts as straight


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Yields SimpleITK and its reader, which has read the file's header. Errors of SimpleITK become InputError."""
    subject = str(path)
    regular_file(path, subject)
    sitk = checks.package("SimpleITK", "the package that reads NIfTI, NRRD and MetaImage", "phyradgs-cl[formats]")
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    reader = sitk.ImageFileReader()
    reader.SetImageIO(f"{_READERS[path.suffix.lower()]}ImageIO")
    reader.SetFileName(subject)
    opened = ExitStack()
    if path.suffix.lower() == ".gz" and path.with_suffix("").exists():  # ITK would read NAME.nii in place of NAME.nii.gz
        reader.SetFileName(shutil.copy(path, opened.enter_context(TemporaryDirectory())))
    try:
        reader.ReadImageInformation()
        yield sitk, reader
    except (RuntimeError, EOFError, gzip.BadGzipFile, zlib.error) as error:
        text = str(error).rpartition("ERROR: ")[2].partition("Reason:")[0]  # "Reason:" begins an earlier error
        reason = re.sub(r"^\w+\(0x\w+\): ", "", text.strip()).replace(subject, "")[:100]
        raise InputError(subject, f"a damaged file ({reason})", "an image of three axes") from error
    finally:
        opened.close()


def image_times_s(path: Path) -> list[float]:
    """Returns the times in s of the volumes along a file's fourth axis; [] if the file has a single volume. Raises
    InputError for a damaged file."""
    with _opened(path) as (_, reader):
        count = reader.GetSize()[3] if reader.GetDimension() > 3 else 1
        return [reader.GetOrigin()[3] + k * reader.GetSpacing()[3] for k in range(count if count > 1 else 0)]


def read_image(path: Path, state: int | None = None) -> Any:
    """Reads an image of three axes, with one real number per voxel, as SimpleITK's image. state: which volume along a
    fourth axis; None for a file of three axes. Raises InputError for a damaged file, other axes or voxels, and voxels that
    are missing or in another folder."""
    subject = str(path)
    with _opened(path) as (sitk, reader):
        counts, axes = reader.GetSize(), reader.GetDimension()
        if axes < 3 or any(count != 1 for count in counts[3 if state is None else 4 :]):
            remedy = "'phyradgs info' reads volumes at several times" if axes == 4 else ""
            raise InputError(f"{subject}: shape", str(counts), "three axes, none of them empty", remedy)
        if axes > 3:
            reader.SetExtractSize([*counts[:3], *[0] * (axes - 3)])
            reader.SetExtractIndex([0, 0, 0, state or 0, *[0] * (axes - 4)])
        voxels = sitk.GetPixelIDValueAsString(reader.GetPixelIDValue())
        if reader.GetNumberOfComponents() != 1 or "complex" in voxels:
            raise InputError(f"{subject}: voxels", voxels, "plain real numbers")
        check_room(subject, math.prod(counts[:3]) * _VOXEL_BYTES)
        voxel_bytes = sitk.Image([1, 1, 1], reader.GetPixelIDValue()).GetSizeOfPixelComponent()
        held, needed = _held_bytes(path, reader, voxel_bytes), math.prod(counts) * voxel_bytes
        if held is not None and held < needed:
            raise InputError(subject, f"{held} bytes of data", f"{needed}, as its header says", "copy the file again")
        return reader.Execute()


def _held_bytes(path: Path, reader: Any, voxel_bytes: int) -> int | None:
    """Returns how many bytes of voxels a file holds when unpacked, or None for NRRD, which SimpleITK checks. In NIfTI
    without some voxels and damaged packed MetaImages, SimpleITK invents values and raises no error. Raises InputError for
    data outside the folder or in several files."""
    with gzip.open(path) if path.suffix.lower() == ".gz" else open(path, "rb") as file:
        head = file.read(_HEAD_BYTES)
        if reader.HasMetaDataKey("bitpix"):  # NIfTI: SimpleITK turns scaled integers into floats of another size
            stored = file.seek(0, os.SEEK_END) - int(float(reader.GetMetaData("vox_offset")))
            return stored * voxel_bytes * 8 // int(reader.GetMetaData("bitpix"))
    is_nrrd = path.suffix.lower() in _NRRD
    found = _DATA_FILE.search(head)
    name, start = (found[1].decode("latin-1"), head.find(b"\n", found.end(1)) + 1) if found else ("LOCAL", 0)
    if name.startswith("LIST") or "%" in name:  # several files: SimpleITK returns undefined voxels if one is missing
        raise InputError(f"{path} data file", name[:60], "LOCAL or one file name", "write it as one file")
    if name != "LOCAL":
        path, start = SafeFolder(path.parent).file(name, f"{path} data file"), 0
    if not re.search(rb"^CompressedData *= *True", head, re.I | re.M):
        return None if is_nrrd else path.stat().st_size - start
    if not re.search(rb"^CompressedDataSize *= *\d", head, re.M):  # without the size SimpleITK returns undefined voxels
        raise InputError(f"{path} CompressedDataSize", "nothing", "the bytes of packed voxels", "write it unpacked")
    return len(zlib.decompress(path.read_bytes()[start:]))


def read_image_volume(path: Path, state: int | None = None) -> Volume:
    """Reads a volume (z, y, x) float32 whose axes point as the world's do (LPS). A NRRD file without voxel sizes has no
    grid, and its integers are divided by the maximum of their type. state: see ``read_image``. Raises InputError as
    ``read_image`` does, and for oblique axes, unknown units and impossible sizes."""
    subject, image = str(path), read_image(path, state)
    note = image.GetMetaData(_NOTE) if image.HasMetaDataKey(_NOTE) else ""
    sitk = checks.package("SimpleITK", "the package that reads this file", "phyradgs-cl[formats]")
    header = _nrrd_header(path) if path.suffix.lower() in _NRRD else {}
    if header and not {"space directions", "spacings"} & set(header):
        return Volume(finite_float32(subject, shares_of_maximum(sitk.GetArrayFromImage(image))), None)
    units = set(header.get("space units", '"mm"').replace('"', " ").split())
    if len(units) != 1 or (unit_mm := LENGTH.factor(*units)) is None:
        raise InputError(f"{subject} space units", header["space units"][:40], LENGTH.accepted)
    _resize_by_sform(subject, image)
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
    grid = Grid(triple(values.shape), triple(size_mm[::-1].tolist()), triple(centre_mm[::-1].tolist()))
    return Volume(values, grid, {VALUES: note} if PER_MM in note or of_note(note)[0] else {})


def _resize_by_sform(subject: str, image: Any) -> None:
    """Gives a NIfTI image the voxel sizes of its sform, if only the sform states its place: SimpleITK always takes the sizes
    of pixdim, which belong to the qform. Raises InputError where sform and qform are both stated and differ."""
    codes = {form: float(image.GetMetaData(key)) for form in "sq" if image.HasMetaDataKey(key := f"{form}form_code")}
    if codes.get("s", 0) <= 0:
        return
    rows = [image.GetMetaData(f"srow_{axis}").split()[:3] for axis in "xyz"]
    sides = np.linalg.norm(np.array(rows, np.float64), axis=0)
    stated = np.array([float(image.GetMetaData(f"pixdim[{axis}]")) for axis in (1, 2, 3)])
    if np.allclose(sides, stated, rtol=_LIKE, atol=0):
        return
    if codes.get("q", 0) > 0:
        found = f"{sides.round(6).tolist()} by the sform and {stated.round(6).tolist()} by the qform (x, y, z)"
        remedy = "set the code of the wrong one to 0, as nibabel's set_qform(None, 0)"
        raise InputError(f"{subject}: voxel sizes", found, "one size", remedy)
    image.SetSpacing((np.array(image.GetSpacing()) * sides / stated).tolist())


def _nrrd_header(path: Path) -> dict[str, str]:
    """Reads the header of a NRRD file, of which SimpleITK shows only a part. Raises InputError for an unknown space."""
    with open(path, "rb") as file:
        lines = file.read(_HEAD_BYTES).split(b"\n\n")[0].decode("latin-1").splitlines()
    header = {key.strip().lower(): value.strip() for key, sign, value in (line.partition(":") for line in lines) if sign}
    if header.get("space", "").lower() not in _SPACES:
        raise InputError(f"{path} space", header["space"][:40], ", ".join(_SPACES[:-1]))
    return header


def read_zarr(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, str]:
    """Returns values (z, y, x) in their own type, a voxel's sizes (3,) and the first voxel's centre (3,), both (z, y, x) in
    mm, and the folder's note on its values. Sizes and centre are None, with a warning, if an axis has no unit of length, a
    number is not finite, or a size is not above 0. Raises InputError for anything but an OME-Zarr of real numbers, for
    damage, several times or channels, and for more than the machine's memory."""
    subject = str(path)
    zarr = checks.package("zarr", "the package that reads OME-Zarr", "phyradgs-cl[zarr]")
    try:
        group = zarr.open_group(subject, mode="r")
        facts: Any = group.attrs.get("ome", group.attrs)["multiscales"][0]
        array = group[facts["datasets"][0]["path"]]
        units = {axis["name"]: LENGTH.factor(str(axis.get("unit"))) for axis in facts["axes"]}
        order = [list(units).index(name) for name in "zyx"]
        sizes, first = np.ones(array.ndim), np.zeros(array.ndim)  # a voxel's, and the first one's centre, in the axes' units
        for change in (*facts["datasets"][0]["coordinateTransformations"], *facts.get("coordinateTransformations", ())):
            if change["type"] not in ("scale", "translation"):
                raise ValueError(f"transformation {change['type']}")
            by = np.asarray(change[change["type"]], np.float64)
            sizes, first = (sizes * by, first * by) if change["type"] == "scale" else (sizes, first + by)
        shape = [array.shape[axis] for axis in order]
        if array.dtype.kind not in "iuf" or len(units) != array.ndim or not 0 < math.prod(shape) == array.size:
            raise ValueError(f"axes {', '.join(units)} of {array.shape} voxels, {array.dtype}")
        check_room(subject, max(array.size, math.prod(array.chunks)) * max(array.dtype.itemsize, 4))
        if missing := math.prod(array.cdata_shape) - array.nchunks_initialized:
            _log.warning("%s: %d chunks are missing and read as %s: were they lost?", path, missing, array.fill_value)
        values = np.moveaxis(np.asarray(array[...]), order, (-3, -2, -1)).reshape(shape)
        note = str((facts.get("metadata") or {}).get("values", ""))
    except InputError:
        raise
    except Exception as error:  # zarr and its stores raise errors of every kind
        found = f"{type(error).__name__}: {str(error)[:150]}"
        raise InputError(subject, found, "an OME-Zarr with real numbers of one volume along z, y and x") from error
    in_mm = np.array([units[name] for name in "zyx"], np.float64)  # units that are None become NaN
    size_mm, first_mm = sizes[order] * in_mm, first[order] * in_mm
    if not (np.isfinite([size_mm, first_mm]).all() and size_mm.min() > 0):
        _log.warning("%s: its axes have no sizes in a unit of length: the scale is left out", path)
        return values, None, None, note
    return values, size_mm, first_mm, note
