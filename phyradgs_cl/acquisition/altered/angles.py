"""Angles about the axis of rotation (+z): of the source, or of the direction of parallel rays."""

import numpy as np

from phyradgs_cl.acquisition.scan import Scan

_ACROSS = 1e-3  # a ray counts as perpendicular to the axis if the cosine of the angle between them is below this
_ARC_STEPS = 32  # number of steps whose angles make an exposure's arc: in each, the gantry must make less than half a turn


def azimuth_rad(pose: np.ndarray) -> np.ndarray:
    """Returns the angles (...) in rad about +z, −π to π, of the source in poses (..., 12); in a parallel beam, of the
    rays' direction."""
    return np.asarray(np.arctan2(pose[..., 1], pose[..., 0]))


def start_azimuths_rad(scan: Scan) -> np.ndarray:
    """Returns the angle (F,) in rad about +z, −π to π, of the source when each frame's first line opens; in a parallel beam,
    of the rays' direction."""
    starts = [scan.trajectory.pose(f, scan.frame_start_s[f : f + 1]) for f in range(scan.frames)]
    return azimuth_rad(np.concatenate(starts))


def middle_poses(scan: Scan) -> np.ndarray:
    """Returns the poses (F, 12) midway between each frame's first and last light."""
    times_s = scan.middle_times_s
    return np.stack([scan.trajectory.pose(f, times_s[f : f + 1])[0] for f in range(scan.frames)])


def has_opposite_views(scan: Scan) -> bool:
    """Returns whether rays are parallel and perpendicular to the axis, so that views half a turn apart are mirror images."""
    return scan.is_parallel and bool((np.abs(middle_poses(scan)[:, 2]) < _ACROSS).all())


def exposure_arc_rad(scan: Scan) -> float:
    """Returns the angle in rad by which the gantry turns in a line's exposure, in the middle frame; 0 for one at rest."""
    if not scan.is_fly:
        return 0.0
    frame = scan.frames // 2
    # The arc is a sum over small steps, because the azimuths at its ends alone do not tell 270° from 90°.
    times_s = float(scan.frame_start_s[frame]) + scan.shutter.exposure_s * np.linspace(0, 1, _ARC_STEPS + 1)
    return abs(float(wrapped(np.diff(azimuth_rad(scan.trajectory.pose(frame, times_s)))).sum()))


def wrapped(angle: np.ndarray | float) -> np.ndarray:
    """Returns angles (...) in rad, moved by whole turns into [-π, π)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
