"""Trajectories: where source and panel are at any time, from the gantry's angle θ(t) or from measured poses."""

from dataclasses import dataclass, field, fields, replace
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import (
    GEOMETRIES,
    POSE_LENGTH,
    ConeGeometry,
    Geometry,
    ParallelGeometry,
    default_grid,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.text import repr_of_changes

_LEAST_INCIDENCE = 1e-6  # least sine of the angle between rays and panel
_AT_AXIS = 1e-6  # a panel within this fraction of the source-to-axis distance is at the axis
_AWAY = 2.0  # a panel at the axis is moved so that its distance from the source and its size grow by this factor
_SAME_PLACE = 1e-9  # poses that differ by less, relative to their largest number, are equal: float64 rounds by less


class Trajectory(Protocol):
    """The interface of a trajectory: poses (..., 12) in mm of a frame at times (...) in s.

    A user-defined class with this method works in every reconstruction method. ``save_scan`` stores it as a table of poses.
    A class for parallel beams must also have an attribute ``is_parallel`` that is True."""

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) in mm of frame number ``frame`` at times (...) s. A pose is source, centre of pixel (0,
        0), step to the next column, step to the next row, x y z each. In a parallel beam the rays' direction comes first."""


def is_parallel(trajectory: Trajectory) -> bool:
    """Returns whether the beam is parallel: the trajectory's attribute ``is_parallel``, or False if it has none."""
    return bool(getattr(trajectory, "is_parallel", False))


@dataclass(frozen=True, eq=False)
class DerivedTrajectory:
    """A trajectory whose poses are made from those of ``base``, a trajectory of the same beam."""

    base: Trajectory

    @property
    def is_parallel(self) -> bool:
        """True for a parallel beam."""
        return is_parallel(self.base)


@dataclass(frozen=True, eq=False)
class UserTrajectory(DerivedTrajectory):
    """A user-defined trajectory, ``base``, whose poses are checked whenever they are computed."""

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) in mm of frame number ``frame`` at times (...) s; directions of parallel rays have length
        1. Raises InputError for poses of another shape, for numbers that are not finite, and for rays along the panel."""
        times_s = np.asarray(time_s, np.float64)
        subject = f"trajectory {type(self.base).__name__}"
        poses = checks.numbers(subject, self.base.pose(frame, times_s.ravel()), (times_s.size, POSE_LENGTH))
        poses = unit_directions(subject, poses) if self.is_parallel else poses
        return poses.reshape(*times_s.shape, POSE_LENGTH)


def checked(trajectory: Trajectory) -> Trajectory:
    """Returns a trajectory of this package unchanged. Wraps a user-defined one in ``UserTrajectory``."""
    is_own = type(trajectory).__module__.startswith("phyradgs_cl.")
    return trajectory if is_own else UserTrajectory(trajectory)


class Kinematics(Protocol):
    """The interface of kinematics: the gantry's angles (...) of a frame at times (...) in s."""

    def angle_rad(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns angles (...) in rad of frame number ``frame`` at times (...) s, counterclockwise seen from above."""


@dataclass(frozen=True)
class ConstantSpeed:
    """A constant speed: θ(t) = ``angle_start_rad`` + ``speed_rad_per_s`` t. Raises InputError for infinite values or NaN."""

    angle_start_rad: float
    speed_rad_per_s: float

    def __post_init__(self) -> None:
        for one in fields(self):
            checks.numbers(one.name, getattr(self, one.name), ())

    def angle_rad(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns angles (...) in rad at times (...) s, the same in every frame."""
        return self.angle_start_rad + self.speed_rad_per_s * np.asarray(time_s, np.float64)


@dataclass(frozen=True)
class SpeedRamp(ConstantSpeed):
    """A gantry that speeds up or brakes by ``acceleration_rad_per_s2``: θ(t) = θ0 + ω t + ½ a t².

    ``angle_start_rad`` and ``speed_rad_per_s`` hold at time 0. Raises InputError for infinite values or NaN."""

    acceleration_rad_per_s2: float

    def angle_rad(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns angles (...) in rad at times (...) s, the same in every frame."""
        t = np.asarray(time_s, np.float64)
        return super().angle_rad(frame, t) + 0.5 * self.acceleration_rad_per_s2 * t * t


@dataclass(frozen=True, eq=False, repr=False)
class EncoderTable:
    """Measured θ(t): ``angle_rad_table`` (T,) in rad at ``time_s`` (T,) in s, linear in between.

    Jumps by a whole turn, as an encoder makes at 360°, are removed, unless at least half of the steps between samples are a
    quarter turn or more. Raises InputError for times that do not increase, and for times beyond the table."""

    time_s: np.ndarray
    angle_rad_table: "NDArray[np.float64]"
    subject: str = "encoder table"

    __repr__ = repr_of_changes

    def __post_init__(self) -> None:
        wanted = "two equal 1D arrays of at least 2 samples"
        time_s, table = _checked_table(self.subject, self.time_s, self.angle_rad_table, (), "angles", wanted)
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "angle_rad_table", table if _is_without_jumps(np.diff(table)) else np.unwrap(table))

    def angle_rad(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns angles (...) in rad at times (...) s, the same in every frame. Raises InputError beyond the table."""
        t = np.asarray(time_s, np.float64)
        _check_covered(self.subject, frame, t, self.time_s)
        return np.interp(t, self.time_s, self.angle_rad_table)


@dataclass(frozen=True, eq=False, repr=False)
class FrameSweeps:
    """A constant speed in each frame, given by the gantry's angles at start and end of the exposure of the first line.

    The speed continues through the readout. Equal angles mean a gantry at rest (stop-and-shoot). ``start_s`` (F,): when
    each frame's first line opens, in s. ``exposure_s``: the exposure of a line. ``angle_start_rad``, ``angle_end_rad``
    (F,) in rad. A jump by a turn between the two angles of a frame, as from 355° to 4°, is removed, unless the gantry
    turns by a quarter turn or more in at least half of the frames.

    Raises InputError for arrays of unequal length, infinite values and NaN."""

    start_s: np.ndarray
    exposure_s: float
    angle_start_rad: np.ndarray
    angle_end_rad: np.ndarray

    __repr__ = repr_of_changes

    def __post_init__(self) -> None:
        checks.at_least("exposure_s", self.exposure_s, 0)
        frames = np.size(self.start_s)
        for name in ("start_s", "angle_start_rad", "angle_end_rad"):
            object.__setattr__(self, name, checks.numbers(name, getattr(self, name), (frames,)))
        if not _is_without_jumps(arc_rad := self.angle_end_rad - self.angle_start_rad):
            nearest_rad = arc_rad - 2 * np.pi * np.round(arc_rad / (2 * np.pi))
            object.__setattr__(self, "angle_end_rad", self.angle_start_rad + nearest_rad)

    def angle_rad(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns angles (...) in rad of frame number ``frame`` at times (...) s."""
        t = np.asarray(time_s, np.float64)
        first, last = float(self.angle_start_rad[frame]), float(self.angle_end_rad[frame])
        if self.exposure_s <= 0:
            return np.full(t.shape, first)
        return first + (last - first) * (t - float(self.start_s[frame])) / self.exposure_s


def continued(trajectory: Trajectory, by_s: float) -> Trajectory:
    """Extends a circular orbit's encoder table by ``by_s`` at either end, with the speed at that end. Returns other
    trajectories unchanged."""
    if not (isinstance(trajectory, CircularOrbit) and isinstance(trajectory.kinematics, EncoderTable)):
        return trajectory
    table = trajectory.kinematics
    time_s, angle_rad = table.time_s, table.angle_rad_table
    speeds = (np.diff(angle_rad) / np.diff(time_s))[[0, -1]]
    beyond_s, beyond_rad = by_s * np.array([-1, 1]), by_s * np.array([-1, 1]) * speeds
    time_s, angle_rad = (
        np.concatenate([inner[:1] + outer[:1], inner, inner[-1:] + outer[1:]])
        for inner, outer in ((time_s, beyond_s), (angle_rad, beyond_rad))
    )
    return replace(trajectory, kinematics=EncoderTable(time_s, angle_rad, table.subject))


def _is_without_jumps(steps_rad: np.ndarray) -> bool:
    """Returns whether no step (N,) of angles counts as a jump by a turn: none exceeds half a turn, or at least half of them
    are a quarter turn or more."""
    size_rad = np.abs(steps_rad)
    return bool(size_rad.max(initial=0) <= np.pi or np.median(size_rad) >= np.pi / 2)


def unwrapped(angles: np.ndarray, turn: float = 2 * np.pi) -> np.ndarray:
    """Returns gantry angles (N,) without jumps by a ``turn``, as an encoder makes at 360°. Angles that only rise or only
    fall, by more than a turn in all, have no jumps: they stay as they are, even with steps of more than half a turn."""
    steps = np.diff(angles)
    counts_on = np.ptp(angles) > turn and ((steps > 0).all() or (steps < 0).all())
    return np.asarray(angles if counts_on else np.unwrap(angles, period=turn))


@dataclass(frozen=True, eq=False)
class CircularOrbit:
    """A circular orbit: a ``geometry`` in mm at the angles of ``kinematics``, anything with angle_rad(frame, time_s).

    Raises InputError for other objects."""

    geometry: "Geometry"
    kinematics: Kinematics

    def __post_init__(self) -> None:
        if not isinstance(self.geometry, GEOMETRIES):
            raise InputError("geometry", checks.short_repr(self.geometry), "a ConeGeometry or a ParallelGeometry")
        if not callable(getattr(self.kinematics, "angle_rad", None)):
            raise InputError("kinematics", checks.short_repr(self.kinematics), "anything with angle_rad(frame, time_s)")

    @property
    def is_parallel(self) -> bool:
        """True for a parallel beam."""
        return isinstance(self.geometry, ParallelGeometry)

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) in mm of frame number ``frame`` at times (...) s."""
        return self.geometry.pose(self.angle_rad(frame, time_s))

    def angle_rad(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns angles (...) in rad of frame number ``frame`` at times (...) s. Raises InputError if the kinematics return
        another shape, or numbers that are not finite."""
        subject = f"kinematics {type(self.kinematics).__name__}"
        return checks.numbers(subject, self.kinematics.angle_rad(frame, time_s), np.shape(time_s))


@dataclass(frozen=True, eq=False, repr=False)
class PoseTable:
    """An arbitrary trajectory: poses ``table`` (T, 12) in mm at ``time_s`` (T,) in s, interpolated as a rigid body.

    A pose is source, centre of pixel (0, 0), step to the next column, step to the next row, x y z each. With
    ``is_parallel`` it begins with the direction of the rays, of any length, in place of the source.
    The panel's rotation is interpolated by slerp, and the rest linearly in axes that turn with the panel. Linear
    interpolation in world coordinates would shrink an orbit (by 1 mm at 1 m over 5°).
    Raises InputError for times that do not increase, steps that span no panel, and times beyond the table."""

    time_s: np.ndarray
    table: np.ndarray
    subject: str = "pose table"
    is_parallel: bool = False
    _in_body: np.ndarray = field(init=False, repr=False)
    _turns: "scipy.spatial.transform.Slerp" = field(init=False, repr=False)

    __repr__ = repr_of_changes

    def __post_init__(self) -> None:
        checks.flag("is_parallel", self.is_parallel)
        expected, row = "times (T,) and poses (T, 12), T at least 2", (POSE_LENGTH,)
        time_s, table = _checked_table(self.subject, self.time_s, self.table, row, "poses", expected)
        normal = np.cross(table[:, 6:9], table[:, 9:12])
        if np.any(np.linalg.norm(normal, axis=1) <= 0):
            raise InputError(self.subject, "parallel pixel steps", "û·du and v̂·dv that span a plane")
        object.__setattr__(self, "time_s", time_s)
        if self.is_parallel:
            table = unit_directions(self.subject, table)
        object.__setattr__(self, "table", table)
        frames = body_frames(table)
        # In axes that turn with the panel a pose hardly changes, so linear interpolation is exact enough.
        in_body = np.einsum("tji,tkj->tki", frames, table.reshape(-1, 4, 3)).reshape(-1, POSE_LENGTH)
        object.__setattr__(self, "_in_body", in_body)
        turns = scipy.spatial.transform.Rotation.from_matrix(frames)
        object.__setattr__(self, "_turns", scipy.spatial.transform.Slerp(time_s, turns))

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) in mm at times (...) s, the same in every frame. Raises InputError beyond the table."""
        t = np.asarray(time_s, np.float64)
        _check_covered(self.subject, frame, t, self.time_s)
        flat = np.clip(t.ravel(), self.time_s[0], self.time_s[-1])  # Slerp refuses times beyond the table
        body = np.stack([np.interp(flat, self.time_s, column) for column in self._in_body.T], -1).reshape(-1, 4, 3)
        turn = self._turns(flat).as_matrix()
        turned: np.ndarray = np.einsum("tij,tkj->tki", turn, body)
        return turned.reshape(*t.shape, POSE_LENGTH)


def unit_directions(subject: str, poses: np.ndarray) -> np.ndarray:
    """Returns a parallel beam's poses (F, 12) with directions of length 1. Raises InputError if a direction has length 0 or
    runs along the panel."""
    length = np.linalg.norm(poses[:, :3], axis=1)
    across = np.cross(poses[:, 6:9], poses[:, 9:12])
    towards = np.abs(np.einsum("ci,ci->c", across, poses[:, :3]))
    if (towards <= _LEAST_INCIDENCE * length * np.linalg.norm(across, axis=1)).any():
        found = "a direction of rays that runs along the panel, or of length 0"
        raise InputError(subject, found, "rays that cross the panel")
    return np.concatenate([poses[:, :3] / length[:, None], poses[:, 3:]], 1)


def resting_poses(
    poses: np.ndarray, middle_s: np.ndarray, span_s: float, subject: str = "poses", is_parallel: bool = False
) -> PoseTable:
    """Returns a pose table for a gantry that stops for every frame. Each of the poses (F, 12) holds from half of ``span_s``
    (at least 0.25 s) before ``middle_s`` (F,) to as long after it."""
    half_s = max(span_s / 2, 0.25) * (1 - 1e-10)  # successive frames must not share a time
    time_s = np.stack([middle_s - half_s, middle_s + half_s], -1).ravel()
    return PoseTable(time_s, np.repeat(poses, 2, axis=0), subject, is_parallel)


def resting_trajectory(geometry: Geometry, poses: np.ndarray, middle_s: np.ndarray) -> CircularOrbit | PoseTable:
    """Returns the trajectory of a gantry that rests at ``poses`` (F, 12) in mm, each at its time ``middle_s`` (F,): a
    circular orbit if ``geometry`` has these poses at some angles, else a pose table."""
    is_parallel = isinstance(geometry, ParallelGeometry)
    side = -1 if is_parallel else 1  # a pose begins with the source or, in a parallel beam, with the direction away from it
    angle_rad = np.arctan2(side * poses[:, 1], side * poses[:, 0])
    if np.allclose(geometry.pose(angle_rad), poses, rtol=0, atol=_SAME_PLACE * np.abs(poses).max()):
        return CircularOrbit(geometry, FrameSweeps(middle_s, 0.0, angle_rad, angle_rad))
    return resting_poses(poses, middle_s, 0.0, is_parallel=is_parallel)


def behind_axis(geometry: Geometry, trajectory: Trajectory) -> tuple[Geometry, Trajectory]:
    """Returns geometry and trajectory with a panel at the axis moved away from the source, enlarged to see the same rays.

    Some programs state a panel scaled to the axis. Rays end at the panel, so they would end within the object.
    User-defined trajectories and panels elsewhere stay as they are."""
    if not isinstance(geometry, ConeGeometry):
        return geometry, trajectory
    if geometry.source_to_detector_mm > (1 + _AT_AXIS) * geometry.source_to_axis_mm:
        return geometry, trajectory
    scaled = replace(geometry.scaled(_AWAY), source_to_axis_mm=geometry.source_to_axis_mm)
    if isinstance(trajectory, CircularOrbit):
        return scaled, replace(trajectory, geometry=scaled)
    if not isinstance(trajectory, PoseTable) or _is_off_axis(trajectory.table):
        return geometry, trajectory
    table = trajectory.table.copy()
    table[:, 3:6] = table[:, :3] + _AWAY * (table[:, 3:6] - table[:, :3])
    table[:, 6:] *= _AWAY
    return scaled, replace(trajectory, table=table)


def _is_off_axis(poses: np.ndarray) -> bool:
    """Returns whether the panel's plane misses the origin in any of the poses (T, 12)."""
    normal = body_frames(poses)[..., 2]
    from_axis_mm = np.abs(np.einsum("ti,ti->t", poses[:, 3:6], normal))
    return bool((from_axis_mm > _AT_AXIS * np.linalg.norm(poses[:, :3], axis=1)).any())


def grid_of_scan(geometry: Geometry, trajectory: Trajectory, frame_start_s: np.ndarray) -> Grid:
    """Returns the grid of the field of view (``default_grid``), longer if the gantry travels along z."""
    if isinstance(trajectory, CircularOrbit):
        return default_grid(geometry)
    poses = [trajectory.pose(f, np.array([t])) for f, t in enumerate(frame_start_s)]
    return default_grid(geometry, np.concatenate(poses))


def _checked_table(
    subject: str, times: np.ndarray, rows: np.ndarray, row: tuple[int, ...], what: str, expected: str
) -> tuple[np.ndarray, np.ndarray]:
    """Returns times (T,) and rows (T, *row), T at least 2, as float64. ``subject``, ``what`` and ``expected`` are words of
    messages. Raises InputError for times that do not increase, other shapes, and numbers that are not finite."""
    time_s, table = checks.numbers(f"{subject} times", times), checks.numbers(f"{subject} {what}", rows)
    if time_s.ndim != 1 or time_s.size < 2 or table.shape != (time_s.size, *row):
        raise InputError(subject, f"shapes {time_s.shape} and {table.shape}", expected)
    if np.any(np.diff(time_s) <= 0):
        raise InputError(subject, "times that do not increase", "strictly increasing times in s")
    return time_s, table


def body_frames(table: np.ndarray) -> np.ndarray:
    """Returns orthonormal right-handed axes (T, 3, 3) of the panels of poses (T, 12), with columns û, v̂ and normal."""
    u_hat = table[:, 6:9] / np.linalg.norm(table[:, 6:9], axis=1, keepdims=True)
    normal = np.cross(u_hat, table[:, 9:12])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([u_hat, np.cross(normal, u_hat), normal], -1)


def _check_covered(subject: str, frame: int, t: np.ndarray, table_s: np.ndarray) -> None:
    """Raises InputError for times (...) in s beyond a table's times ``table_s``. Tolerates the rounding of stored times: a
    billionth of the table's last time, at least 1 ns."""
    slack = 1e-9 * max(1.0, abs(table_s[-1]))
    if t.size and (t.min() < table_s[0] - slack or t.max() > table_s[-1] + slack):
        found = f"frame {frame} needs {t.min():.6g} to {t.max():.6g} s"
        expected = f"a table that covers it (it runs from {table_s[0]:.6g} to {table_s[-1]:.6g} s)"
        raise InputError(subject, found, expected, "extend the table or drop the frame; are both in s?")
