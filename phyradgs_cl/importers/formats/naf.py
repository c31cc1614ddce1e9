"""Pickles of NAF and SAX-NeRF: a dictionary of geometry (mm), projections (dimensionless) and true volume (1/m)."""

from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.importers.assemble import assemble_scan
from phyradgs_cl.importers.formats import r2_gaussian as tigre
from phyradgs_cl.importers.motion import make_timing, turning
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.reading.frames import line_integrals, oriented
from phyradgs_cl.importers.reading.pickle import read_pickle
from phyradgs_cl.io.tables import Fields, described

OPTIONS = (*TIMING, "detector_model", "part")
_PER_MM = 1e-3  # of a density per metre
_PARTS = {"train": ("train",), "test": ("val",), "all": ("train", "val")}


def recognises(path: Path) -> bool:
    """True for the suffix of a pickle."""
    return path.is_file() and path.suffix.lower() in (".pickle", ".pkl")


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the train (or val, or both) projections of a pickle."""
    options.refuse_unused("naf", OPTIONS)
    data = Fields(f"{path}:", read_pickle(path))
    geometry, grid = tigre.read_geometry(data, 1.0), tigre.read_grid(data, 1.0)
    frames, angle_rad = _frames(data, _PARTS[options.part], geometry.detector_shape)
    timing = make_timing(str(path), len(angle_rad), options)
    reference = None
    if data.has("image"):
        volume = _array(data, "image", 3)
        reference = tigre.turned_volume(data.name("image"), volume, grid, _PER_MM)
    frames = oriented(frames, options, tigre.ROW_0)
    integrals = line_integrals(str(path), frames, options, convention="attenuation")
    trajectory = turning(geometry, angle_rad, timing)
    return assemble_scan(
        integrals,
        trajectory,
        geometry,
        timing,
        options,
        title=path.stem,
        source=str(path),
        grid=grid,
        reference=reference,
    )


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
