"""A cloud averaged over voxels: moments, mass, and the mean over a voxel itself."""

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.fields import Gaussians
from phyradgs_cl.operators.twins.splat import precision_matrices, voxel_field

BOX = (0.3, 0.2, 0.1)


def test_variance_is_added_and_mass_is_kept(make_cloud) -> None:
    rows = make_cloud(20, 71, scale=(0.02, 0.3))
    after = Gaussians.from_rows(rows).averaged(BOX)
    covariance, widened = (np.linalg.inv(precision_matrices(r)) for r in (rows, after.rows()))
    expected = np.broadcast_to(np.diag(np.square(BOX)) / 12, widened.shape)
    np.testing.assert_allclose(widened - covariance, expected, rtol=0, atol=FLOAT64)
    mass, kept = (r[10] * np.prod(r[3:6], axis=0) for r in (rows, after.rows()))
    np.testing.assert_allclose(kept, mass, rtol=1e-12)
    np.testing.assert_array_equal(after.mean, rows[:3].T)
    assert Gaussians.from_rows(np.zeros((11, 0))).averaged(BOX).count == 0


@pytest.mark.parametrize(("scale", "limit"), [(0.05, 0.05), (0.1, 2e-3), (0.3, 2e-4)])
def test_samples_are_the_means_over_voxels(scale, limit) -> None:
    """Voxels of 0.1; a Gaussian of half a voxel, one voxel and three."""
    rows = np.array([[0.013, -0.02, 0.03, scale, scale, scale, 1, 0, 0, 0, 1.0]]).T
    fine, voxel = 9, 0.1
    centres = (np.arange(21) - 10) * voxel
    points = (centres[:, None] + ((np.arange(fine) - fine // 2) / fine * voxel)[None]).ravel()
    dense = voxel_field(rows, points, points, points)
    means = dense.reshape(21, fine, 21, fine, 21, fine).mean(axis=(1, 3, 5))
    averaged = Gaussians.from_rows(rows).averaged((voxel,) * 3)
    found, sampled = (voxel_field(r, centres, centres, centres) for r in (averaged.rows(), rows))
    error, before = (np.linalg.norm(f - means) / np.linalg.norm(means) for f in (found, sampled))
    assert error <= limit and error < before / 5
