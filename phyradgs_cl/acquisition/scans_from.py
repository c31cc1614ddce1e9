"""Makes stop-and-shoot scans from poses and from the geometries of ASTRA and TIGRE, without either package.

ASTRA's ``cone_vec`` (F, 12) is source, centre of the panel, step to the next column, step to the next row, x y z each.
``parallel3d_vec`` begins with the direction of the rays. TIGRE's cone beam has our conventions: the source is at
(DSO cos α, DSO sin α, 0), columns rise in the direction of the turn, row 0 is the lowest. TIGRE's pairs are (v, u), its
triples (z, y, x). ``COR`` shifts source and panel in the direction of columns. In both packages z is the rotation axis."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import (
    POSE_LENGTH,
    ConeGeometry,
    ParallelGeometry,
    default_grid,
    plain_geometry,
)
from phyradgs_cl.acquisition.plausible import FEW, OPAQUE, question_unit
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import resting_trajectory, unit_directions
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.text import suggest_name

if TYPE_CHECKING:
    from phyradgs_cl.acquisition.scan import Scan

# The fields of ``Scan`` that the makers of scans take as further keywords.
_OTHERS = ("detector_model", "pixel_mask", "reference", "title", "lag", "provenance")


def from_poses(
    cls: "type[Scan]", /, frames: "ArrayLike", poses: "ArrayLike", grid: Grid | None = None, *,
    is_parallel: bool = False, **others: Any,
) -> "Scan":
    """Makes a stop-and-shoot scan with one pose for every frame.

    frames (F, rows, columns): line integrals. poses (F, 12) in mm: source, centre of pixel (0, 0), step to the next column,
    step to the next row, x y z each. With ``is_parallel`` they begin with the direction of the rays, of any length, in place
    of the source. grid: None takes the field of view of a full turn, longer if the poses travel along z. others: the fields
    detector_model, pixel_mask, reference, title, lag and provenance of ``Scan``.

    Raises InputError for shapes that do not fit, raw counts, and poses from which no ray meets the grid."""
    checks.flag("is_parallel", is_parallel)
    values = _uncounted(frames, others.get("pixel_mask"))
    checks.shape("frames", values, (None, None, None))
    table = checks.numbers("poses", poses, (len(values), POSE_LENGTH))
    if (np.linalg.norm(np.cross(table[:, 6:9], table[:, 9:12]), axis=1) <= 0).any():
        raise InputError("poses", "parallel pixel steps", "steps along columns and rows that span a panel")
    panel = (values.shape[1], values.shape[2])
    if is_parallel:
        table = unit_directions("poses", table)
    geometry = plain_geometry(table, panel, is_parallel)
    shutter, start_s = Shutter(0.0), np.arange(len(values), dtype=np.float64)
    trajectory = resting_trajectory(geometry, table, start_s)
    check_others(others)
    grid = grid or default_grid(geometry, table)
    scan = cls(values, geometry, trajectory, shutter, start_s, grid, False, **others)
    scan.check_sight()
    return scan


def from_astra(
    cls: "type[Scan]", /, frames: "ArrayLike", vectors: "ArrayLike", grid: Grid | None = None, *,
    is_parallel: bool = False, **others: Any,
) -> "Scan":
    """Makes a stop-and-shoot scan from an ASTRA geometry ``cone_vec`` or ``parallel3d_vec``. Inverse: ``astra_vectors``.

    frames (F, rows, columns): line integrals. ASTRA's order is (rows, F, columns): give ``sinogram.swapaxes(0, 1)``. vectors
    (F, 12) in mm: source, centre of the panel, step to the next column, step to the next row. is_parallel: the vectors are
    those of ``parallel3d_vec``, which begin with the direction of the rays. grid, others: as in ``from_poses``. Raises
    InputError for shapes that do not fit."""
    values, table = _uncounted(frames, others.get("pixel_mask")), checks.real_array("vectors", vectors)
    checks.shape("vectors", table, (None, POSE_LENGTH))
    if values.ndim == 3 and len(values) != len(table) == values.shape[1]:
        remedy = "ASTRA's order is (rows, frames, columns): give frames.swapaxes(0, 1)"
        raise InputError("frames", f"shape {values.shape}", f"({len(table)}, rows, columns)", remedy)
    checks.shape("frames", values, (len(table), None, None))
    panel = values.shape[1], values.shape[2]
    return cls.from_poses(values, poses_of_astra(table, panel), grid, is_parallel=is_parallel, **others)


def from_tigre(cls: "type[Scan]", /, geo: Any, angles: "ArrayLike", frames: "ArrayLike", **others: Any) -> "Scan":
    """Makes a stop-and-shoot scan from a TIGRE geometry. TIGRE need not be installed.

    geo: anything with TIGRE's attributes in mm: DSD, DSO (not needed for geo.mode "parallel"), nDetector, dDetector (v, u),
    nVoxel, dVoxel (z, y, x). Optional are offDetector (v, u), offOrigin (z, y, x) and COR, each for all frames or per frame.
    angles in radians: (F,), or Euler angles (F, 3) with zeros after the first. frames (F, v, u): line integrals as TIGRE's
    ``Ax`` gives them. others: fields of ``Scan``.

    Raises InputError for a turned panel, and for attributes that are missing or do not fit."""
    check_others(others)
    poses, panel, grid = poses_of_tigre(geo, angles)
    checks.shape("frames", frames, (len(poses), *panel))
    return cls.from_poses(frames, poses, grid, is_parallel=is_parallel_tigre(geo), **others)


def astra_vectors(scan: "Scan") -> np.ndarray:
    """Returns ASTRA's ``cone_vec`` or ``parallel3d_vec`` (F, 12) in mm, for the middle of each frame's exposure.

    Inverse: ``from_astra``. ASTRA takes frames as (rows, F, columns): give it ``scan.projections.swapaxes(0, 1)``. Its
    volumes are (z, y, x), as here."""
    times_s = scan.middle_times_s
    vectors = np.stack([scan.trajectory.pose(f, np.array(t)) for f, t in enumerate(times_s)]).astype(np.float64)
    vectors[:, 3:6] += _to_middle(vectors, scan.geometry.detector_shape)
    return vectors


def check_others(others: Iterable[str], arguments: Iterable[str] = ()) -> None:
    """Raises InputError for a keyword among ``others`` that is no optional field of ``Scan``. arguments: further names that
    the message lists as allowed."""
    allowed = (*arguments, *_OTHERS)
    for name in others:
        if name not in _OTHERS:
            raise InputError(name, "no such option", ", ".join(allowed), suggest_name(name, allowed, "leave it out"))


def check_not_counts(frames: np.ndarray, remedy: str, mask: ArrayLike | None = None) -> None:
    """Raises InputError for frames that look like raw counts: integers, or more than 1 % of unmasked values above 50."""
    if frames.dtype.kind in "iu":
        raise InputError("frames", f"whole numbers ({frames.dtype}) without flats", "line integrals", remedy)
    opaque, used = frames > OPAQUE, np.ones(frames.shape, bool)
    if mask is not None and np.shape(mask) in (frames.shape, frames.shape[1:]):
        used &= np.asarray(mask) == 0
        opaque &= used
    if np.count_nonzero(opaque) > FEW * np.count_nonzero(used):
        found = f"values of up to {frames[opaque].max():g} without flats"
        raise InputError("frames", found, f"line integrals, which are below {OPAQUE:g}", remedy)


def _uncounted(frames: ArrayLike, mask: np.ndarray | None) -> np.ndarray:
    """Returns frames as ``line_integrals`` does. Raises InputError also for frames that look like raw counts, since the user
    does not state their quantity."""
    values = checks.real_array("frames", frames)
    check_not_counts(values, "give −ln(counts / flats)", mask)
    return line_integrals(values, mask)


def line_integrals(frames: ArrayLike, mask: np.ndarray | None) -> np.ndarray:
    """Returns frames as float32, with 0 for masked pixels that are not finite. Raises InputError for unmasked pixels that
    are not finite."""
    values = checks.real_array("projections", frames)
    with np.errstate(over="ignore"):
        values = values.astype(np.float32, copy=False)
    if not all(np.isfinite(frame).all() for frame in values):  # frame by frame, which needs little memory
        if mask is not None and np.shape(mask) in (values.shape, values.shape[1:]):
            values = np.where((np.asarray(mask) != 0) & ~np.isfinite(values), np.float32(0), values)
        checks.finite("projections", values)
    return values


def poses_of_astra(vectors: ArrayLike, panel: tuple[int, int]) -> np.ndarray:
    """Converts ASTRA's vectors (F, 12) in mm, which state the centre of a panel (rows, columns), to poses (F, 12) in mm,
    which state its first pixel."""
    table = checks.numbers("vectors", vectors, (None, POSE_LENGTH))
    pose: np.ndarray = table.copy()
    pose[:, 3:6] -= _to_middle(pose, panel)
    return pose


def _to_middle(pose: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
    """Returns the vector (F, 3) from the centre of pixel (0, 0) to the panel's centre."""
    rows, columns = panel
    return np.asarray((columns - 1) / 2 * pose[:, 6:9] + (rows - 1) / 2 * pose[:, 9:12])


def poses_of_tigre(geo: Any, angles_rad: ArrayLike, subject: str = "") -> tuple[np.ndarray, tuple[int, int], Grid]:
    """Returns poses (F, 12), the panel (rows, columns) and the grid of a TIGRE geometry. Warnings begin with ``subject``.

    angles_rad: (F,), or Euler angles (F, 3). Raises InputError for attributes that are missing or no numbers, and for
    features that a ``Scan`` lacks: a turned panel, a second or third Euler angle, a volume that moves."""
    if getattr(geo, "mode", None) not in (None, "cone", "parallel"):
        raise InputError("geo.mode", checks.short_repr(geo.mode), "'cone' or 'parallel'")
    angles = checks.real_array("angles", angles_rad)
    angles = checks.numbers("angles", angles_rad, (None, 3) if angles.ndim == 2 else (None,))
    if angles.ndim == 2:
        _refuse("angles", angles[:, 1:], "turns about z only: (F,), or (F, 3) with zeros behind the first")
        angles = angles[:, 0]
    question_unit(angles, f"{subject}angles", "rad")
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
    """Returns whether a TIGRE geometry has a parallel beam."""
    return bool(getattr(geo, "mode", None) == "parallel")


def _of(geo: Any, name: str) -> Any:
    if getattr(geo, name, None) is None:
        raise InputError(f"geo.{name}", "nothing", "TIGRE's attribute of this name", f"set geo.{name}")
    return getattr(geo, name)


def _counts(geo: Any, name: str, length: int) -> np.ndarray:
    counts = checks.numbers(f"geo.{name}", _of(geo, name), (length,))
    if (counts < 1).any() or (counts != np.floor(counts)).any():
        raise InputError(f"geo.{name}", checks.short_repr(counts.tolist()), f"{length} whole numbers of at least 1")
    return counts


def _each(geo: Any, name: str, frames: int, length: int, absent: float) -> np.ndarray:
    """Returns the attribute ``name`` of a TIGRE geometry, which has ``length`` numbers for all frames or for each, as (F,
    length). A missing attribute counts as ``absent``. Raises InputError if DSO or DSD is missing, and for other shapes."""
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
