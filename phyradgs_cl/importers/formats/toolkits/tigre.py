"""Pickles of TIGRE: the tuple (projections, geometry, angles) that its loaders return, with a ``tigre.geometry``.

Frames (F, v, u) are line integrals with row 0 the lowest, as ``tigre.Ax`` gives them; angles are the gantry's in radians.
The classes of TIGRE are not loaded: a geometry becomes a plain bag of its attributes, and any name in the pickle that is not
of it, of NumPy's arrays or a plain container is refused."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import ConeGeometry, Geometry, ParallelGeometry, plain_geometry
from phyradgs_cl.acquisition.scans_from import is_parallel_tigre, poses_of_tigre
from phyradgs_cl.acquisition.trajectory import CircularOrbit, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.assemble import along
from phyradgs_cl.importers.formats.naf import TIGRE_MODULE, PlainUnpickler, names_tigre, read_pickle
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.reading.frames import line_integrals, oriented
from phyradgs_cl.io.tables import Fields, described

OPTIONS = (*TIMING, "row_0", "column_0", "quantity", "flat_value", "detector_model")
_NAMES = ("DSO", "DSD", "nDetector", "dDetector", "nVoxel", "dVoxel", "offOrigin", "offDetector", "rotDetector", "COR")
_SAME = 1e-9  # relative: poses of one circle
_CLASSES = ("Geometry", "ConeGeometryDefault", "ParallelGeometryDefault")


class _Geometry(SimpleNamespace):
    """The attributes of a ``tigre.geometry``."""


class TigreUnpickler(PlainUnpickler):
    """The unpickler of plain arrays, which also takes TIGRE's geometries."""

    def find_class(self, module: str, name: str) -> Any:
        """Returns the bag of attributes for a class of TIGRE's geometries; for other names what plain pickles may have."""
        if module.startswith(TIGRE_MODULE) and name in _CLASSES:
            return _Geometry
        return super().find_class(module, name)


def recognises(path: Path) -> bool:
    """True for a pickle that names TIGRE's geometry in its first or last bytes."""
    return path.is_file() and path.suffix.lower() in (".pickle", ".pkl") and names_tigre(path)


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the projections of a pickle."""
    options.refuse_unused("tigre", OPTIONS)
    content = read_pickle(path, TigreUnpickler)
    if isinstance(content, dict):
        content = tuple(_named(content, *names) for names in (("proj", "frames"), ("geo",), ("angle", "theta")))
    if not isinstance(content, (tuple, list)) or len(content) != 3 or not isinstance(content[1], _Geometry):
        expected = "projections, geometry and angles, in this order as TIGRE's loaders return them, or by these names"
        raise InputError(str(path), described(content), expected)
    frames, angles = content[0], content[2]
    geo = SimpleNamespace(**{name: getattr(content[1], name, None) for name in (*_NAMES, "mode")})
    if isinstance(angles, (list, tuple)):
        angles = Fields(f"{path}:", {"angles": list(angles)}).numbers("angles")
    for name, value in (("projections", frames), ("angles", angles)):
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
            raise InputError(f"{path}: {name}", described(value), "an array of numbers")
    try:
        poses, panel, grid = poses_of_tigre(geo, np.asarray(angles))
    except InputError as error:
        raise InputError(f"{path}: {error.subject}", error.found, error.expected, error.remedy) from error
    checks.shape(f"{path}: projections", frames, (len(poses), *panel))
    timing = assemble.make_timing(str(path), len(poses), options)
    angle_rad = np.asarray(angles, np.float64).reshape(len(poses), -1)[:, 0]
    trajectory, geometry = _trajectory(geo, poses, angle_rad, timing, str(path))
    turned = oriented(np.asarray(frames), options, "bottom")
    integrals = line_integrals(str(path), turned, options, convention="attenuation")
    parts = integrals, trajectory, geometry, timing, options
    return assemble.assemble_scan(*parts, title=path.stem, source=str(path), grid=grid)


def _named(content: dict[object, Any], *words: str) -> Any:
    """Returns the one value of a dictionary whose name begins with one of the words, None where there is none."""
    return next((value for name, value in content.items() if str(name).lower().startswith(words)), None)


def _trajectory(
    geo: Any, poses: np.ndarray, angle_rad: np.ndarray, timing: assemble.Timing, subject: str
) -> tuple[CircularOrbit | PoseTable, Geometry]:
    """Returns a circular orbit where one value of each length describes the poses (F, 12), else a table of them."""
    rows, columns = np.ravel(geo.nDetector).tolist()
    pitch_v, pitch_u = np.ravel(geo.dDetector).tolist()
    off_v, off_u = np.resize(0.0 if geo.offDetector is None else geo.offDetector, 2).tolist()
    is_parallel, sides = is_parallel_tigre(geo), ((rows, columns), (pitch_v, pitch_u), (off_v, off_u))
    if is_parallel:
        geometry: Geometry = ParallelGeometry(*sides)
    else:
        geometry = ConeGeometry(float(np.ravel(geo.DSO)[0]), float(np.ravel(geo.DSD)[0]), *sides)
    if np.allclose(geometry.pose(angle_rad), poses, rtol=0, atol=_SAME * np.abs(poses).max()):
        return assemble.turning(geometry, angle_rad, timing), geometry
    table = assemble.table_over_time(lambda position: along(poses, position), timing, subject, is_parallel)
    return table, plain_geometry(poses, geometry.detector_shape, is_parallel)
