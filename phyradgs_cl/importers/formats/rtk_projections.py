"""Raw projections that the package itk-rtk reads: Elekta XVI 5, Varian OBI and ProBeam (TrueBeam), and ORA of medPhoton.

RTK reads the geometry and the counts, and crops the edges of Elekta's images. Unless the options state the counts of air,
RTK's constants are used; ORA's files hold the transmission and need none. The counts of .xim are divided by the dose that
the chamber before the tube measured, as in TIGRE's reader. RTK checks files less than the other readers here: import only
files from people whom you trust."""

import logging
import struct
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.files import SafeFolder, check_room, in_natural_order, naming_damage
from phyradgs_cl.importers.formats.rtk import HND_BELOW, XIM_BELOW, read_rtk_xml, scan_of, stack_of
from phyradgs_cl.importers.options import TIMING, ImportOptions

_log = logging.getLogger(__name__)
_AIR = {".his": 65536.0, ".hnd": 139000.0, ".hnc": 65535.0, ".xim": 139000.0}  # RTK's counts of air
_CHAMBER = b"KVNormChamber"
_TAIL_BYTES = 1 << 18  # bytes at the end of a .xim file in which its properties are sought
_COPIES = 12  # bytes of memory for every byte of the files: some makers pack images, and RTK keeps several copies


@dataclass(frozen=True)
class _Maker:
    """A maker's files. description, suffixes: how names of the description and of projections end. reader: RTK's class that
    reads the geometry. below: pattern of projections in folders below the description's. options: usable import options."""

    description: str
    suffixes: tuple[str, ...]
    reader: str
    below: str | None = None
    options: tuple[str, ...] = (*TIMING, "detector_model", "flat_value")


_MAKERS = (
    _Maker("_frames.xml", (".his",), "ElektaXVI5GeometryXMLFileReader"),
    _Maker("projectioninfo.xml", (".hnd", ".hnc"), "VarianObiGeometryReader", HND_BELOW),
    _Maker("scan.xml", (".xim",), "VarianProBeamGeometryReader", XIM_BELOW),
    _Maker(".ora.xml", (".ora.xml",), "OraGeometryReader", options=(*TIMING, "detector_model")),
)


def _read_geometry(rtk: Any, reader_name: str, description: str, names: list[str]) -> Any:
    """Reads RTK's geometry from the description, and from the projections' headers if the maker stores angles there."""
    reader = getattr(rtk, reader_name).New()
    if hasattr(reader, "SetFilename"):  # Elekta's reader: the description has the geometry of all projections
        reader.SetFilename(description)
        reader.GenerateOutputInformation()
        return reader.GetOutputObject()
    if hasattr(reader, "SetXMLFileName"):
        reader.SetXMLFileName(description)
    reader.SetProjectionsFileNames(names)
    reader.UpdateOutputData()
    return reader.GetGeometry()


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is a folder with a maker's description and projections, or this description in the folder."""
    return _located(path) is not None


def _located(path: Path) -> tuple[_Maker, Path, list[Path]] | None:
    """Returns the maker, the description and the projections in natural order; None where no maker fits."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    descriptions = folder.matching(".xml") if path.is_dir() else [path]
    for maker in _MAKERS:
        matching = [file for file in descriptions if file.name.lower().endswith(maker.description)]
        last = {suffix[suffix.rindex(".") :] for suffix in maker.suffixes}
        projections = [file for file in folder.matching(*last) if file.name.lower().endswith(maker.suffixes)]
        if matching and not projections and maker.below:
            projections = in_natural_order(list(folder.root.glob(maker.below)))
        if matching and projections:
            return maker, matching[0], projections
    return None


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one maker's description and projections. ``path`` may also be the description in it."""
    if (located := _located(path)) is None:
        expected = ", ".join(f"*{maker.description} with *{maker.suffixes[0]}" for maker in _MAKERS)
        raise InputError(str(path), "no description with projections", expected)
    maker, description, projections = located
    options.refuse_unused("rtk-projections", maker.options)
    if len({file.parent for file in projections}) > 1:
        raise InputError(str(path), "projections of several acquisitions", "one", f"copy {description.name} into its folder")
    check_room(str(path), _COPIES * sum(file.stat().st_size for file in projections))
    itk = checks.package("itk", "the package whose RTK reads these files", "phyradgs-cl[rtk]")
    names = [str(file) for file in projections]
    expected = "projections with their geometry"
    with naming_damage(path, "files that RTK does not read", expected), tempfile.TemporaryDirectory() as folder:
        from itk import RTK

        written = Path(folder) / "geometry.xml"
        RTK.write_geometry(_read_geometry(RTK, maker.reader, str(description), names), str(written))
        geometry = read_rtk_xml(written)
        reader = RTK.ProjectionsReader[itk.Image[itk.F, 3]].New(FileNames=names)
        reader.SetComputeLineIntegral(False)  # RTK's line integral of 0 counts is 0, as of air
        reader.Update()
        image = reader.GetOutput()
        direction = np.asarray(itk.array_from_matrix(image.GetDirection()))
        index = image.GetLargestPossibleRegion().GetIndex()  # above 0 where RTK has cropped the image
        places_mm = tuple(image.TransformIndexToPhysicalPoint(index)), tuple(image.GetSpacing())
        stack = stack_of(np.array(itk.array_from_image(image)), *places_mm, direction, str(path))
    stack.frames[:] /= _air(path, projections, options)[:, None, None]
    options = replace(options, flat_value=None, quantity="transmission")
    clocks = (description, "DeltaMs"), (projections[0], "StartTime")
    clock = next((f"frames' times ({word})" for file, word in clocks if word.encode() in _tail(file)), "")
    return scan_of(geometry, stack, options, (str(description), str(path)), description.stem, path, clock)


def _air(path: Path, projections: list[Path], options: ImportOptions) -> np.ndarray:
    """Returns the counts of air (F,), with a line where nothing states them. The dose of a .xim file counts relative to the
    median of all."""
    usual, suffix = 1.0, projections[0].suffix.lower()
    if suffix in _AIR:
        usual = options.flat_value or _AIR[suffix]
        if options.flat_value is None:
            text = "%s: air is taken for %.0f counts, as RTK does; say %s if a frame without an object has others"
            _log.warning(text, path, usual, options.named("flat_value"))
    dose = np.array([*map(_dose, projections)]) if suffix == ".xim" else np.zeros(len(projections))
    has_dose = dose > 0
    if not has_dose.any():
        return np.full(len(projections), usual)
    times = np.where(has_dose, dose / np.median(dose[has_dose]), 1.0)
    if not has_dose.all():
        text = "%s: frames without a %s above 0, as frame %d, are not divided by it (%d of %d)"
        which = int(np.argmin(has_dose)), int(np.count_nonzero(~has_dose)), len(dose)
        _log.warning(text, path, _CHAMBER.decode(), *which)
    if np.ptp(times) > 0:
        text = "%s: frames are divided by %s, %.4g to %.4g of its median"
        _log.warning(text, path, _CHAMBER.decode(), times.min(), times.max())
    return usual * times


def _dose(file: Path) -> float:
    """Returns the chamber's reading in a .xim file, a property of type 0, int32, or 1, float64; 0 without it."""
    before, _, after = _tail(file).rpartition(_CHAMBER)
    kind, value = after[:4], after[4:12].ljust(8, b"\0")
    form = {b"\0\0\0\0": "<i", b"\1\0\0\0": "<d"}.get(kind) if before else None
    return float(struct.unpack_from(form, value)[0]) if form else 0.0


def _tail(file: Path) -> bytes:
    with open(file, "rb") as opened:
        opened.seek(max(0, file.stat().st_size - _TAIL_BYTES))
        return opened.read()
