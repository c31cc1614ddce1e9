"""Activations of Gaussians and clouds averaged over voxels."""

from dataclasses import replace

import numpy as np
from tolerances import ACTIVATION_INVERSE, ACTIVATION_MARGIN, FLOAT32, FLOAT64

from phyradgs_cl.fields import Activation, Gaussians

ACTIVATION = Activation(0.01, 0.5)


def test_invert_is_the_inverse_and_any_raw_numbers_give_valid_parameters(make_cloud) -> None:
    rows = make_cloud(40, 81, scale=(0.02, 0.4))
    rows[10, :5] = [1e-9, 1e-5, 1e-2, 5.0, 80.0]
    np.testing.assert_allclose(ACTIVATION.apply(ACTIVATION.invert(rows)), rows, rtol=FLOAT32)  # of quaternions
    raw = np.random.default_rng(82).normal(size=(11, 40))
    raw[6:10] /= np.linalg.norm(raw[6:10], axis=0)
    again = ACTIVATION.invert(ACTIVATION.apply(raw))
    np.testing.assert_allclose(again, raw, rtol=ACTIVATION_INVERSE, atol=ACTIVATION_INVERSE)
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


def test_gaussians_and_rows_are_the_same_cloud_and_quaternions_of_any_length_rotations(make_cloud) -> None:
    rows = make_cloud(9, 86)
    cloud = Gaussians.from_rows(rows)
    scaled = cloud.scaled(10.0, 0.1).rows()
    np.testing.assert_allclose(scaled[:6], 10 * rows[:6], rtol=FLOAT64)
    np.testing.assert_allclose(scaled[10], rows[10] / 10, rtol=FLOAT64)
    assert Gaussians.from_rows(np.zeros((11, 0))).rows().shape == (11, 0)
    for length in (1e-300, 1e-200, 1e-9, 1.0, 3.0, 1e200, 1e307):
        np.testing.assert_allclose(replace(cloud, quaternion=cloud.quaternion * length).rows(), rows, rtol=FLOAT32)
    for length in (1e-30, 1e30):
        short = np.float32(length) * cloud.quaternion.astype(np.float32)
        np.testing.assert_allclose(replace(cloud, quaternion=short).rows(), rows, rtol=1e-6, atol=1e-7)
