"""Reads what other programs wrote: scans by a module per format, volumes by their suffix, beads and wires from TOML. For
well-known formats that are not read, the error says how to convert them."""

from collections import Counter
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.fields.hounsfield import of_note
from phyradgs_cl.importers import tiff
from phyradgs_cl.importers.files import SafeFolder, read_json, read_npy
from phyradgs_cl.importers.images import image_times_s, read_image_volume, read_zarr
from phyradgs_cl.importers.options import OF_BARE_FRAMES, OF_FOLDERS, OF_HDF5, TIMING, ImportOptions
from phyradgs_cl.io.attenuation import PER_MM, VALUES, check_attenuation, in_per_mm
from phyradgs_cl.io.tables import Fields, read_toml, refuse_unknown
from phyradgs_cl.io.volume import Volume, finite_float32, read_volume, shares_of_maximum
from phyradgs_cl.phantoms import Cylinder, Ellipsoid, EllipsoidPhantom

_TO_TIFF = "convert them to 16-bit TIFF, as in Fiji: File > Import > Image Sequence, then Save As > Image Sequence"
_KINDS = {
    ("png", "jpg", "jpeg", "bmp", "gif", "jp2"): ("images of another kind than TIFF", _TO_TIFF),
    ("edf",): ("ESRF's EDF", "convert them to TIFF or HDF5 with fabio or silx: 'silx convert *.edf -o scan.h5'"),
    ("raw", "bin", "img", "vol", "dat", "seq", "viv"): (
        "raw numbers without a description", "convert them to TIFF, as in Fiji: File > Import > Raw, then Save As > Tiff"
    ),
    ("dcm", "dicom", "ima"): (
        "DICOM", "convert a volume with SimpleITK to NIfTI (its Hounsfield units: --mu-water-per-mm); projections to TIFF"
    ),
    ("hdr",): (
        "a header with its numbers in another file, as in NIfTI's pairs",
        "save a NIfTI as one file: nibabel.save(nibabel.load('v.hdr'), 'v.nii'); others as in Fiji: File > Import > Raw"
    ),
    ("mat",): ("a file of MATLAB", "save its array as .npy or TIFF: scipy.io.loadmat and tifffile.imwrite"),
    ("fit", "fits"): ("FITS", "convert them to TIFF: astropy.io.fits and tifffile.imwrite"),
    ("rek",): (
        "projections or a volume of Fraunhofer's or YXLON's software",
        "convert projections to TIFF, as in Fiji: File > Import > Raw, behind their header"
    ),
    ("nii",): ("NIfTI", "save projections of RTK as .mha: SimpleITK.WriteImage(SimpleITK.ReadImage('p.nii.gz'), 'p.mha')"),
    ("his", "dbf"): (
        "Elekta's projections without _Frames.xml of XVI 5", "copy it; rtkelektasynergygeometry reads FRAME.DBF"
    ),
    ("hnd", "hnc", "xim"): (
        "Varian's projections without their description", "copy ProjectionInfo.xml, of .xim Scan.xml, into their folder"
    ),
    ("xrm", "txm"): ("single images or a volume of Xradia", "import the scan's .txrm, or export TIFFs"),
}  # fmt: skip
# To name the format of a folder in an error, at most this many of its entries are looked at: more would take long.
_MOST_FILES = 1000


def refuse_unread(path: Path, expected: str) -> None:
    """Raises InputError, which says how to convert the data, for a file of a known format that this package does not read,
    and for a folder with such files. expected: what the error says was expected."""
    entries = [path] if path.is_file() else sorted(path.iterdir())[:_MOST_FILES] if path.is_dir() else []
    files = [file for file in entries if file.is_file()]
    plain = (Path(file.name.lower().removesuffix(".gz")).suffix[1:] for file in files)
    suffixes = Counter("dcm" if _is_dicom(file) else suffix for file, suffix in zip(files, plain, strict=True))
    for suffix, _ in suffixes.most_common():
        for known, (what, remedy) in _KINDS.items():
            if suffix in known:
                raise InputError(str(path), f"{what} (.{suffix}), which is not read", expected, remedy)


def _is_dicom(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(132)[128:] == b"DICM"


_OF_READOUT = "exposure_s", "readout_axis", "readout_direction", "detector_model"
_OF_INTEGRALS = *TIMING, "quantity", "flat_value", "detector_model"
# For each format: its module in formats/, loaded when it is needed, the program whose scans it reads, for the help, and the
# options that it reads; None where the module itself refuses others.
# A module has recognises(path) and import_scan(path, options) -> Scan, for a file or a folder.
# For MODULE:END the module's functions are recognises_END and import_scan_END.
FORMATS: dict[str, tuple[str, str, tuple[str, ...] | None]] = {
    "r2": ("r2_gaussian", "R2-Gaussian", (*TIMING, "unit_mm", "detector_model", "part")),
    "phyradgs": ("r2_gaussian:with_times", "PhyRadGS", (*_OF_READOUT, "unit_mm", "part")),
    "phyradgs-real": ("phyradgs_real", "PhyRadGS", (*_OF_READOUT, "pixel_size_mm", "quantity", "flat_value", "first_view")),
    "naf": ("pickles", "NAF", (*TIMING, "detector_model", "part")),
    "rtk": ("rtk", "RTK", _OF_INTEGRALS),
    "data-exchange": ("beamlines:exchange", "Data Exchange", OF_HDF5),
    "nxtomo": ("beamlines", "NXtomo", OF_HDF5),
    "tiff": ("tiff_folder", "TIFF", (*OF_BARE_FRAMES, "linked_folder")),
    "nikon": ("nikon", "Nikon", OF_FOLDERS),
    "skyscan": ("skyscan", "SkyScan", OF_FOLDERS),
    "zeiss": ("zeiss", "Zeiss", OF_FOLDERS),
    "flexray": ("flexray", "FleX-ray", OF_BARE_FRAMES),
    "rtk-projections": ("rtk_projections", "Elekta, Varian, ORA", None),
    "leap": ("leap", "LEAP", OF_BARE_FRAMES),
    "tigre": ("pickles:tigre", "TIGRE", (*_OF_INTEGRALS, "row_0", "column_0")),
}
_MOST_BODIES = 1000  # no calibration phantom has more beads and wires
_LARGEST_MM, _LARGEST_PER_MM = 1e5, 1e5  # larger coordinates and attenuations must be in wrong units
_COMMON = "attenuation_per_mm"
_KEYS = {"bead": ("centre_mm", "radius_mm", _COMMON), "wire": ("from_mm", "to_mm", "radius_mm", _COMMON)}


def import_scan(path: str | Path, options: ImportOptions | None = None, form: str | None = None) -> Scan:
    """Imports a file or folder of another program as a scan of line integrals, row 0 the lowest, in mm, s and radians.

    options: values that the files do not state, or that replace theirs. form: a key of ``FORMATS``; None recognises the
    format. Raises InputError for an unknown format, damaged or incomplete files, and options that the format ignores."""
    path = Path(path)
    _check_there(path)
    form = form or recognise(path)
    checks.one_of("format", form, FORMATS)
    options = options or ImportOptions()
    if (used := FORMATS[form][2]) is not None:
        options.refuse_unused(form, used)
    try:
        scan: Scan = _function("import_scan", form)(path, options)
    except InputError as error:
        if not error.subject.startswith("grid "):
            raise
        raise InputError(f"{path} {error.subject}", error.found, error.expected, error.remedy) from error
    scan.check_timing()
    return scan


def _check_there(path: Path) -> None:
    if not (path.is_dir() or path.is_file()):
        found = "something that is neither a file nor a folder" if path.exists() else "nothing there"
        raise InputError(str(path), found, "a scan to import", "check the path")


def recognise(path: Path) -> str:
    """Finds the format, a key of ``FORMATS``, by a file's or folder's content. Raises InputError if none or several fit."""
    _check_there(path)
    expected = "one of the formats of docs/import.md"
    names = [name for name in FORMATS if _function("recognises", name)(path)]
    if len(names) == 1:
        return names[0]
    tiffs = SafeFolder(path).matching(*tiff.SUFFIXES) if path.is_dir() else path.suffix.lower() in tiff.SUFFIXES
    if not names and tiffs:
        if path.is_dir() and SafeFolder(path).exists(xre := "data settings XRE.txt"):
            raise InputError(str(path), f"FleX-ray's '{xre}' alone", "'scan settings.txt' too", "copy it from the scanner")
        remedy = f"'phyradgs import {path if path.is_dir() else path.parent} --template' prints one to fill in"
        found = "TIFF images and no TOML that describes them"
        raise InputError(str(path), found, "geometry and angles in a TOML beside them", remedy)
    if not names:
        refuse_unread(path, expected)
    found = f"several: {', '.join(names)}" if names else "no known format"
    raise InputError(str(path), found, expected, "say which with --format")


def _function(name: str, form: str) -> Callable[..., Any]:
    module, _, end = FORMATS[form][0].partition(":")
    function: Callable[..., Any] = getattr(import_module(f"{__package__}.formats.{module}"), f"{name}_{end}".rstrip("_"))
    return function


def foreign_volume(path: str | Path) -> str | None:
    """Returns the name of a file's volume format, such as "NIfTI", by its suffix; None for HDF5 and other files."""
    return reader[0] if (reader := _reader(path)) else None


def load_volume(path: str | Path, mu_water_per_mm: float | None = None) -> Volume:
    """Reads a volume (nz, ny, nx) float32 in 1/mm of any format. Axes are reordered and flipped to point as the world's do,
    LPS (docs/export.md).

    The volume has no grid if the file has no voxel sizes: a bare dataset /volume, .npy without its .json, and others.
    Hounsfield units are converted, see ``in_per_mm``. Raises InputError for a damaged file, oblique axes, Hounsfield
    units without ``mu_water_per_mm``, and values that are not finite."""
    if (reader := _reader(path)) is None:
        refuse_unread(Path(path), "a volume of a format of docs/formats.md")
    return in_per_mm(str(path), (reader[1] if reader else read_volume)(Path(path)), mu_water_per_mm)


def load_states(path: str | Path) -> Iterator[tuple[float, Volume]]:
    """Yields (time in s, volume) for each volume of a NIfTI, NRRD or MetaImage file with four axes; nothing for other
    files. Raises InputError as ``load_volume`` does."""
    if (reader := _reader(path)) is not None and reader[1] is read_image_volume:
        for state, time_s in enumerate(image_times_s(Path(path))):
            yield time_s, in_per_mm(str(path), read_image_volume(Path(path), state))


def load_attenuation(path: str | Path, *, warn: bool = True) -> Volume:
    """Reads a volume (nz, ny, nx) in 1/mm that will be projected. warn: also warn of many negative values. Raises
    InputError as ``load_volume`` does, and as ``check_attenuation`` does for values that no attenuation has."""
    return check_attenuation(f"volume of {path}", load_volume(path), warn=warn)


def _reader(path: str | Path) -> tuple[str, Callable[[Path], Volume]] | None:
    name = Path(path).name.lower()
    return next((reader for suffix, reader in _READERS.items() if name.endswith(suffix)), None)


def _read_npy(path: Path) -> Volume:
    """Reads an array (nz, ny, nx), and its grid from a .json file of the same name, if this file exists."""
    values, beside = read_npy(path, 3), path.with_suffix(".json")
    facts = read_json(beside) if beside.is_file() else {}
    if "voxel_size_mm" not in facts:
        return _on_grid(path, values)
    if facts.get("axes") != ["z", "y", "x"] or facts.get("shape") != list(values.shape):
        found = f"axes {facts.get('axes')}, shape {facts.get('shape')}"
        raise InputError(str(beside), found[:80], f"axes z, y, x, shape {list(values.shape)}")
    table = Fields(str(beside), facts)
    size_mm, first_mm = table.lengths("voxel_size_mm", 3), table.numbers("first_centre_mm", 3)
    return _on_grid(path, values, size_mm, first_mm, f"values in {facts.get('values')}")


def _read_tiff(path: Path) -> Volume:
    """Reads a TIFF's pages as slices from the lowest up, row 0 at the smallest y, with voxel sizes of ImageJ or OME."""
    values = tiff.read_tiffs([path])
    size_mm, origin, note = tiff.calibration(path)
    if size_mm is None:
        return _on_grid(path, values)
    first_mm = None if origin is None else -(origin * size_mm)[::-1]
    return _on_grid(path, values, size_mm[::-1], first_mm, note)


def _on_grid(
    path: Path, values: np.ndarray, size_mm: np.ndarray | None = None, first_mm: np.ndarray | None = None, note: str = ""
) -> Volume:
    """Returns a volume of values (nz, ny, nx). size_mm (3,): a voxel's sizes; without them the volume has no grid, and
    integers are divided by the maximum of their type. first_mm (3,): the first voxel's centre; None centres the volume at
    the origin. Both are (z, y, x). note: the file's words about its values."""
    if size_mm is None:
        return Volume(finite_float32(str(path), shares_of_maximum(values)), None)
    centre_mm = np.zeros(3) if first_mm is None else first_mm + (np.array(values.shape) - 1) / 2 * size_mm
    grid = Grid(triple(values.shape), triple(size_mm.tolist()), triple(centre_mm.tolist()))
    return Volume(finite_float32(str(path), values), grid, {VALUES: note} if PER_MM in note or of_note(note)[0] else {})


_READERS: dict[str, tuple[str, Callable[[Path], Volume]]] = {
    **dict.fromkeys((".mha", ".mhd"), ("MetaImage", read_image_volume)),
    **dict.fromkeys((".nii", ".nii.gz"), ("NIfTI", read_image_volume)),
    **dict.fromkeys(tiff.SUFFIXES, ("TIFF", _read_tiff)),
    **dict.fromkeys((".nrrd", ".nhdr"), ("NRRD", read_image_volume)), ".npy": ("NumPy", _read_npy),
    ".zarr": ("OME-Zarr", lambda path: _on_grid(path, *read_zarr(path))),
}


def load_beads(path: Path) -> EllipsoidPhantom:
    """Reads the beads, then the wires, of a TOML file as a phantom named after the file. Raises InputError for a file that
    is not TOML, for unknown, missing or wrong keys, no bead, and more than a thousand bodies."""
    content = read_toml(path)
    refuse_unknown(str(path), content, ("title", _COMMON, *_KEYS))
    top, bodies = Fields(str(path), content), list[Ellipsoid | Cylinder]()
    for kind, keys in _KEYS.items():
        for body in top.tables(kind) if kind == "bead" or top.has(kind) else ():
            one = Fields(body.subject, body.values, keys)
            places = [triple(one.numbers(key, 3, _LARGEST_MM).tolist()) for key in keys[:-2]]
            radius_mm, given = one.length("radius_mm"), one if one.has(_COMMON) else top
            per_mm = given.number(_COMMON, lowest=-_LARGEST_PER_MM, highest=_LARGEST_PER_MM)
            is_bead = len(places) == 1
            bodies.append(
                Ellipsoid(places[0], (radius_mm,) * 3, per_mm) if is_bead
                else Cylinder((places[0], places[1]), radius_mm, per_mm)
            )  # fmt: skip
    if len(bodies) > _MOST_BODIES:
        raise InputError(str(path), f"{len(bodies)} beads and wires", f"at most {_MOST_BODIES}")
    return EllipsoidPhantom(tuple(bodies), path.stem)
