"""Float64 twins of the backprojections: every voxel's ray by solving for it, every line by looking at all of them."""

import numpy as np
from scipy.ndimage import map_coordinates

from phyradgs_cl.acquisition.geometry import transpose_pose
from phyradgs_cl.fields import Grid


def backprojection(frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid) -> np.ndarray:
    """Σ_f weight_f / z² · frame_f(u, v); frames (F, rows, columns), pose (F, 12) mm, weight (F,) → (z, y, x)."""
    volume = np.zeros(grid.shape)
    for frame, one, share in zip(frames.astype(np.float64), pose, weight, strict=True):
        u, v, depth = detector_position(one, grid)
        inside = (depth > 0) & _on(u, frame.shape[1]) & _on(v, frame.shape[0])
        volume[inside] += share / depth[inside] ** 2 * _bilinear(frame, v[inside], u[inside])
    return volume


def lines_backprojection(
    frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid, axis: str = "rows"
) -> np.ndarray:
    """The same with one pose per line, pose (F, lines, 12) mm: by definition, see ``backproject_lines``."""
    power = 2 if axis == "columns" else 1
    if axis == "columns":
        frames, pose = frames.transpose(0, 2, 1), transpose_pose(pose)
    lines = frames.shape[1]
    volume = np.zeros(grid.shape)
    for frame, poses, share in zip(frames.astype(np.float64), pose, weight, strict=True):
        u, v, depth = (
            np.stack(parts) for parts in zip(*(detector_position(p, grid) for p in poses), strict=True)
        )
        ahead = v - np.arange(lines)[:, None, None, None]  # falls through zero where the voxel is seen
        for index in np.ndindex(*grid.shape):
            at = (slice(None), *index)
            volume[index] += share * _seen(frame, u[at], ahead[at], depth[at], power)
    return volume


def detector_position(pose: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel column, row and depth (z, y, x) of all voxel centres: x − s = depth (d00 + u eu + v ev), solved."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    offset = np.stack([x, y, z]).reshape(3, -1) - pose[0:3, None]
    basis = np.stack([pose[6:9], pose[9:12], pose[3:6] - pose[0:3]], -1)
    u, v, depth = np.linalg.solve(basis, offset).reshape(3, *grid.shape)
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # a voxel beside the source has no place on the detector
        return u / depth, v / depth, depth


def _seen(frame: np.ndarray, u: np.ndarray, ahead: np.ndarray, depth: np.ndarray, power: int) -> float:
    """What one voxel receives from a frame; u, ahead and depth are (lines,), one pose each."""
    crossing = np.flatnonzero((ahead[:-1] >= 0) & (ahead[1:] <= 0))
    if crossing.size == 0 or depth.min() <= 0:
        return 0.0
    line = int(crossing[0])
    speed = ahead[line] - ahead[line + 1]
    t = ahead[line] / speed
    here, there = (
        float(np.interp(u[r], np.arange(frame.shape[1]), frame[r], 0, 0)) for r in (line, line + 1)
    )
    middle = (1 - t) * depth[line] + t * depth[line + 1]
    return float(((1 - t) * here + t * there) / (middle**2 * speed**power))


def _on(position: np.ndarray, count: int) -> np.ndarray:
    return (position >= 0) & (position <= count - 1)


def _bilinear(frame: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    values: np.ndarray = map_coordinates(frame, [v, u], order=1, mode="nearest")
    return values
