"""A scan whose panel, distances, timing and single views differ from what it says of itself."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.acquisition.scan import LARGEST_LAG
from phyradgs_cl.acquisition.trajectory import Trajectory


@dataclass(frozen=True)
class Change:
    """What is different, in the order of docs/calibrate.md; all 0 is the scan as stated.

    Shifts of the panel in its own columns and rows, its turns about its middle (roll in its plane, tilts about v and u),
    source and panel further from the axis, what is longer or later in time, more of the frame before that a panel shows, how
    much brighter (log) the beam gets from the first frame to the last, and a turn of all views about the axis, which no
    frame can tell from an object that is turned.
    """

    offset_u_mm: float = 0.0
    offset_v_mm: float = 0.0
    roll_rad: float = 0.0
    tilt_v_rad: float = 0.0
    tilt_u_rad: float = 0.0
    source_distance_mm: float = 0.0
    detector_distance_mm: float = 0.0
    readout_s: float = 0.0
    exposure_s: float = 0.0
    start_s: float = 0.0
    lag: float = 0.0
    drift: float = 0.0
    turn_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Views:
    """Per view of the file: turns about the axis (F,) in rad, shifts of the panel along v and u (F, 2) in mm."""

    turn_rad: np.ndarray
    shift_mm: np.ndarray

    @classmethod
    def none(cls, frames: int) -> "Views":
        return cls(np.zeros(frames), np.zeros((frames, 2)))


@dataclass(frozen=True, eq=False)
class Sway:
    """A rigid motion of the object: turns about x, y and z in rad, then shifts along them in mm, by cubic splines of time
    between ``start_s`` and ``end_s``, with coefficients (n, 6); before and after it stands still."""

    coefficients: np.ndarray
    start_s: float
    end_s: float

    @classmethod
    def none(cls, scan: Scan, count: int) -> "Sway":
        starts_s = np.asarray(scan.frame_start_s, np.float64)
        return cls(np.zeros((count, 6)), float(starts_s.min()), float(starts_s.max() + scan.shutter.span_s))

    def basis(self, time_s: np.ndarray) -> np.ndarray:
        """The splines (..., n) at times (...)."""
        return splines((np.asarray(time_s, np.float64) - self.start_s) / (self.end_s - self.start_s), len(self.coefficients))

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """The six numbers (..., 6) at times (...)."""
        six: np.ndarray = self.basis(time_s) @ self.coefficients
        return six


def splines(share: np.ndarray, count: int) -> np.ndarray:
    """Cubic splines (..., count) at shares (...) of a time, from 0 to 1; they sum to 1."""
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
    found = BSpline.design_matrix(np.clip(np.ravel(share), 0, 1), knots, 3).toarray()
    return found.reshape(*np.shape(share), count)


@dataclass(frozen=True, eq=False)
class Moved:
    """Poses of ``base`` for a panel of ``shape`` (rows, columns) after a change of all views, then of each by itself, or as
    an object that moves sees them."""

    base: Trajectory
    shape: tuple[int, int]
    change: Change
    views: "Views | Sway | None" = None

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Poses (..., 12) at times (...)."""
        pose, change = np.array(self.base.pose(frame, time_s)), self.change
        source, first, column, row = np.moveaxis(pose.reshape(*pose.shape[:-1], 4, 3), -2, 0)
        pitch_u_mm, pitch_v_mm = (np.linalg.norm(step, axis=-1, keepdims=True) for step in (column, row))
        u_hat, v_hat = column / pitch_u_mm, row / pitch_v_mm
        normal = np.cross(u_hat, v_hat)  # towards the source
        half_v, half_u = ((n - 1) / 2 for n in self.shape)
        shift_v_mm, shift_u_mm = self.views.shift_mm[frame] if isinstance(self.views, Views) else (0.0, 0.0)
        middle = first + half_u * column + half_v * row - change.detector_distance_mm * normal
        middle = middle + (change.offset_u_mm + shift_u_mm) * u_hat + (change.offset_v_mm + shift_v_mm) * v_hat
        # columns of the turn: where the panel's u, v and normal go, in those three themselves
        turn = Rotation.from_rotvec([change.tilt_u_rad, change.tilt_v_rad, change.roll_rad]).as_matrix()
        frame_of = np.stack([u_hat, v_hat, normal], -1)
        column, row = (frame_of @ turn[:, k] * pitch for k, pitch in enumerate((pitch_u_mm, pitch_v_mm)))
        vectors = [source + change.source_distance_mm * normal, middle - half_u * column - half_v * row, column, row]
        turn_rad = change.turn_rad + (float(self.views.turn_rad[frame]) if isinstance(self.views, Views) else 0.0)
        about_z = Rotation.from_rotvec([0.0, 0.0, turn_rad]).as_matrix()
        vectors = [vector @ about_z.T for vector in vectors]
        if isinstance(self.views, Sway):
            six = self.views.at(time_s)
            back = Rotation.from_rotvec(six[..., :3].reshape(-1, 3)).as_matrix().reshape(*six.shape[:-1], 3, 3)
            places, steps = (np.stack(two, -2) for two in (vectors[:2], vectors[2:]))
            six = six[..., None, 3:]
            vectors = list(np.moveaxis(np.concatenate([(places - six) @ back, steps @ back], -2), -2, 0))
        return np.concatenate(vectors, -1)


def moved(scan: Scan, change: Change, views: Views | Sway | None = None) -> Scan:
    """The scan after a change, its frames as they are (``evenly_lit`` is for those). Offsets and distances of a circular
    orbit stay numbers of its geometry; what they cannot say makes the trajectory one of its own."""
    shutter, geometry, path = scan.shutter, scan.geometry, scan.trajectory
    shutter = replace(
        shutter, readout_s=shutter.readout_s + change.readout_s, exposure_s=shutter.exposure_s + change.exposure_s
    )
    offset_v_mm, offset_u_mm = geometry.detector_offset_mm
    geometry = replace(
        geometry,
        source_to_axis_mm=geometry.source_to_axis_mm + change.source_distance_mm,
        source_to_detector_mm=geometry.source_to_detector_mm + change.source_distance_mm + change.detector_distance_mm,
        detector_offset_mm=(offset_v_mm + change.offset_v_mm, offset_u_mm + change.offset_u_mm),
    )
    turns = (change.roll_rad, change.tilt_v_rad, change.tilt_u_rad, change.turn_rad)
    if isinstance(path, CircularOrbit) and not any(turns) and views is None:
        path = CircularOrbit(geometry, path.kinematics)
    elif change != _not_of_poses(change) or views is not None:
        path = Moved(path, geometry.detector_shape, change, views)
    start_s = np.asarray(scan.frame_start_s, np.float64) + change.start_s
    lag = float(np.clip(scan.lag + change.lag, 0, LARGEST_LAG))
    return replace(scan, geometry=geometry, trajectory=path, shutter=shutter, frame_start_s=start_s, lag=lag)


def _not_of_poses(change: Change) -> Change:
    return Change(**{name: getattr(change, name) for name in ("readout_s", "exposure_s", "start_s", "lag", "drift")})


def evenly_lit(scan: Scan, drift: float) -> Scan:
    """The scan as a beam that gets no brighter had recorded it."""
    return replace(scan, projections=(scan.projections + drift * drift_course(scan)[:, None, None]).astype(np.float32))


def drift_course(scan: Scan) -> np.ndarray:
    """Where in the scan its frames (F,) begin, -1/2 to 1/2."""
    starts_s = np.asarray(scan.frame_start_s, np.float64)
    return (starts_s - starts_s.min()) / max(np.ptp(starts_s), 1e-30) - 0.5
