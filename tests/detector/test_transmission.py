"""Transmission weights of pixels (PWLS): mean 1 over what counts, one over the variance of a line integral."""

import numpy as np
import pytest

from phyradgs_cl.detector import beer_lambert_noise, transmission_weights


def test_the_mean_is_one_over_the_pixels_that_count() -> None:
    p = np.random.default_rng(0).uniform(0, 5, (3, 8, 9)).astype(np.float32)
    weights = transmission_weights(p)
    assert weights.dtype == np.float32 and weights.mean() == pytest.approx(1, rel=1e-5)
    np.testing.assert_allclose(weights / weights[0, 0, 0], np.exp(p[0, 0, 0] - p), rtol=1e-5)
    valid = np.ones((8, 9), bool)
    valid[2:4] = False
    p[:, 2:4] = -50.0  # what a masked pixel holds does not matter
    chosen = np.broadcast_to(valid, p.shape)
    assert transmission_weights(p, valid)[chosen].mean() == pytest.approx(1, rel=1e-5)


def test_weights_are_one_over_the_variance_and_extremes_stay_finite() -> None:
    p = np.repeat(np.array([0.0, 1.0, 3.0], np.float32), 40_000).reshape(3, 200, 200)
    noisy = beer_lambert_noise(p, 1e4, 0.0, np.random.default_rng(1))
    products = transmission_weights(p).mean(axis=(1, 2)) * noisy.var(axis=(1, 2))
    np.testing.assert_allclose(products, products[0], rtol=0.05)
    p = np.array([[[-1e3, 0.0, 1e3]]], np.float32)
    assert np.isfinite(transmission_weights(p)).all()
    np.testing.assert_array_equal(transmission_weights(np.full((1, 2, 2), 1e4, np.float32)), 1)
    np.testing.assert_array_equal(transmission_weights(p, np.zeros(p.shape, bool))[0, 0, :2], 1)
