"""Writes a DICOM series of CT images (PS3.3, A.3 and C.8.2), one per slice, with 16 bits, in HU or 1/mm."""

import datetime
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.hounsfield import of_note
from phyradgs_cl.io.output import temporary_name
from phyradgs_cl.io.volume import Volume

_CT_IMAGE = "1.2.840.10008.5.1.4.1.1.2"
_EXPLICIT_LITTLE = "1.2.840.10008.1.2.1"
_LARGEST = 32_767  # largest signed number of 16 bits
_LONGEST = 64  # DICOM's limit in characters for names (PN) and descriptions (LO)


@dataclass(frozen=True)
class DicomLabels:
    """Labels by which viewers and archives list a series; None leaves the usual text. patient: name (Family^Given) and ID.
    title, date (YYYY-MM-DD): the study's. description: the series'. Raises InputError for text that DICOM cannot hold, and
    for a date in another form."""

    patient: str | None = None
    title: str | None = None
    description: str | None = None
    date: str | None = None

    def __post_init__(self) -> None:
        for name, value in self.given.items():
            option = f"--{name}"
            if not (isinstance(value, str) and value.strip() and value.isprintable() and len(value) <= _LONGEST):
                raise InputError(option, checks.short_repr(value), f"a line of 1 to {_LONGEST} characters")
            if "\\" in value:
                raise InputError(option, checks.short_repr(value), "text without \\, which separates values in DICOM")
        if self.date is not None and self._day is None:
            raise InputError("--date", checks.short_repr(self.date), "a day as YYYY-MM-DD, such as 2026-03-31")

    @property
    def given(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if value is not None}

    @property
    def _day(self) -> datetime.date | None:
        with suppress(ValueError):
            return datetime.date.fromisoformat(self.date or "")
        return None

    def write(self, image: Any) -> None:
        if self.patient is not None:
            image.PatientName = image.PatientID = self.patient
        if self.title is not None:
            image.StudyDescription = self.title
        if self.description is not None:
            image.SeriesDescription = self.description
        if self._day is not None:
            image.StudyDate = image.SeriesDate = self._day.strftime("%Y%m%d")


def write_dicom(path: Path, volume: Volume, note: str, labels: DicomLabels) -> None:
    """Writes a new folder with 0001.dcm for the lowest slice, and so on upwards. note: "values in 1/mm", or "values in HU"
    with their scale. Raises OutputError for a folder that has files or cannot be written."""
    pydicom = checks.package("pydicom", "the package that this export needs", "phyradgs-cl[formats]")
    unit = "HU" if of_note(note)[0] else "1/mm"
    peak, slope, grid = float(np.abs(volume.values).max()), "1", volume.required_grid
    if unit != "HU" or peak > _LARGEST:  # the smallest step of stored integers that 16 bits allow; 1e-8 more, for rounding
        slope = f"{max(peak, 1e-30) / _LARGEST * (1 + 1e-8):.9e}"
    content = volume.values.tobytes() + repr((grid.voxel_size_mm[::-1], grid.first_centre_mm[::-1])).encode()
    content += repr(labels.given).encode() if labels.given else b""  # other labels make another study, with other UIDs
    seed, generate = hashlib.sha256(content).hexdigest(), pydicom.uid.generate_uid
    uid = {n: generate(entropy_srcs=[seed, unit, n]) for n in ("study", "series", "frame")}
    with folder_written_beside(path) as folder:
        for index, plane in enumerate(volume.values):
            image = _common(pydicom, volume.values.shape, unit, slope, uid)
            image.ImageComments = note
            labels.write(image)
            instance = generate(entropy_srcs=[seed, unit, str(index)])
            image.SOPInstanceUID = image.file_meta.MediaStorageSOPInstanceUID = instance
            _place(image, grid, index)
            image.PixelData = np.rint(plane / float(slope)).astype("<i2").tobytes()
            image.save_as(folder / f"{index + 1:04d}.dcm", enforce_file_format=True)


def _common(pydicom: Any, shape: tuple[int, ...], unit: str, slope: str, uid: dict[str, str]) -> Any:
    image = pydicom.dataset.Dataset()
    image.file_meta = pydicom.dataset.FileMetaDataset()
    image.file_meta.MediaStorageSOPClassUID = image.SOPClassUID = _CT_IMAGE
    image.file_meta.TransferSyntaxUID = _EXPLICIT_LITTLE
    image.SpecificCharacterSet = "ISO_IR 192"  # UTF-8
    image.StudyInstanceUID, image.SeriesInstanceUID = uid["study"], uid["series"]
    image.FrameOfReferenceUID = uid["frame"]
    for name in ("PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "AccessionNumber"):
        setattr(image, name, "")
    image.PatientName, image.StudyID = "phyradgs-cl^volume", "1"
    for name in ("ReferringPhysicianName", "PositionReferenceIndicator", "KVP", "AcquisitionNumber"):
        setattr(image, name, None)
    image.Modality, image.Manufacturer, image.SeriesNumber = "CT", "phyradgs-cl", 1
    image.SeriesDescription = f"values in {unit}"
    image.ImageType, image.PatientPosition = ["DERIVED", "PRIMARY", "AXIAL"], "HFS"
    _, image.Rows, image.Columns = shape
    image.SamplesPerPixel, image.PhotometricInterpretation = 1, "MONOCHROME2"
    image.BitsAllocated, image.BitsStored, image.HighBit, image.PixelRepresentation = 16, 16, 15, 1
    image.RescaleSlope, image.RescaleIntercept = slope, "0"
    image.RescaleType = "HU" if unit == "HU" else "US"
    return image


def _place(image: Any, grid: Grid, index: int) -> None:
    """Sets number, position and spacing of slice ``index``, in mm. PixelSpacing has the distance between rows first."""
    (dz, dy, dx), (z, y, x) = grid.voxel_size_mm, grid.first_centre_mm
    image.InstanceNumber = index + 1
    image.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    image.ImagePositionPatient = [_decimal(place) for place in (x, y, z + index * dz)]
    image.PixelSpacing = [_decimal(dy), _decimal(dx)]
    image.SliceThickness = image.SpacingBetweenSlices = _decimal(dz)
    image.SliceLocation = _decimal(z + index * dz)


def _decimal(number: float) -> str:
    """Returns a DICOM decimal string, which has at most 16 characters."""
    return f"{number:.10g}" if 1e-4 <= abs(number) < 1e9 or number == 0 else f"{number:.8e}"


@contextmanager
def folder_written_beside(path: Path) -> Iterator[Path]:
    """Yields a temporary folder, which is renamed to ``path`` on success and removed after an error. Raises OutputError
    where ``path`` is a file or a folder with files, or cannot be written."""
    target = Path(os.path.abspath(path))
    if target.is_symlink() or (target.exists() and (not target.is_dir() or any(target.iterdir()))):
        found = "an existing file or folder"
        raise OutputError(str(path), found, "a new or an empty folder", "choose another name")
    temporary = temporary_name(target)
    try:
        temporary.mkdir()
        yield temporary
        os.replace(temporary, target)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            found = error.strerror or str(error)
            raise OutputError(str(path), found, "a folder that can be written", "choose another") from error
        raise
