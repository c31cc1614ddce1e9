"""Float64 twin of the ray-driven projector: Joseph's sums, one ray at a time in NumPy."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from phyradgs_cl.acquisition.geometry import pixel_centres
from phyradgs_cl.fields import Grid


def joseph_image(
    volume: np.ndarray, grid: Grid, pose: np.ndarray, detector_shape: tuple[int, int]
) -> np.ndarray:
    """Line integrals (nv, nu) of a volume (z, y, x) from one pose (12,)."""
    pitch, first = np.array(grid.voxel_size_mm[::-1]), np.array(grid.first_centre_mm[::-1])
    source = (pose[:3] - first) / pitch
    to_pixel = (pixel_centres(pose, detector_shape) - pose[:3]) / pitch
    image = np.zeros(detector_shape)
    padded = np.pad(volume.astype(np.float64), 1)
    for index in np.ndindex(*detector_shape):
        d = to_pixel[index]
        axis = int(np.argmax(np.abs(d)))
        ends = np.sort([source[axis], source[axis] + d[axis]])
        planes = np.arange(grid.shape[2 - axis])
        planes = planes[(planes >= ends[0]) & (planes <= ends[1])]
        points = source + np.outer((planes - source[axis]) / d[axis], d)
        points[:, axis] = planes
        samples = map_coordinates(padded, points[:, ::-1].T + 1, order=1, mode="constant")
        image[index] = samples.sum() * np.linalg.norm(d * pitch) / abs(d[axis])
    return image
