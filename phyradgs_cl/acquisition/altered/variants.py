"""The same frames under another assumption: reversed rotation or readout, or a panel that is shifted, mirrored or resized.

A pose (..., 12) is four vectors: the source (or the direction of parallel rays), the centre of pixel (0, 0), the step to
the next column, and the step to the next row."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl.acquisition.altered.angles import azimuth_rad, start_azimuths_rad, wrapped
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.trajectory import CircularOrbit, DerivedTrajectory

_MIRROR_Y = np.array([1.0, -1.0, 1.0] * 4)
_FIRST, _COLUMN_STEP, _ROW_STEP = slice(3, 6), slice(6, 9), slice(9, 12)
_STEPS = _ROW_STEP, _COLUMN_STEP  # the parts of a pose that are the step along v (axis 0) and along u (axis 1)


@dataclass(frozen=True, eq=False)
class AlteredTrajectory(DerivedTrajectory):
    """Poses of ``base`` for a ``panel`` (rows, columns), altered by the following fields in their order.

    - is_reversed: the gantry turns the other way. Poses are mirrored in the plane y = 0. That alone would mirror the
      frames, so the order of columns is reversed too. The panel's offset ``offset_u_mm`` keeps its sign.
    - shift_px: a shift of the panel along u, in columns.
    - images: a function that changes poses (..., 12), for example to those of mirrored frames. None changes nothing.
    - blocks: the (rows, columns) of a block of pixels that is averaged to one pixel.
    - frames (F,): the numbers of the frames of ``base`` that are used. None takes all."""

    panel: tuple[int, int]
    offset_u_mm: float = 0.0
    is_reversed: bool = False
    shift_px: float = 0.0
    images: Callable[[np.ndarray], np.ndarray] | None = None
    blocks: tuple[int, int] = (1, 1)
    frames: np.ndarray | None = None

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        number = frame if self.frames is None else int(self.frames[frame])
        pose = np.array(self.base.pose(number, time_s))
        if self.is_reversed:
            pose = self._mirrored(pose)
        pose[..., _FIRST] += self.shift_px * pose[..., _COLUMN_STEP]
        if self.images is not None:
            pose = self.images(pose)
        for block, step in zip(self.blocks, _STEPS, strict=True):
            pose[..., _FIRST] += (block - 1) / 2 * pose[..., step]
            pose[..., step] *= block
        return pose

    def frame_numbers(self, scan: Scan) -> np.ndarray:
        """Returns, for each of the scan's F frames, its number in ``base``, (F,)."""
        return np.arange(scan.frames) if self.frames is None else self.frames

    def _mirrored(self, pose: np.ndarray) -> np.ndarray:
        pose = pose * _MIRROR_Y
        column = pose[..., _COLUMN_STEP]
        pitch_mm = np.linalg.norm(column, axis=-1, keepdims=True)
        pose[..., _FIRST] += (self.panel[1] - 1 - 2 * self.offset_u_mm / pitch_mm) * column
        pose[..., _COLUMN_STEP] = -column
        return pose


@dataclass(frozen=True, eq=False)
class MappedTrajectory(DerivedTrajectory):
    """Poses of ``base``, changed by a function ``change`` that takes a frame's number and its poses (..., 12)."""

    change: Callable[[int, np.ndarray], np.ndarray]

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        return self.change(frame, np.array(self.base.pose(frame, time_s)))


def altered_trajectory(scan: Scan) -> AlteredTrajectory:
    """Returns the scan's trajectory as an ``AlteredTrajectory``, whose fields ``dataclasses.replace`` can change. A
    trajectory of another class becomes the ``base`` of one without changes."""
    trajectory = scan.trajectory
    if isinstance(trajectory, AlteredTrajectory):
        return trajectory
    offset_u_mm = scan.geometry.detector_offset_mm[1] if isinstance(trajectory, CircularOrbit) else 0.0
    return AlteredTrajectory(trajectory, scan.geometry.detector_shape, offset_u_mm)


def with_trajectory(scan: Scan, **changes: Any) -> Scan:
    """Returns the scan with ``changes`` to the fields of its ``altered_trajectory``."""
    return replace(scan, trajectory=replace(altered_trajectory(scan), **changes))


def reversed_rotation(scan: Scan) -> Scan:
    """Returns the scan as if the gantry turned the other way."""
    return with_trajectory(scan, is_reversed=True)


def reversed_readout(scan: Scan) -> Scan:
    """Returns the scan as if its lines were read in the opposite order."""
    return replace(scan, shutter=replace(scan.shutter, direction=-scan.shutter.direction))


def shifted(scan: Scan, pixels: float) -> Scan:
    """Returns the scan with its panel moved along u by ``pixels`` columns of the recorded panel, even if ``scan`` averages
    blocks of its pixels."""
    return with_trajectory(scan, shift_px=pixels)


def turned(scan: Scan, angle_rad: np.ndarray, speed: float = 1.0) -> Scan:
    """Returns the scan with each frame's poses rotated about z by ``angle_rad`` (F,). Within a frame the gantry turns
    ``speed`` times as fast."""
    first_rad = start_azimuths_rad(scan)

    def change(frame: int, pose: np.ndarray) -> np.ndarray:
        since_start = wrapped(azimuth_rad(pose) - first_rad[frame])
        return _rotated(pose, angle_rad[frame] + (speed - 1) * since_start)

    return replace(scan, trajectory=MappedTrajectory(scan.trajectory, change))


def stretched(scan: Scan, v: float, u: float) -> Scan:
    """Returns the scan with pixels ``v`` times as high and ``u`` times as wide, about the panel's middle. The grid grows
    with the pixels if it then fits the field of view better."""
    rows, columns = scan.geometry.detector_shape

    def change(_: int, pose: np.ndarray) -> np.ndarray:
        wider, higher = (columns - 1) / 2 * (u - 1), (rows - 1) / 2 * (v - 1)
        pose[..., _FIRST] -= wider * pose[..., _COLUMN_STEP] + higher * pose[..., _ROW_STEP]
        pose[..., _COLUMN_STEP] *= u
        pose[..., _ROW_STEP] *= v
        return pose

    # the distance from the central ray to the panel's farther edge
    half_mm = columns * scan.geometry.pixel_size_mm[1] / 2 + abs(scan.geometry.detector_offset_mm[1])
    share = max(scan.grid.size_mm[1:]) * scan.geometry.magnification / (2 * u * half_mm)
    grows = abs(math.log(share * u)) < abs(math.log(share))
    z, y, x = scan.grid.voxel_size_mm
    grid = replace(scan.grid, voxel_size_mm=(v * z, u * y, u * x)) if grows else scan.grid
    return replace(scan, trajectory=MappedTrajectory(scan.trajectory, change), grid=grid)


def mirrored(scan: Scan, axis: str) -> Scan:
    """Returns the scan as if frames were mirrored along ``axis``, "u" or "v". If lines are read one after the other along
    this axis, the order of readout is reversed too."""
    number = ("v", "u").index(axis)
    is_read_along = scan.shutter.axis == ("rows", "columns")[number]
    images = partial(_flipped, axis=number, count=altered_trajectory(scan).panel[number])
    return with_trajectory(reversed_readout(scan) if is_read_along else scan, images=images)


def resized(scan: Scan, factor: float, keeps_axis: bool) -> Scan:
    """Returns a cone beam's scan with pixels ``factor`` times as large.

    keeps_axis: True enlarges the panel about the central ray, as if distances had changed; False, about its middle."""
    trajectory = altered_trajectory(scan)
    rows, columns = trajectory.panel

    def change(_: int, pose: np.ndarray) -> np.ndarray:
        source, first, step_u, step_v = (pose[..., i : i + 3].copy() for i in (0, 3, 6, 9))
        if keeps_axis:
            normal = np.cross(step_u, step_v)
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            centre = source + normal * ((first - source) * normal).sum(-1, keepdims=True)
        else:
            centre = first + (columns - 1) / 2 * step_u + (rows - 1) / 2 * step_v
        pose[..., _FIRST] = centre + factor * (first - centre)
        pose[..., 6:] *= factor
        return pose

    return with_trajectory(scan, base=MappedTrajectory(trajectory.base, change))


def _flipped(pose: np.ndarray, axis: int, count: int) -> np.ndarray:
    """Returns poses (..., 12) for frames whose ``count`` rows (axis 0) or columns (axis 1) are in reverse order."""
    step = _STEPS[axis]
    pose[..., _FIRST] += (count - 1) * pose[..., step]
    pose[..., step] *= -1
    return pose


def _rotated(pose: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle_rad)[..., None], np.sin(angle_rad)[..., None]
    vectors: np.ndarray = pose.reshape(*pose.shape[:-1], 4, 3).copy()
    x, y = vectors[..., 0].copy(), vectors[..., 1].copy()
    vectors[..., 0], vectors[..., 1] = cos * x - sin * y, sin * x + cos * y
    return vectors.reshape(pose.shape)
