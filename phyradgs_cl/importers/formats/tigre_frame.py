"""TIGRE's frame, which R2-Gaussian, PhyRadGS and NAF share: projections [v, u] with row 0 at +z, volumes [x, y, z]."""

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.io.tables import Fields

ROW_0 = "top"


def read_geometry(scanner: Fields, unit_mm: float) -> ConeGeometry:
    """The cone of a scanner's table, lengths in ``unit_mm``; "Detector" values run [v, u], ``offDetector`` [u, v]."""
    mode = scanner.word("mode", default="cone")
    if mode != "cone":
        raise scanner.error("mode", repr(mode), "'cone'", "parallel beams have no source distance")
    to_axis, to_detector = scanner.length("DSO"), scanner.length("DSD")
    if to_detector <= to_axis:
        raise scanner.error("DSD", f"{to_detector:g}", f"more than DSO ({to_axis:g})")
    rows, columns = scanner.counts("nDetector", 2)
    pitch_v, pitch_u = (float(p * unit_mm) for p in pitches(scanner, "Detector", (rows, columns)))
    offset_u, offset_v = (float(o * unit_mm) for o in offset(scanner, "offDetector", 2))
    sides = (rows, columns), (pitch_v, pitch_u), (offset_v, offset_u)
    return ConeGeometry(to_axis * unit_mm, to_detector * unit_mm, *sides)


def read_grid(scanner: Fields, unit_mm: float) -> Grid:
    """The voxel grid of a scanner's table, whose triples run [x, y, z]."""
    counts = scanner.counts("nVoxel", 3)
    size = pitches(scanner, "Voxel", counts) * unit_mm
    origin = offset(scanner, "offOrigin", 3) * unit_mm
    return Grid(triple(counts[::-1]), triple(size[::-1].tolist()), triple(origin[::-1].tolist()))


def pitches(scanner: Fields, what: str, counts: tuple[int, ...]) -> np.ndarray:
    """Size of one pixel or voxel along each axis: dDetector or dVoxel, else the whole size over the count."""
    if scanner.has(f"d{what}"):
        return scanner.lengths(f"d{what}", len(counts))
    return scanner.lengths(f"s{what}", len(counts)) / np.array(counts)


def offset(scanner: Fields, key: str, count: int) -> np.ndarray:
    """(count,) lengths, 0 where the table has none; a third number of offDetector is not used."""
    if not scanner.has(key):
        return np.zeros(count)
    values = scanner.numbers(key)
    if len(values) < count:
        raise scanner.error(key, f"{len(values)} values", f"{count} numbers")
    return values[:count]


def turned_volume(subject: str, volume: np.ndarray, grid: Grid, per_mm: float) -> np.ndarray:
    """A stored volume [x, y, z] as (z, y, x) float32 in 1/mm."""
    checks.shape(subject, volume, grid.shape[::-1])
    checks.finite(subject, volume)
    turned = np.transpose(volume, (2, 1, 0)).astype(np.float64) * per_mm
    largest = float(np.abs(turned).max())
    if largest > float(np.finfo(np.float32).max):
        raise InputError(subject, f"a density of {largest:.3g} 1/mm", "one that float32 holds", "check the file")
    return np.ascontiguousarray(turned, np.float32)
