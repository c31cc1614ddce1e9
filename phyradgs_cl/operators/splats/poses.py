"""From gradients by Gaussians to that by the pose from which they were seen: a gantry that turns is an object that turns
the other way, a panel that moves is all centres that move the other way on it, and rays of other lengths."""

import numpy as np

from phyradgs_cl.fields.gaussians import MEAN, QUATERNION


def by_pose(rows: np.ndarray, gradients: np.ndarray) -> tuple[float, float, float]:
    """dL by the gantry's turn about z (rad), and half a line's length and half the lines' number times that by the panel's
    shifts (pixels) along a line and across, from internal rows (11, G) and their gradients (13, G) of a frame."""
    values, by = rows.astype(np.float64), gradients.astype(np.float64)
    (x, y, _), (by_x, by_y, _) = values[MEAN], by[MEAN]
    w, i, j, k = values[QUATERNION]
    turned = np.stack([-k, -j, i, w]) / 2  # of a quaternion, by a turn about z before its own
    by_object = np.sum(x * by_y - y * by_x) + np.sum(turned * by[QUATERNION])
    return -float(by_object), -float(by[11].sum()), -float(by[12].sum())


def by_length(pose: np.ndarray, weighed: np.ndarray) -> np.ndarray:
    """dL by the panel's shifts (2,) along its columns and rows (pixels), as far as rays get longer by it, which line
    integrals are in proportion to: from the ``pose`` (12,) and the frame times dL/dframe (rows, columns)."""
    source, first, column, row = pose.reshape(4, 3)
    v, u = (np.arange(n, dtype=np.float64) for n in weighed.shape)
    ray = first - source + v[:, None, None] * row + u[:, None] * column
    share = weighed / np.sum(ray**2, -1)
    return np.array([np.sum(share * (ray @ step)) for step in (row, column)])
