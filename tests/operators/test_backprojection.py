"""FDK's voxel-driven backprojection against the same sum in float64."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from tolerances import BACKPROJECTION

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject
from phyradgs_cl.operators.layout import projection_matrices


@pytest.mark.parametrize("shape", [(13, 18), (31, 5), (1, 9), (9, 1)])
def test_weighted_sum_of_bilinear_samples(any_rt, make_geometry, shape) -> None:
    grid = Grid((5, 9, 19), (0.3, 0.2, 0.1), (0.1, -0.1, 0.2))
    rng = np.random.default_rng(61)
    frames = rng.uniform(-1, 1, (4, *shape)).astype(np.float32)
    pose = make_geometry(*shape, offset=(0.1, 0.2)).pose(np.array([0.0, 1.3, 2.9, 4.4]))
    weight = rng.uniform(0.5, 1, 4)
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    expected = np.zeros(grid.shape)
    for frame, matrix, w in zip(frames, projection_matrices(pose).reshape(-1, 3, 4), weight, strict=True):
        u, v, depth = np.einsum("ij,jzyx->izyx", matrix, np.stack([x, y, z, np.ones(grid.shape)]))
        u, v = u / depth, v / depth
        inside = (u >= 0) & (u <= shape[1] - 1) & (v >= 0) & (v <= shape[0] - 1)
        sample = map_coordinates(frame.astype(np.float64), [v, u], order=1, mode="nearest")
        expected += np.where(inside, w / depth**2 * sample, 0)
    found = backproject(any_rt, frames, pose, weight, grid)
    assert np.any(expected) == (
        min(shape) > 1
    )  # a voxel's centre is seldom exactly on a single line of pixels
    np.testing.assert_allclose(found, expected, rtol=0, atol=BACKPROJECTION)
