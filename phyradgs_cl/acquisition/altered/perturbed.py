"""Changes the panel, distances, timing and single views of a scan, to correct errors of its geometry or to simulate them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition.geometry import ConeGeometry
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.trajectory import CircularOrbit, DerivedTrajectory


@dataclass(frozen=True)
class GeometryCorrection:
    """Differences from a scan's stated geometry and timing. With all zeros the scan stays as stated.

    Offsets move the panel in its plane, along u and v. Roll rotates the panel in its plane; tilts rotate it about v or u
    through its middle. Distances move source and panel away from the axis. Times are added to readout and exposure. In all
    views, turn_rad rotates the scanner about the axis and lift_mm raises it, as if the object were turned or lowered."""

    offset_u_mm: float = 0.0
    offset_v_mm: float = 0.0
    roll_rad: float = 0.0
    tilt_v_rad: float = 0.0
    tilt_u_rad: float = 0.0
    source_distance_mm: float = 0.0
    detector_distance_mm: float = 0.0
    readout_s: float = 0.0
    exposure_s: float = 0.0
    turn_rad: float = 0.0
    lift_mm: float = 0.0


@dataclass(frozen=True, eq=False)
class Views:
    """Corrections of single views: turns (F,) about the axis in rad, and the panel's shifts (F, 2) along v and u in mm."""

    turn_rad: np.ndarray
    shift_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Sway:
    """A rigid motion of the object: rotations about x, y and z in rad, and shifts along them in mm.

    All six are cubic splines of time from ``start_s`` to ``end_s``, with coefficients (n, 6), n at least 4. Before and after
    this interval they are constant."""

    coefficients: np.ndarray
    start_s: float
    end_s: float

    @classmethod
    def none(cls, scan: Scan, count: int) -> "Sway":
        """Returns an object at rest: ``count`` splines, at least 4, over the duration of a scan, with coefficients of 0."""
        starts_s = np.asarray(scan.frame_start_s, np.float64)
        return cls(np.zeros((count, 6)), float(starts_s.min()), float(starts_s.max() + scan.shutter.span_s))

    def basis(self, time_s: np.ndarray) -> np.ndarray:
        """Returns the values (..., n) of all splines at times (...) in s."""
        return splines((np.asarray(time_s, np.float64) - self.start_s) / (self.end_s - self.start_s), len(self.coefficients))

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Returns the object's rotations in rad and shifts in mm, (..., 6), at times (...) in s."""
        return np.asarray(self.basis(time_s) @ self.coefficients)


def splines(fraction: np.ndarray, count: int) -> np.ndarray:
    """Returns the values (..., count) of ``count`` cubic B-splines at fractions (...) of their interval. Values sum to 1.

    count: at least 4. Fractions below 0 count as 0, and above 1 as 1."""
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
    basis: np.ndarray = BSpline.design_matrix(np.clip(np.ravel(fraction), 0, 1), knots, 3).toarray()
    return basis.reshape(*np.shape(fraction), count)


@dataclass(frozen=True, eq=False)
class PerturbedTrajectory(DerivedTrajectory):
    """Poses of ``base`` changed by ``correction``, for a panel of ``shape`` (rows, columns). ``views`` adds corrections of
    single views (``Views``) or a motion of the object (``Sway``)."""

    shape: tuple[int, int]
    correction: GeometryCorrection
    views: "Views | Sway | None" = None

    @cached_property
    def _turn(self) -> np.ndarray:
        """The panel's rotation (3, 3) by roll and tilts: its columns are the new u, v and normal in the stated axes."""
        angles_rad = [self.correction.tilt_u_rad, self.correction.tilt_v_rad, self.correction.roll_rad]
        return np.asarray(Rotation.from_rotvec(angles_rad).as_matrix())

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        shift_v_mm, shift_u_mm, turn_rad = 0.0, 0.0, self.correction.turn_rad
        if isinstance(self.views, Views):
            shift_v_mm, shift_u_mm = self.views.shift_mm[frame]
            turn_rad += float(self.views.turn_rad[frame])
        vectors = self._with_moved_panel(np.array(self.base.pose(frame, time_s)), shift_v_mm, shift_u_mm)
        if turn_rad:
            about_z = Rotation.from_rotvec([0.0, 0.0, turn_rad]).as_matrix()
            vectors = [vector @ about_z.T for vector in vectors]
        if isinstance(self.views, Sway):
            vectors = _seen_by(self.views.at(time_s), vectors, 1 if self.is_parallel else 2)
        return np.concatenate(vectors, -1)

    def _with_moved_panel(self, pose: np.ndarray, shift_v_mm: float, shift_u_mm: float) -> list[np.ndarray]:
        """Returns source (or direction), first pixel, column step and row step, each (..., 3), of poses (..., 12) after
        ``correction`` and a view's shifts of the panel along v and u."""
        correction = self.correction
        source, first, column, row = np.moveaxis(pose.reshape(*pose.shape[:-1], 4, 3), -2, 0)
        pitch_u_mm, pitch_v_mm = (np.linalg.norm(step, axis=-1, keepdims=True) for step in (column, row))
        u_hat, v_hat = column / pitch_u_mm, row / pitch_v_mm
        normal = np.cross(u_hat, v_hat)  # the panel's normal, which points towards the source
        half_v, half_u = ((n - 1) / 2 for n in self.shape)
        middle = first + half_u * column + half_v * row - correction.detector_distance_mm * normal
        middle = middle + (correction.offset_u_mm + shift_u_mm) * u_hat + (correction.offset_v_mm + shift_v_mm) * v_hat
        axes = np.stack([u_hat, v_hat, normal], -1)
        column, row = axes @ self._turn[:, 0] * pitch_u_mm, axes @ self._turn[:, 1] * pitch_v_mm
        lift_mm = np.array([0.0, 0.0, correction.lift_mm])
        middle = middle + lift_mm
        if not self.is_parallel:
            source = source + correction.source_distance_mm * normal + lift_mm
        return [source, middle - half_u * column - half_v * row, column, row]


def _seen_by(motion: np.ndarray, vectors: list[np.ndarray], places: int) -> list[np.ndarray]:
    """Returns a pose's four vectors (..., 3) in the coordinates of an object that has moved by ``motion`` (..., 6).

    places: the number of points among the vectors, which the shift moves: 2 for source and first pixel, or 1 if the first
    vector is a direction."""
    # Seen from an object that turns and shifts, the scanner shifts back, then turns back.
    back = Rotation.from_rotvec(motion[..., :3].reshape(-1, 3)).as_matrix().reshape(*motion.shape[:-1], 3, 3)
    shifted = np.stack(vectors, -2)
    shifted[..., 2 - places : 2, :] -= motion[..., None, 3:]
    return list(np.moveaxis(shifted @ back, -2, 0))


def perturb(scan: Scan, correction: GeometryCorrection, views: Views | Sway | None = None) -> Scan:
    """Returns the scan with its geometry and timing changed by ``correction``, and the same frames.

    A circular orbit stays one if only offsets, distances and times change. Any other change of poses, or ``views``, makes
    the trajectory a ``PerturbedTrajectory``."""
    shutter, geometry, trajectory = scan.shutter, scan.geometry, scan.trajectory
    source_mm = correction.source_distance_mm
    offset_v_mm, offset_u_mm = geometry.detector_offset_mm
    offset_mm = (offset_v_mm + correction.offset_v_mm, offset_u_mm + correction.offset_u_mm)
    geometry = replace(geometry, detector_offset_mm=offset_mm)
    if isinstance(geometry, ConeGeometry):
        geometry = replace(
            geometry, source_to_axis_mm=geometry.source_to_axis_mm + source_mm,
            source_to_detector_mm=geometry.source_to_detector_mm + source_mm + correction.detector_distance_mm,
        )
    turned = (correction.roll_rad, correction.tilt_v_rad, correction.tilt_u_rad, correction.turn_rad)
    of_poses = replace(correction, readout_s=0.0, exposure_s=0.0)
    if isinstance(trajectory, CircularOrbit) and not any((*turned, correction.lift_mm)) and views is None:
        trajectory = CircularOrbit(geometry, trajectory.kinematics)
    elif of_poses != GeometryCorrection() or views is not None:
        trajectory = PerturbedTrajectory(trajectory, geometry.detector_shape, correction, views)
    readout_s, exposure_s = shutter.readout_s + correction.readout_s, shutter.exposure_s + correction.exposure_s
    shutter = replace(shutter, readout_s=readout_s, exposure_s=exposure_s)
    return replace(scan, geometry=geometry, trajectory=trajectory, shutter=shutter)
