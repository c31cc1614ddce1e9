"""Scans of LEAP: the text file that its ``save_parameters`` writes, with line integrals as .npy (F, v, u) or TIFFs.

At LEAP's angle φ = 0° the source stands at −y, so the gantry's angle is φ − 90°. Columns count in the direction in which the
gantry turns, and row 0 is the lowest. The ray through the origin falls on centerRow and centerCol. ``tau`` shifts source and
panel against the columns' direction. A modular beam is a table of sources, panel centres, and directions of rows and
columns. The volume of a parallel beam has a slice for each row of the panel, at the row's height. Units: mm, degrees."""

import logging
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import Geometry, ParallelGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.assemble import RotaryStage, along
from phyradgs_cl.importers.files import SafeFolder, read_npy
from phyradgs_cl.importers.frames import line_integrals, oriented
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.series import series_of
from phyradgs_cl.importers.text import Settings, found_by, read_settings, say_missing
from phyradgs_cl.importers.tiff import SUFFIXES, read_tiffs

_log = logging.getLogger(__name__)
_VECTORS = ("sourcePositions", "moduleCenters", "colVectors", "rowVectors")
_NAMES = (
    *("numX", "numY", "numZ", "voxelWidth", "voxelHeight", "offsetX", "offsetY", "offsetZ", "geometry", "detectorType"),
    *("numAngles", "numRows", "numCols", "pixelHeight", "pixelWidth", "centerRow", "centerCol", "angularRange", "phis"),
    *("sod", "sdd", "tau", "helicalPitch", "tiltAngle", *_VECTORS),
)
_BEAMS = ("cone", "parallel", "modular")
recognises = found_by((".txt", ".cfg"), b"numAngles", b"numCols")
_MOST = 1_000_000  # a file with more angles, rows, columns or voxels along an axis is damaged
_SKEW = 0.01  # LEAP refuses rows and columns whose directions have a larger product, and makes smaller ones 0
_ROUNDED = 1e-5  # LEAP writes seven digits
_OF_TABLES = (*TIMING, "row_0", "column_0", "quantity", "flat_value", "detector_model")


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder of frames with one file of LEAP's parameters. ``path`` may also be that file."""
    folder, descriptions = SafeFolder(path if path.is_dir() else path.parent), recognises(path)
    if len(descriptions) != 1:
        raise InputError(str(path), f"{len(descriptions)} files of LEAP's parameters", "one", "name the file itself")
    description = descriptions[0]
    scan = read_settings(description, _NAMES)
    shape = triple(scan.count(name, _MOST) for name in ("numAngles", "numRows", "numCols"))
    arrays, images = folder.matching(".npy"), folder.matching(*SUFFIXES)
    if not arrays and not images:
        raise InputError(str(folder.root), "no .npy and no TIFF", "the line integrals")
    series = None if arrays else series_of(images, str(folder.root), "complete the frames")
    frames = read_tiffs(series.paths) if series else read_npy(folder.only("stack", ".npy"), 3)
    if frames.shape != shape:
        raise InputError(str((arrays or images)[0]), f"frames {frames.shape}", f"{shape} of {description.name}")
    timing = assemble.make_timing(str(description), shape[0], options)
    read = _modular if scan.word("geometry", _BEAMS) == "modular" else _turning
    trajectory, geometry = read(scan, shape, options, timing)
    integrals = line_integrals(str(folder.root), oriented(frames, options, "bottom"), options, convention="attenuation")
    parts, said = (integrals, trajectory, geometry, timing, options, path), series.said if series else ""
    return assemble.assemble_scan(*parts, title=description.stem, grid=_grid(scan, geometry), said=said)


def _turning(
    scan: Settings, shape: tuple[int, int, int], options: ImportOptions, timing: assemble.Timing
) -> tuple[CircularOrbit | PoseTable, Geometry]:
    """Returns trajectory and geometry of a beam that turns about z. Raises InputError for a helix, tilt or curved panel."""
    for name in ("helicalPitch", "tiltAngle"):
        if scan.number(name, 0.0):
            raise scan.error(name, f"{scan.number(name):g}", "0", "write it with convert_to_modularbeam()")
    if scan.word("detectorType", default="flat").lower() != "flat":
        raise scan.error("detectorType", scan.word("detectorType")[:40], "flat")
    pitch_mm = options.taken("pixel_size_mm", lambda: (scan.length("pixelHeight"), scan.length("pixelWidth")))
    centre = (scan.number("centerRow"), scan.number("centerCol"))
    sizes = zip(shape[1:], centre, pitch_mm, strict=True)
    off_v, off_u = (((size - 1) / 2 - ray) * pitch for size, ray, pitch in sizes)
    if scan.word("geometry") == "parallel":
        geometry: Geometry = assemble.parallel(options, shape[1:], pitch_mm, (off_v, off_u))
    else:
        sod, sdd = partial(scan.length, "sod"), partial(scan.length, "sdd")
        geometry = assemble.cone(options, sod, sdd, shape[1:], pitch_mm, (off_v, off_u))

    def stored_rad() -> np.ndarray:
        if scan.has("phis"):
            return np.deg2rad(scan.listed("phis", shape[0]))
        say_missing(scan, {"phis": "angularRange in equal steps from 0°"})
        return np.deg2rad(np.arange(shape[0]) * (scan.number("angularRange") / shape[0]))

    angle_rad = options.gantry_sign("gantry") * (options.angle_rad(shape[0], stored_rad) - np.pi / 2)
    tau_mm = 0.0 if isinstance(geometry, ParallelGeometry) else scan.position("tau")
    return RotaryStage(geometry, tau_mm).turned(angle_rad, timing, scan.subject)


def _modular(
    scan: Settings, shape: tuple[int, int, int], options: ImportOptions, timing: assemble.Timing
) -> tuple[PoseTable, Geometry]:
    options.refuse_unused("leap, which states every view", _OF_TABLES)
    source, centre, right, up = (scan.listed(name, 3 * shape[0]).reshape(-1, 3) for name in _VECTORS)
    for name, vectors in (("colVectors", right), ("rowVectors", up)):  # LEAP takes their directions alone
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        if not length.all():
            raise scan.error(name, f"a vector of length 0 in view {int(np.argmin(length))}", "directions")
        vectors /= length
    product = np.sum(right * up, axis=1, keepdims=True)
    if np.abs(product).max() > _SKEW:
        found = f"{90 - np.rad2deg(np.arcsin(np.abs(product).max())):.4g}° to colVectors"
        raise scan.error("rowVectors", found, "90°, as LEAP demands")
    up -= product * right
    step_u, step_v = right * scan.length("pixelWidth"), up * scan.length("pixelHeight")
    first = centre - (shape[2] - 1) / 2 * step_u - (shape[1] - 1) / 2 * step_v
    poses = np.concatenate([source, first, step_u, step_v], -1)
    panel = shape[1], shape[2]
    return assemble.table_over_time(lambda position: along(poses, position), timing, scan.subject, panel)


def _grid(scan: Settings, geometry: Geometry) -> Grid | None:
    if not all(map(scan.has, ("numX", "numY", "numZ", "voxelWidth", "voxelHeight"))):
        return None
    sizes_mm = triple(scan.length(name) for name in ("voxelHeight", "voxelWidth", "voxelWidth"))
    counts = triple(scan.count(f"num{axis}", _MOST) for axis in "ZYX")
    z, y, x = (scan.position(f"offset{axis}") for axis in "ZYX")
    if isinstance(geometry, ParallelGeometry) and scan.word("geometry") == "parallel":
        rows = ("numZ", counts[0], geometry.detector_shape[0]), ("voxelHeight", sizes_mm[0], geometry.pixel_size_mm[0])
        for name, found, row in rows:
            if abs(found - row) > _ROUNDED * row:
                expected = f"{row:g}, the panel's: LEAP's volume of a parallel beam has a slice for each row"
                raise scan.error(name, f"{found:g}", expected, "correct it, or remove the lines num and voxel")
        if z:
            _log.warning("%s offsetZ is not used: the slices of a parallel beam are the panel's rows", scan.subject)
        z = geometry.detector_offset_mm[0]
    return Grid(counts, sizes_mm, (z, y, x))
