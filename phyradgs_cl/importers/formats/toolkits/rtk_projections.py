"""Raw projections that the package itk-rtk reads: Elekta XVI 5, Varian OBI and ProBeam (TrueBeam), and ORA of medPhoton.

RTK's readers give the geometry, and line integrals after its own corrections for each maker: Elekta's images lose their
rim, Varian's are divided by their air. The makers' files go to RTK as they are, which checks less than the readers of other
formats here: import files of people whom you trust."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.formats.rtk import OPTIONS, read_rtk_xml, scan_of, stack_of
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.files import SafeFolder, check_room

_COPIES = 12  # bytes of memory for every byte of the files: RTK's images, packed by some makers, and line integrals


@dataclass(frozen=True)
class _Maker:
    """Ends of the names of the geometry's file and of projections; ``read``(RTK, file, projections) -> RTK's geometry."""

    description: str
    suffixes: tuple[str, ...]
    read: Callable[[Any, str, list[str]], Any]


def _elekta(rtk: Any, description: str, names: list[str]) -> Any:
    reader = rtk.ElektaXVI5GeometryXMLFileReader.New()
    reader.SetFilename(description)
    reader.GenerateOutputInformation()
    return reader.GetOutputObject()


def _varian(kind: str, rtk: Any, description: str, names: list[str]) -> Any:
    reader = getattr(rtk, kind).New()
    reader.SetXMLFileName(description)
    reader.SetProjectionsFileNames(names)
    reader.UpdateOutputData()
    return reader.GetOutputObject()


def _ora(rtk: Any, description: str, names: list[str]) -> Any:
    reader = rtk.OraGeometryReader.New()
    reader.SetProjectionsFileNames(names)
    reader.UpdateOutputData()
    return reader.GetOutputObject()


_MAKERS = (
    _Maker("_frames.xml", (".his",), _elekta),
    _Maker("projectioninfo.xml", (".hnd", ".hnc"), partial(_varian, "VarianObiGeometryReader")),
    _Maker("scan.xml", (".xim",), partial(_varian, "VarianProBeamGeometryReader")),
    _Maker(".ora.xml", (".ora.xml",), _ora),
)


def recognises(path: Path) -> bool:
    """True for a folder, or a description, of one of the makers, with projections beside the description."""
    return _located(path) is not None


def _located(path: Path) -> tuple[_Maker, Path, list[Path]] | None:
    """Returns the maker, the description and the projections in natural order."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    descriptions = folder.matching(".xml") if path.is_dir() else [path]
    for maker in _MAKERS:
        matching = [file for file in descriptions if file.name.lower().endswith(maker.description)]
        last = {suffix[suffix.rindex(".") :] for suffix in maker.suffixes}
        projections = [file for file in folder.matching(*last) if file.name.lower().endswith(maker.suffixes)]
        if matching and projections:
            return maker, matching[0], projections
    return None


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a maker's folder, or its description with the projections in its folder."""
    options.refuse_unused("rtk-projections", OPTIONS)
    if (located := _located(path)) is None:
        expected = ", ".join(f"*{maker.description} with *{maker.suffixes[0]}" for maker in _MAKERS)
        raise InputError(str(path), "no description with projections", expected)
    maker, description, projections = located
    check_room(str(path), _COPIES * sum(file.stat().st_size for file in projections))
    itk = checks.package("itk", "the package whose RTK reads these files", "phyradgs-cl[rtk]")
    names = [str(file) for file in projections]
    with _as_input_error(path), tempfile.TemporaryDirectory() as folder:
        from itk import RTK

        target = Path(folder) / "geometry.xml"
        RTK.write_geometry(maker.read(RTK, str(description), names), str(target))
        geometry = read_rtk_xml(target)
        reader = RTK.ProjectionsReader[itk.Image[itk.F, 3]].New(FileNames=names)
        reader.Update()
        image = reader.GetOutput()
        frames = np.array(itk.array_from_image(image))
        direction = np.asarray(itk.array_from_matrix(image.GetDirection()))
        first_index = image.GetLargestPossibleRegion().GetIndex()  # above 0 where RTK has cut off a rim
        origin_mm = tuple(image.TransformIndexToPhysicalPoint(first_index))
        stack = stack_of(frames, origin_mm, tuple(image.GetSpacing()), direction, str(path))
    return scan_of(geometry, stack, options, (str(description), str(path)), description.stem, str(path))


@contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    """Turns any error of RTK in the body into InputError."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # ITK raises RuntimeError, and TypeError for what it cannot convert
        text = " ".join(str(error).split())[-160:]
        raise InputError(str(path), f"files that RTK does not read ({text})", "projections with their geometry") from error
