"""Activations of Gaussians and clouds averaged over voxels."""

import numpy as np
import pytest
from tolerances import ACTIVATION_INVERSE, ACTIVATION_MARGIN, FLOAT32, FLOAT64

from phyradgs_cl.fields import Activation, Gaussians
from phyradgs_cl.operators.twins.splat import precision_matrices, voxel_field

ACTIVATION = Activation(0.01, 0.5)


def test_invert_is_the_inverse(make_cloud) -> None:
    rows = make_cloud(40, 81, scale=(0.02, 0.4))
    rows[10, :5] = [1e-9, 1e-5, 1e-2, 5.0, 80.0]
    np.testing.assert_allclose(
        ACTIVATION.apply(ACTIVATION.invert(rows)), rows, rtol=FLOAT32
    )  # of quaternions
    raw = np.random.default_rng(82).normal(size=(11, 40))
    raw[6:10] /= np.linalg.norm(raw[6:10], axis=0)
    again = ACTIVATION.invert(ACTIVATION.apply(raw))
    np.testing.assert_allclose(again, raw, rtol=ACTIVATION_INVERSE, atol=ACTIVATION_INVERSE)


def test_any_raw_numbers_give_valid_parameters(make_cloud) -> None:
    raw = np.random.default_rng(83).normal(size=(11, 50)) * 30
    rows = ACTIVATION.apply(raw)
    assert np.all((rows[3:6] >= 0.01) & (rows[3:6] <= 0.5))
    assert np.all(rows[10] > 0) and np.all(np.isfinite(rows))
    np.testing.assert_allclose(np.linalg.norm(rows[6:10], axis=0), 1, rtol=FLOAT64)
    np.testing.assert_array_equal(rows[:3], raw[:3])
    rows = make_cloud(3, 84)
    rows[3:6] = np.array([0.0, 0.5, 0.9])
    raw = ACTIVATION.invert(rows)
    assert np.all(np.isfinite(raw)) and np.abs(raw[3:6]).max() < 10
    bounded, margin = np.clip(rows[3:6], 0.01, 0.5), ACTIVATION_MARGIN * 0.49
    np.testing.assert_allclose(ACTIVATION.apply(raw)[3:6], bounded, rtol=0, atol=margin)


def test_gaussians_and_rows_are_the_same_cloud(make_cloud) -> None:
    rows = make_cloud(7, 85)
    cloud = Gaussians.from_rows(rows)
    np.testing.assert_allclose(cloud.rows(), rows, rtol=FLOAT32)
    scaled = cloud.scaled(10.0, 0.1).rows()
    np.testing.assert_allclose(scaled[:6], 10 * rows[:6], rtol=FLOAT64)
    np.testing.assert_allclose(scaled[10], rows[10] / 10, rtol=FLOAT64)
    assert Gaussians.from_rows(np.zeros((11, 0))).rows().shape == (11, 0)


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
    reach = max(4, round(3.3 * scale / voxel))  # of voxels, on each side
    side = 2 * reach + 1
    centres = (np.arange(side) - reach) * voxel
    points = (centres[:, None] + ((np.arange(fine) - fine // 2) / fine * voxel)[None]).ravel()
    dense = voxel_field(rows, points, points, points)
    means = dense.reshape(side, fine, side, fine, side, fine).mean(axis=(1, 3, 5))
    averaged = Gaussians.from_rows(rows).averaged((voxel,) * 3)
    found, sampled = (voxel_field(r, centres, centres, centres) for r in (averaged.rows(), rows))
    error, before = (np.linalg.norm(f - means) / np.linalg.norm(means) for f in (found, sampled))
    assert error <= limit and error < before / 5
