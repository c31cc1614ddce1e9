"""Converts geometries of ASTRA and TIGRE to poses and back, without either package.

ASTRA's ``cone_vec`` (F, 12) is source, centre of the panel, step from column to column, step from row to row, x y z each;
``parallel3d_vec`` begins with the direction of the rays.
TIGRE's cone equals ours: source at (DSO cos α, DSO sin α, 0), columns along the turn, row 0 the lowest. Its pairs run (v,
u), its triples (z, y, x), and ``COR`` shifts source and panel along the columns. Both put the rotation axis along z."""

import logging
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import POSE_LENGTH, ConeGeometry, ParallelGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple

log = logging.getLogger(__name__)
_MOST_RAD = 20 * np.pi  # ten turns


def poses_of_astra(vectors: ArrayLike, panel: tuple[int, int]) -> np.ndarray:
    """Returns poses (F, 12) for ``cone_vec`` rows (F, 12) in mm and a panel (rows, columns)."""
    table = checks.numbers("vectors", vectors, (None, POSE_LENGTH))
    pose: np.ndarray = table.copy()
    pose[:, 3:6] -= _to_middle(pose, panel)
    return pose


def astra_of_poses(pose: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
    """Inverts ``poses_of_astra``."""
    vectors = np.array(pose, np.float64)
    vectors[:, 3:6] += _to_middle(vectors, panel)
    return vectors


def _to_middle(pose: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
    """Returns the vector (F, 3) from the centre of pixel (0, 0) to that of the panel."""
    rows, columns = panel
    return np.asarray((columns - 1) / 2 * pose[:, 6:9] + (rows - 1) / 2 * pose[:, 9:12])


def poses_of_tigre(geo: Any, angles_rad: ArrayLike) -> tuple[np.ndarray, tuple[int, int], Grid]:
    """Returns poses (F, 12), the panel (rows, columns) and the grid of a TIGRE geometry.

    angles_rad: (F,), or Euler angles (F, 3). Raises InputError for geometries that a scan cannot hold: a turned panel, a
    second or third Euler angle, a volume that moves; and for attributes that are missing or not numbers."""
    if getattr(geo, "mode", None) not in (None, "cone", "parallel"):
        raise InputError("geo.mode", checks.short_repr(geo.mode), "'cone' or 'parallel'")
    angles = np.asarray(angles_rad)
    angles = checks.numbers("angles", angles_rad, (None, 3) if angles.ndim == 2 else (None,))
    if angles.ndim == 2:
        _refuse("angles", angles[:, 1:], "turns about z only: (F,), or (F, 3) with zeros behind the first")
        angles = angles[:, 0]
    if angles.size and np.ptp(angles) > _MOST_RAD:
        text = "angles: %d frames over %.4g rad: are they degrees? np.deg2rad(angles)"
        log.warning(text, len(angles), np.ptp(angles))
    frames = len(angles)
    _refuse("geo.rotDetector", _each(geo, "rotDetector", frames, 3, 0.0), "zeros: a panel that is not turned")
    offset_mm = _each(geo, "offOrigin", frames, 3, 0.0)
    _refuse("geo.offOrigin", offset_mm - offset_mm[0], "one offset (z, y, x) for all frames")
    rows, columns = (int(n) for n in _counts(geo, "nDetector", 2))
    counts, voxel_mm = _counts(geo, "nVoxel", 3), checks.numbers("geo.dVoxel", _of(geo, "dVoxel"), (3,))
    grid = Grid(triple(int(n) for n in counts), triple(voxel_mm.tolist()), triple(offset_mm[0].tolist()))
    pitch_v, pitch_u = checks.numbers("geo.dDetector", _of(geo, "dDetector"), (2,)).tolist()
    shift = _each(geo, "COR", frames, 1, 0.0)[:, 0]
    offset_v, offset_u = _each(geo, "offDetector", frames, 2, 0.0).T
    poses = np.empty((frames, POSE_LENGTH))
    if is_parallel_tigre(geo):
        for i, angle in enumerate(angles):
            offset = float(offset_v[i]), float(offset_u[i]) + float(shift[i])
            poses[i] = ParallelGeometry((rows, columns), (pitch_v, pitch_u), offset).pose(angle)
        return poses, (rows, columns), grid
    to_axis, to_panel = (_each(geo, name, frames, 1, 0.0)[:, 0] for name in ("DSO", "DSD"))
    for i, angle in enumerate(angles):
        lengths, offset = (float(to_axis[i]), float(to_panel[i])), (float(offset_v[i]), float(offset_u[i]))
        poses[i] = ConeGeometry(*lengths, (rows, columns), (pitch_v, pitch_u), offset).pose(angle)
        poses[i, :6] += np.tile(shift[i] * poses[i, 6:9] / pitch_u, 2)
    return poses, (rows, columns), grid


def is_parallel_tigre(geo: Any) -> bool:
    """True for a TIGRE geometry of parallel beams."""
    return bool(getattr(geo, "mode", None) == "parallel")


def _of(geo: Any, name: str) -> Any:
    """Returns an attribute of a TIGRE geometry. Raises InputError where it is missing."""
    if getattr(geo, name, None) is None:
        raise InputError(f"geo.{name}", "nothing", "TIGRE's attribute of this name", f"set geo.{name}")
    return getattr(geo, name)


def _counts(geo: Any, name: str, length: int) -> np.ndarray:
    counts = checks.numbers(f"geo.{name}", _of(geo, name), (length,))
    if (counts < 1).any() or (counts != np.floor(counts)).any():
        raise InputError(f"geo.{name}", checks.short_repr(counts.tolist()), f"{length} whole numbers of at least 1")
    return counts


def _each(geo: Any, name: str, frames: int, length: int, absent: float) -> np.ndarray:
    """Returns an attribute (F, length) for every frame, from one for all or one each; ``absent`` where it is missing."""
    value = _of(geo, name) if name in ("DSO", "DSD") else getattr(geo, name, None)
    table = checks.numbers(f"geo.{name}", absent if value is None else value)
    per_frame = (frames,) if length == 1 else (frames, length)
    if table.shape in ((), (1,), (length,)):
        return np.broadcast_to(table, (frames, length))
    if table.shape not in (per_frame, (frames, length)):
        raise InputError(f"geo.{name}", f"shape {table.shape}", f"{length} for all frames, or shape {per_frame}")
    return table.reshape(frames, length)


def _refuse(subject: str, values: np.ndarray, expected: str) -> None:
    if np.any(values):
        raise InputError(subject, checks.short_repr(float(values[np.nonzero(values)][0])), expected)
