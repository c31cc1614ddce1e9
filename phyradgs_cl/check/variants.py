"""The same frames under another hypothesis: turned the other way, read the other way, exposed longer, panel shifted."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.acquisition.geometry import transpose_pose
from phyradgs_cl.acquisition.trajectory import Trajectory
from phyradgs_cl.check.questions.timing import azimuth_rad, start_azimuths_rad, wrapped

_MIRROR = np.array([1.0, -1.0, 1.0] * 4)  # of the four vectors of a pose, at the plane y = 0


@dataclass(frozen=True, eq=False)
class Path:
    """Poses of ``base`` for a panel of (rows, columns), changed in the order of the fields.

    is_reversed: the gantry turns the other way (a mirror image, whose columns run backwards); offset_u_mm of the panel stays
    on its side. shift_px: the panel moves along u, in its own columns. images: how the pixels of the frames lie on the
    panel, poses (..., 12) → poses; None: as stated. blocks: of how many rows and columns blocks of pixels are. frames (F,):
    which of ``base`` are used; None: all.
    """

    base: Trajectory
    panel: tuple[int, int]
    offset_u_mm: float = 0.0
    is_reversed: bool = False
    shift_px: float = 0.0
    images: Callable[[np.ndarray], np.ndarray] | None = None
    blocks: tuple[int, int] = (1, 1)
    frames: np.ndarray | None = None

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Poses (..., 12) at times (...)."""
        number = frame if self.frames is None else int(self.frames[frame])
        pose = np.array(self.base.pose(number, time_s))
        if self.is_reversed:
            pose = self._mirrored(pose)
        pose[..., 3:6] += self.shift_px * pose[..., 6:9]
        if self.images is not None:
            pose = self.images(pose)
        for block, step in zip(self.blocks, (slice(9, 12), slice(6, 9)), strict=True):
            pose[..., 3:6] += (block - 1) / 2 * pose[..., step]
            pose[..., step] *= block
        return pose

    def _mirrored(self, pose: np.ndarray) -> np.ndarray:
        pose = pose * _MIRROR
        column = pose[..., 6:9]
        pitch_mm = np.linalg.norm(column, axis=-1, keepdims=True)
        pose[..., 3:6] += (self.panel[1] - 1 - 2 * self.offset_u_mm / pitch_mm) * column
        pose[..., 6:9] = -column
        return pose


def path_of(scan: Scan) -> Path:
    """The scan's trajectory as a path that can be changed."""
    path = scan.trajectory
    if isinstance(path, Path):
        return path
    offset_u_mm = scan.geometry.detector_offset_mm[1] if isinstance(path, CircularOrbit) else 0.0
    return Path(path, scan.geometry.detector_shape, offset_u_mm)


def with_path(scan: Scan, **changes: Any) -> Scan:
    """The scan with changed fields of its ``Path``."""
    return replace(scan, trajectory=replace(path_of(scan), **changes))


def reversed_rotation(scan: Scan) -> Scan:
    """The gantry turning the other way."""
    return with_path(scan, is_reversed=True)


def reversed_readout(scan: Scan) -> Scan:
    """The last line read first."""
    return replace(scan, shutter=replace(scan.shutter, direction=-scan.shutter.direction))


def exposed(scan: Scan, factor: float) -> Scan:
    """Lines open ``factor`` times as long, from the same moment, while the gantry turns as it does."""
    return replace(scan, shutter=replace(scan.shutter, exposure_s=factor * scan.shutter.exposure_s))


def shifted(scan: Scan, pixels: float) -> Scan:
    """The panel moved along u by ``pixels`` of the scan as it was recorded, whatever it was binned to."""
    return with_path(scan, shift_px=pixels)


@dataclass(frozen=True, eq=False)
class Changed:
    """Poses of ``base`` after ``change`` (frame, poses (..., 12)) → poses."""

    base: Trajectory
    change: Callable[[int, np.ndarray], np.ndarray]

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Poses (..., 12) at times (...)."""
        return self.change(frame, np.array(self.base.pose(frame, time_s)))


def at_rest(scan: Scan) -> Scan:
    """The gantry at rest while it exposes."""
    return replace(scan, is_fly=False)


def read(scan: Scan, axis: str, direction: int, readout_s: float) -> Scan:
    """Lines along ``axis`` read one after another in ``readout_s``."""
    shutter = replace(scan.shutter, axis=axis, direction=direction, readout_s=readout_s)
    return replace(scan, shutter=shutter, is_fly=True)


def turned(scan: Scan, angle_rad: np.ndarray, speed: float = 1.0) -> Scan:
    """Frames turned about z by ``angle_rad`` (F,), the gantry ``speed`` times as fast within them."""
    first_rad = start_azimuths_rad(scan)

    def change(frame: int, pose: np.ndarray) -> np.ndarray:
        since = wrapped(azimuth_rad(pose) - first_rad[frame])
        return _rotated(pose, angle_rad[frame] + (speed - 1) * since)

    return replace(scan, trajectory=Changed(scan.trajectory, change))


def stretched(scan: Scan, v: float, u: float) -> Scan:
    """Pixels ``v`` times as high and ``u`` times as wide about the middle of the panel; the box grows alike if it then
    fits what the panel sees better than as it is."""
    rows, columns = scan.geometry.detector_shape

    def change(frame: int, pose: np.ndarray) -> np.ndarray:
        pose[..., 3:6] -= (columns - 1) / 2 * (u - 1) * pose[..., 6:9] + (rows - 1) / 2 * (v - 1) * pose[..., 9:12]
        pose[..., 6:9] *= u
        pose[..., 9:12] *= v
        return pose

    seen_mm = u * columns * scan.geometry.pixel_size_mm[1] / scan.geometry.magnification
    share = max(scan.grid.size_mm[1:]) / seen_mm
    grows = abs(math.log(share * u)) < abs(math.log(share))
    z, y, x = scan.grid.voxel_size_mm
    grid = replace(scan.grid, voxel_size_mm=(v * z, u * y, u * x)) if grows else scan.grid
    return replace(scan, trajectory=Changed(scan.trajectory, change), grid=grid)


def mirrored(scan: Scan, axis: str) -> Scan:
    """The frames mirrored in ``axis``, u or v, on the stated panel."""
    panel, number = path_of(scan).panel, ("v", "u").index(axis)
    is_read_along = scan.shutter.axis == ("rows", "columns")[number]
    turned = reversed_readout(scan) if is_read_along else scan
    return with_path(turned, images=lambda pose: _flipped(pose, number, panel[number]))


def transposed(scan: Scan, is_quarter_turn: bool) -> Scan:
    """The frames' rows along u and their columns along v; is_quarter_turn: and mirrored in u, which is a turn by 90°."""
    rows, columns = path_of(scan).panel

    def change(pose: np.ndarray) -> np.ndarray:
        pose[..., 3:6] += (columns - rows) / 2 * (pose[..., 6:9] - pose[..., 9:12])
        pose = transpose_pose(pose)
        return _flipped(pose, 0, rows) if is_quarter_turn else pose

    axis = "columns" if scan.shutter.axis == "rows" else "rows"
    turns_back = is_quarter_turn and axis == "rows"
    shutter = replace(scan.shutter, axis=axis, direction=-scan.shutter.direction if turns_back else scan.shutter.direction)
    return with_path(replace(scan, shutter=shutter), images=change)


def resized(scan: Scan, factor: float, keeps_axis: bool) -> Scan:
    """Pixels ``factor`` times as large. keeps_axis: the central ray stays at its pixel, as if the distances were shorter
    instead; else the panel's offset stays in mm."""
    path = path_of(scan)
    rows, columns = path.panel

    def change(_: int, pose: np.ndarray) -> np.ndarray:
        source, first, step_u, step_v = (pose[..., i : i + 3].copy() for i in (0, 3, 6, 9))
        if keeps_axis:
            normal = np.cross(step_u, step_v)
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            centre = source + normal * ((first - source) * normal).sum(-1, keepdims=True)
        else:
            centre = first + (columns - 1) / 2 * step_u + (rows - 1) / 2 * step_v
        pose[..., 3:6] = centre + factor * (first - centre)
        pose[..., 6:] *= factor
        return pose

    return with_path(scan, base=Changed(path.base, change))


def _flipped(pose: np.ndarray, axis: int, count: int) -> np.ndarray:
    """Poses (..., 12) of frames whose ``count`` rows (axis 0) or columns (1) run backwards."""
    step = (slice(9, 12), slice(6, 9))[axis]
    pose[..., 3:6] += (count - 1) * pose[..., step]
    pose[..., step] *= -1
    return pose


def _rotated(pose: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Poses (..., 12) turned about z by angles (...)."""
    cos, sin = np.cos(angle_rad)[..., None], np.sin(angle_rad)[..., None]
    vectors = pose.reshape(*pose.shape[:-1], 4, 3).copy()
    x, y = vectors[..., 0].copy(), vectors[..., 1].copy()
    vectors[..., 0], vectors[..., 1] = cos * x - sin * y, sin * x + cos * y
    return vectors.reshape(pose.shape)
