"""Reads and writes deformations, alone or in a scan file. Also reads and writes a simulated scan's true volume and, if the
object moves, its deformation and its true volumes (states) at several times."""

from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, MovingTruth, triple
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.files import sha256_of
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.hdf5 import datasets as h5

DEFORMATION = "/entry/deformation"
_MEANS = "at time t the object has, at point y, the attenuation of the reference volume at y + sum_r weights_r(t) U_r(y)"


def write_deformation(path: str | Path, deformation: Deformation) -> None:
    """Writes a file with one deformation, completely or not at all. Raises OutputError where it cannot be written."""
    with h5.new_hdf5(path, deformation.control_mm.nbytes + deformation.weights.nbytes) as file:
        write_deformation_group(h5.new_group(file, "entry", "NXentry"), deformation)


def read_deformation(path: str | Path) -> Deformation:
    """Reads a deformation file, or the true deformation in a simulated scan. Raises InputError, about the HDF5 path, for
    missing values, wrong shapes, unknown units, values that are not finite, and a map that folds: one whose Jacobian has a
    determinant of 0 or less."""
    with open_hdf5(path) as source:
        in_scans = [f"{name}/{schema.DEFORMATION}" for name in source.groups()]
        places = [name for name in (DEFORMATION, *in_scans) if source.find(name) is not None]
        if not places:
            expected = f"a group {DEFORMATION}, or a scan simulated with --motion-of-object"
            raise source.error("/", "members: " + (", ".join(sorted(source.file)) or "nothing"), expected)
        return read_deformation_group(source, places[0])


def holds_deformation(path: str | Path) -> bool:
    """Returns whether a file has a deformation at /entry/deformation, as volumes of moving objects may have."""
    with open_hdf5(path) as source:
        return source.find(DEFORMATION) is not None


def deformation_summary(path: str | Path) -> dict[str, object]:
    """Returns what 'phyradgs info' prints about a deformation file, by name. Raises InputError as ``read_deformation``."""
    field = read_deformation(path)
    rank, nz, ny, nx, _ = field.control_mm.shape
    return {
        "fields": rank, "control_points": (nz, ny, nx), "control_spacing_mm": field.spacing_mm,
        "first_control_point_mm": field.origin_mm, "times": len(field.times_s),
        "first_s": float(field.times_s[0]), "last_s": float(field.times_s[-1]),
        "displacements_below_mm": float((np.abs(field.weights) @ field.reach_mm).max()),
        "smallest_determinant": field.smallest_determinant(), "sha256": sha256_of(path),
    }


def write_deformation_group(parent: h5py.Group, deformation: Deformation) -> None:
    """Writes a group ``deformation``: control points' vectors, origin and spacing in mm, times in s, and weights."""
    group = h5.new_group(parent, "deformation", "NXcollection")
    group.attrs["description"] = _MEANS
    h5.write_number(group, "control", deformation.control_mm, "mm", axes="field, z, y, x, component (x y z)")
    h5.write_number(group, "origin", deformation.origin_mm, "mm", axes="x, y, z")
    h5.write_number(group, "spacing", deformation.spacing_mm, "mm", axes="x, y, z")
    h5.write_number(group, "times", deformation.times_s, "s")
    h5.write_number(group, "weights", deformation.weights, axes="time, field")


def read_deformation_group(source: Hdf5Source, address: str) -> Deformation:
    """Reads the deformation in the group ``address``. Raises InputError as ``read_deformation`` does."""
    source.group(address)
    control_mm = h5.read_array(source, f"{address}/control", (None, None, None, None, 3), h5.LENGTH)
    origin_mm = h5.read_array(source, f"{address}/origin", (3,), h5.LENGTH)
    spacing_mm = h5.read_array(source, f"{address}/spacing", (3,), h5.LENGTH)
    times_s = h5.read_array(source, f"{address}/times", (None,), h5.TIME)
    weights = h5.read_array(source, f"{address}/weights", (len(times_s), len(control_mm)))
    try:
        deformation = Deformation(control_mm, triple(origin_mm.tolist()), triple(spacing_mm.tolist()), times_s, weights)
    except InputError as error:
        raise source.error(address, f"{error.subject}: {error.found}", error.expected, error.remedy) from error
    determinant = deformation.smallest_determinant()
    if not determinant > 0:
        found = f"matter that folds (the smallest determinant of the map is {determinant:.3g})"
        raise source.error(address, found, "determinants above 0", "use a smoother or smaller field")
    return deformation


def write_truth(extra: h5py.Group, scan: Scan) -> None:
    """Writes into the group ``reference`` the true volume, true states at several times and deformation that a scan has."""
    moving = scan.moving_truth
    if scan.reference is None and moving is None:
        return
    group = h5.new_group(extra, "reference", "NXcollection")
    if scan.reference is not None:
        write_packed(group, "volume", scan.reference)
    if moving is not None:
        write_packed(group, "states", moving.volumes)
        h5.write_number(group, "state_times", moving.times_s, "s")
        if moving.deformation is not None:
            write_deformation_group(group, moving.deformation)


def check_truth(source: Hdf5Source, entry: str, grid: Grid) -> tuple[bool, int]:
    """Returns whether the scan at ``entry`` has a true volume, and for how many times it has the object's true state. Raises
    InputError for shapes that do not fit the grid."""
    if source.optional_group(f"{entry}/{schema.REFERENCE}") is None:
        return False, 0
    volume, states, times = (f"{entry}/{name}" for name in (schema.TRUTH, schema.STATES, schema.STATE_TIMES))
    moves = source.optional(states) is not None or source.optional(times) is not None
    count = int(source.dataset(times).size) if moves else 0
    shapes: dict[str, tuple[int, ...]] = {states: (count, *grid.shape)} if moves else {}
    if not moves or source.optional(volume) is not None:
        shapes[volume] = grid.shape
    for address, expected in shapes.items():
        if (shape := source.dataset(address).shape) != expected:
            remedy = f"store the reference's own grid in {entry}/{schema.GRID}"
            raise source.error(address, f"shape {shape}", f"the grid's {expected}", remedy)
    return volume in shapes, count


def read_reference(source: Hdf5Source, entry: str) -> np.ndarray:
    """Reads the true volume (nz, ny, nx) float32 in 1/mm. Raises InputError for NaN, infinity, or no value above 0."""
    return _read_volumes(source, f"{entry}/{schema.TRUTH}")


def read_moving_truth(source: Hdf5Source, entry: str) -> MovingTruth:
    """Reads the true volumes of an object that moves, their times, and its deformation or None. Raises InputError as
    ``read_reference`` and ``read_deformation`` do."""
    times_s = h5.read_array(source, f"{entry}/{schema.STATE_TIMES}", (None,), h5.TIME)
    volumes = _read_volumes(source, f"{entry}/{schema.STATES}")
    address = f"{entry}/{schema.DEFORMATION}"
    moves = source.optional_group(address) is not None
    return MovingTruth(times_s, volumes, read_deformation_group(source, address) if moves else None)


def write_packed(group: h5py.Group, name: str, volumes: np.ndarray) -> None:
    """Writes volumes (..., z, y, x) in 1/mm as compressed float32."""
    dataset = group.create_dataset(name, data=np.asarray(volumes, np.float32), compression="gzip", shuffle=True)
    dataset.attrs["units"] = "1/mm"


def _read_volumes(source: Hdf5Source, address: str) -> np.ndarray:
    values = h5.read_attenuation(source, address, source.dataset(address))
    if values.max() <= 0:
        found = f"no voxel above 0 (the largest is {values.max() + 0.0:g})"
        raise source.error(address, found, "a truth to compare with", "take the reference out of the file")
    return values
