"""Raw projections that the package itk-rtk reads: Elekta XVI 5, Varian OBI and ProBeam (TrueBeam), and ORA of medPhoton.

RTK reads the geometry and the line integrals, and crops the edges of Elekta's images. Unless the options state the counts
of air, RTK's constants are used; ORA's files hold the transmission and need none. RTK checks files less than the other
readers here: import only files from people whom you trust."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.files import SafeFolder, check_room, in_natural_order, naming_damage
from phyradgs_cl.importers.formats.rtk import XIM_BELOW, read_rtk_xml, scan_of, stack_of
from phyradgs_cl.importers.options import TIMING, ImportOptions

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
    _Maker("projectioninfo.xml", (".hnd", ".hnc"), "VarianObiGeometryReader"),
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
        if options.flat_value is not None:
            reader.SetI0(options.flat_value)
        reader.Update()
        image = reader.GetOutput()
        direction = np.asarray(itk.array_from_matrix(image.GetDirection()))
        index = image.GetLargestPossibleRegion().GetIndex()  # above 0 where RTK has cropped the image
        places_mm = tuple(image.TransformIndexToPhysicalPoint(index)), tuple(image.GetSpacing())
        stack = stack_of(np.array(itk.array_from_image(image)), *places_mm, direction, str(path))
    options = replace(options, flat_value=None)  # RTK has already divided by the flat value
    return scan_of(geometry, stack, options, (str(description), str(path)), description.stem, str(path))
