"""Kinds of files that are not read, each with the way to convert it."""

from collections import Counter
from pathlib import Path

from phyradgs_cl.errors import InputError

_TO_TIFF = "convert them to 16-bit TIFF, as in Fiji: File > Import > Image Sequence, then Save As > Image Sequence"
_KINDS = {
    ("png", "jpg", "jpeg", "bmp", "gif", "jp2"): ("images of another kind than TIFF", _TO_TIFF),
    ("edf",): ("ESRF's EDF", "convert them to TIFF or HDF5 with fabio or silx: 'silx convert *.edf -o scan.h5'"),
    ("raw", "bin", "img", "vol", "dat", "seq", "viv"): (
        "raw numbers without a description", "convert them to TIFF, as in Fiji: File > Import > Raw, then Save As > Tiff"
    ),
    ("dcm", "dicom", "ima"): (
        "DICOM", "convert a volume with SimpleITK to NIfTI, and its Hounsfield units to 1/mm; projections to TIFF"
    ),
    ("mat",): ("a file of MATLAB", "save its array as .npy or TIFF: scipy.io.loadmat and tifffile.imwrite"),
    ("fit", "fits"): ("FITS", "convert them to TIFF: astropy.io.fits and tifffile.imwrite"),
    ("xrm", "txm"): ("single images or a volume of Xradia", "import the scan's .txrm, or export TIFFs"),
}  # fmt: skip
_MOST_FILES = 1000


def refuse_unread(path: Path, expected: str) -> None:
    """Raises InputError for a file, or for a folder with mostly files, of a kind that is known and not read."""
    entries = [path] if path.is_file() else sorted(path.iterdir())[:_MOST_FILES] if path.is_dir() else []
    files = [file for file in entries if file.is_file()]
    suffixes = Counter("dcm" if _is_dicom(file) else file.suffix.lower()[1:] for file in files)
    for suffix, _ in suffixes.most_common():
        for known, (what, remedy) in _KINDS.items():
            if suffix in known:
                raise InputError(str(path), f"{what} (.{suffix}), which is not read", expected, remedy)


def _is_dicom(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(132)[128:] == b"DICM"
