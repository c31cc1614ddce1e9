"""Small scans of ellipsoids in a parallel beam, with closed-form line integrals and noise."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import ParallelGeometry, Scan, Shutter, pixel_centres
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom, rotation_about_z

SIDE = 32
GEOMETRY = ParallelGeometry((SIDE, SIDE), 0.1)
GRID = Grid((SIDE,) * 3, (0.1,) * 3)
BODIES = EllipsoidPhantom((
    Ellipsoid((0.0, 0.1, 0.0), (1.1, 0.8, 1.3), 0.3, rotation_about_z(0.4)),
    Ellipsoid((0.4, -0.3, 0.4), (0.35, 0.3, 0.4), 0.6),
    Ellipsoid((-0.5, 0.3, -0.5), (0.3, 0.4, 0.3), -0.2),
    Ellipsoid((-0.2, -0.4, -0.1), (0.2, 0.2, 0.25), 0.7),
), "bodies")


def line_integrals(phantom: EllipsoidPhantom, pose: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The frame (rows, columns) of a parallel beam's pose (12,)."""
    pixels = pixel_centres(pose, shape)
    return phantom.line_integrals(pixels - 50 * pose[:3], pixels + 50 * pose[:3])


def parallel_scan(
    views: int = 30, turn_deg: float = 180.0, true_offset_px: float = 0.0, with_end: bool = False,
    shutter: Shutter | None = None,
) -> Scan:
    """A scan, stated without an offset, of a panel that is truly ``true_offset_px`` along u: stop-and-shoot, or with every
    line at its middle time."""
    speed = np.deg2rad(turn_deg) / (views - 1 if with_end else views)
    starts_s, kinematics = np.arange(float(views)), ConstantSpeed(0.3, speed)
    truth = CircularOrbit(replace(GEOMETRY, detector_offset_mm=(0.0, true_offset_px * 0.1)), kinematics)
    middles_s, frames = (shutter or Shutter(0.0)).line_windows_s(SIDE).mean(1), np.empty((views, SIDE, SIDE))
    for frame, start_s in enumerate(starts_s):
        for middle_s in np.unique(middles_s):
            image = line_integrals(BODIES, truth.pose(frame, start_s + middle_s), (SIDE, SIDE))
            frames[frame, middles_s == middle_s] = image[middles_s == middle_s]
    frames += np.random.default_rng(0).normal(0, 0.004, frames.shape)
    orbit = CircularOrbit(GEOMETRY, kinematics)
    return Scan(frames, GEOMETRY, orbit, shutter or Shutter(0.0), starts_s, GRID, shutter is not None)


def laminography_scan(views: int = 30, rise_deg: float = 30.0) -> Scan:
    """A full turn of rays that rise by an angle, with the panel across them."""
    starts, rise = np.linspace(0, 2 * np.pi, views, endpoint=False), np.deg2rad(rise_deg)
    cos, sin, zero, one = np.cos(starts), np.sin(starts), np.zeros(views), np.ones(views)
    across = np.stack([-sin, cos, zero], -1)
    along = np.stack([-cos * np.cos(rise), -sin * np.cos(rise), one * np.sin(rise)], -1)
    up = np.cross(across, along)
    up *= np.sign(up[:, 2:])
    half = (SIDE - 1) / 2 * 0.1
    poses = np.concatenate([along, -half * (across + up), 0.1 * across, 0.1 * up], -1)
    frames = np.stack([line_integrals(BODIES, pose, (SIDE, SIDE)) for pose in poses])
    frames += np.random.default_rng(0).normal(0, 0.004, frames.shape)
    return Scan.from_poses(frames, poses, GRID, is_parallel=True)
