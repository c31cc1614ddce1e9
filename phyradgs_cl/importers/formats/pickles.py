"""Pickles of NAF and SAX-NeRF: a dictionary of geometry (mm), projections (dimensionless) and true volume (1/m). Pickles of
TIGRE: the tuple (projections, geometry, angles) that its loaders return, with a ``tigre.geometry``. TIGRE's frames (F, v, u)
are line integrals with row 0 the lowest, as ``tigre.Ax`` gives them; angles are the gantry's in radians.

Only plain containers, numbers, NumPy arrays and TIGRE's geometry are read. Every other name in a pickle is refused, so no
code of the file runs. Functions of this module build the arrays, because NumPy's own constructors are not safe here: for
some types they read memory at addresses that the file states."""

import io
import math
import os
import pickle
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import ConeGeometry, Geometry, ParallelGeometry
from phyradgs_cl.acquisition.plausible import question_unit
from phyradgs_cl.acquisition.scans_from import is_parallel_tigre, poses_of_tigre
from phyradgs_cl.acquisition.trajectory import CircularOrbit, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.assemble import Timing, along, assemble_scan, make_timing, table_over_time, turning
from phyradgs_cl.importers.files import check_room, naming_damage
from phyradgs_cl.importers.formats import r2_gaussian
from phyradgs_cl.importers.frames import line_integrals, oriented
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io.files import read_regular, regular_file
from phyradgs_cl.io.tables import Fields, described

_PER_MM = 1e-3  # 1/mm per 1/m, the unit of NAF's volumes
_PARTS = {"train": ("train",), "test": ("val",), "all": ("train", "val")}
TIGRE_MODULE, _END_BYTES = "tigre.utilities.geometry", 1 << 18
_NAMES = ("DSO", "DSD", "nDetector", "dDetector", "nVoxel", "dVoxel", "offOrigin", "offDetector", "rotDetector", "COR")
_SAME = 1e-9  # poses lie on one circle if they differ from it by at most this fraction of their largest entry
_CLASSES = ("Geometry", "ConeGeometryDefault", "ParallelGeometryDefault")
_COPIES = 3  # bytes of memory for every byte of the file: for the file itself, its arrays, and line integrals


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is a pickle (by its suffix) without TIGRE's geometry."""
    return path.is_file() and path.suffix.lower() in (".pickle", ".pkl") and not names_tigre(path)


def names_tigre(path: Path) -> bool:
    """Returns whether a file names TIGRE's geometry in its first or last 256 KiB; the frames between are not searched."""
    with open(path, "rb") as file:
        head = file.read(_END_BYTES)
        file.seek(max(0, os.fstat(file.fileno()).st_size - _END_BYTES))
        return TIGRE_MODULE.encode() in head or TIGRE_MODULE.encode() in file.read(_END_BYTES)


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports projections of a pickle of NAF or SAX-NeRF: its train part, val part or both, as the option ``part`` says."""
    data = Fields(f"{path}:", read_pickle(path))
    geometry, grid = r2_gaussian.read_geometry(data, 1.0), r2_gaussian.read_grid(data, 1.0)
    frames, angle_rad = _frames(data, _PARTS[options.part], geometry.detector_shape)
    timing = make_timing(str(path), len(angle_rad), options)
    reference = None
    if data.has("image"):
        volume = _array(data, "image", 3)
        reference = r2_gaussian.turned_volume(data.name("image"), volume, grid, _PER_MM)
    frames = oriented(frames, options, r2_gaussian.ROW_0)
    integrals = line_integrals(str(path), frames, options, convention="attenuation")
    question_unit(angle_rad, f"{path} angles", "rad")
    trajectory = turning(geometry, angle_rad, timing)
    parts = integrals, trajectory, geometry, timing, options, path
    return assemble_scan(*parts, grid=grid, reference=reference)


def _frames(data: Fields, parts: tuple[str, ...], panel: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    stacks, angles = [], []
    for part in parts:
        table = data.table(part)
        stack = _array(table, "projections", 3)
        checks.shape(table.name("projections"), stack, (None, *panel))
        stacks.append(stack)
        angles.append(table.numbers("angles", len(stack)))
    return np.concatenate(stacks), np.concatenate(angles)


def _array(table: Fields, key: str, ndim: int) -> np.ndarray:
    values = table.get(key)
    if not isinstance(values, np.ndarray) or values.ndim != ndim or values.dtype.kind not in "iuf":
        found = f"shape {values.shape}" if isinstance(values, np.ndarray) else described(values)
        raise table.error(key, found, f"an array of numbers with {ndim} axes")
    if 0 in values.shape:
        raise table.error(key, f"shape {values.shape}", "no empty axis")
    return np.asarray(values)


def read_pickle(path: Path) -> object:
    """Reads dicts, lists, tuples, text, numbers, NumPy arrays of plain numbers and TIGRE's geometries. Raises InputError for
    a damaged file, one too large for this machine's memory, and what ``PlainUnpickler`` refuses."""
    subject = str(path)
    size = regular_file(path, subject).st_size
    check_room(subject, _COPIES * size)
    data = read_regular(path, subject, size, "a pickle")
    with naming_damage(path, "a damaged pickle", "a pickle of plain containers and NumPy arrays"):
        try:
            # latin1, because Python 2 wrote arrays' bytes as text
            return PlainUnpickler(io.BytesIO(data), encoding="latin1").load()
        except InputError as error:
            raise InputError(subject, error.found, error.expected, error.remedy) from error


class PlainUnpickler(pickle.Unpickler):
    """An unpickler that calls no function that a file names. Functions of this module replace a few; others are refused."""

    def find_class(self, module: str, name: str) -> Any:
        """Returns this module's function that replaces an allowed one. Raises InputError for any other name."""
        functions: dict[str, Any] = {  # new functions at each call, since a pickle may change a function's attributes
            "numpy.ndarray": object,  # only passed to _reconstruct, which ignores it
            "numpy.dtype": lambda code, *_: _Type(code),
            "numpy.core.multiarray._reconstruct": lambda *_: _Array((0,)),
            "numpy.core.multiarray.scalar": lambda dtype, raw: _plain_array(raw, dtype, ()).item(),
            "numpy.core.numeric._frombuffer": lambda *arguments: _plain_array(*arguments),
            "_codecs.encode": lambda text, encoding: text.encode("latin1"),
            "copy_reg._reconstructor": lambda made, *_: made(), "__builtin__.object": object,  # of protocols 0 and 1
        }
        if module.startswith(TIGRE_MODULE) and name in _CLASSES:
            return _Geometry
        full_name = f"{module.replace('numpy._core.', 'numpy.core.')}.{name}"  # NumPy 2 renamed numpy.core
        if full_name not in functions:
            found = f"a call of {full_name[:120]}"
            raise InputError("pickle", found, "plain containers and NumPy arrays", "nothing was executed")
        return functions[full_name]


class _Type:
    """A NumPy type of plain numbers, by a code such as "f4". Unpickling then sets the byte order by ``__setstate__``."""

    __slots__ = ("dtype",)

    def __init__(self, code: object) -> None:
        if not isinstance(code, str) or not re.fullmatch(r"[<>=|]?(b1|[iu][1248]|f[248])", code):
            raise ValueError(f"NumPy type {str(code)[:20]!r}, where plain real numbers belong")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: tuple[object, ...]) -> None:
        self.dtype = self.dtype.newbyteorder(str(state[1]))  # type: ignore[arg-type]


class _Array(np.ndarray):
    """An array that takes its data only if the file holds exactly as many bytes as the shape needs."""

    def __setstate__(self, state: Any) -> None:
        _, shape, stated, is_fortran, raw = state
        raw = raw.encode("latin1") if isinstance(raw, str) else raw
        if not isinstance(stated, _Type) or not isinstance(raw, (bytes, bytearray)):
            raise ValueError("an array without numbers")
        if not isinstance(shape, tuple) or len(shape) > 8 or any(type(n) is not int or n < 0 for n in shape):
            raise ValueError("an array with an impossible shape")
        if math.prod(shape) * stated.dtype.itemsize != len(raw):
            raise ValueError(f"an array of shape {shape} in {len(raw)} bytes")
        super().__setstate__((1, shape, stated.dtype, bool(is_fortran), bytes(raw)))  # type: ignore[arg-type]


def _plain_array(raw: object, dtype: object, shape: object, order: object = "C") -> np.ndarray:
    array = _Array((0,))
    array.__setstate__((1, shape, dtype, order == "F", raw))
    return array


class _Geometry(SimpleNamespace):
    """Stands in for a ``tigre.geometry``: has its attributes, and runs none of TIGRE's code."""


def recognises_tigre(path: Path) -> bool:
    """Returns whether ``path`` is a pickle (by its suffix) with TIGRE's geometry."""
    return path.is_file() and path.suffix.lower() in (".pickle", ".pkl") and names_tigre(path)


def import_scan_tigre(path: Path, options: ImportOptions) -> Scan:
    """Imports a pickle of TIGRE: (projections, geometry, angles), or a dictionary of them."""
    content = read_pickle(path)
    if isinstance(content, dict):  # the first values whose keys begin with one of the words, upper case or lower
        content = tuple(
            next((value for name, value in content.items() if str(name).lower().startswith(words)), None)
            for words in (("proj", "frames"), ("geo",), ("angle", "theta"))
        )
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
        poses, panel, grid = poses_of_tigre(geo, np.asarray(angles), f"{path} ")
    except InputError as error:
        raise InputError(f"{path}: {error.subject}", error.found, error.expected, error.remedy) from error
    checks.shape(f"{path}: projections", frames, (len(poses), *panel))
    timing = make_timing(str(path), len(poses), options)
    angle_rad = np.asarray(angles, np.float64).reshape(len(poses), -1)[:, 0]
    trajectory, geometry = _trajectory(geo, poses, angle_rad, timing, str(path))
    turned = oriented(np.asarray(frames), options, "bottom")
    integrals = line_integrals(str(path), turned, options, convention="attenuation")
    return assemble_scan(integrals, trajectory, geometry, timing, options, path, grid=grid)


def _trajectory(
    geo: Any, poses: np.ndarray, angle_rad: np.ndarray, timing: Timing, subject: str
) -> tuple[CircularOrbit | PoseTable, Geometry]:
    """Returns trajectory and geometry. The trajectory is the circular orbit through ``angle_rad`` (F,) if this gives the
    ``poses`` (F, 12), else a table of the poses."""
    rows, columns = np.ravel(geo.nDetector).tolist()
    pitch_v, pitch_u = np.ravel(geo.dDetector).tolist()
    off_v, off_u = np.resize(0.0 if geo.offDetector is None else geo.offDetector, 2).tolist()
    is_parallel, sides = is_parallel_tigre(geo), ((rows, columns), (pitch_v, pitch_u), (off_v, off_u))
    if is_parallel:
        geometry: Geometry = ParallelGeometry(*sides)
    else:
        geometry = ConeGeometry(float(np.ravel(geo.DSO)[0]), float(np.ravel(geo.DSD)[0]), *sides)
    if np.allclose(geometry.pose(angle_rad), poses, rtol=0, atol=_SAME * np.abs(poses).max()):
        return turning(geometry, angle_rad, timing), geometry
    panel = geometry.detector_shape
    return table_over_time(lambda position: along(poses, position), timing, subject, panel, is_parallel)
