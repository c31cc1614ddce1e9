"""Noise against the moments of the distributions it is made of, at any dose."""

from itertools import product

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.detector import (
    beer_lambert_counts,
    beer_lambert_noise,
    sample_counts,
    tigre_counts,
    tigre_noise,
)

BOTH = [tigre_noise, beer_lambert_noise]


def test_counts_have_poisson_mean_and_variance_plus_the_electronic_variance() -> None:
    for expected in (3.0, 400.0, 1e6, 3e9, 1e15):
        counts, variance = (
            sample_counts(np.full(200_000, expected), 10.0, np.random.default_rng(1)), expected + 100,
        )
        # Five standard errors of a mean and of a variance of 200,000 draws.
        assert counts.mean() == pytest.approx(expected, abs=5 * np.sqrt(variance / 2e5))
        assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / 2e5) + 0.01)
    whole = sample_counts(
        np.array([0.0, 2.5, 1e5, 5e9]), 0.0, np.random.default_rng(0)
    )  # without electronics
    assert np.array_equal(whole, np.rint(whole)) and whole[0] == 0


def test_expected_counts_follow_both_laws() -> None:
    p = np.array([[[0.0, 1.0], [2.0, 4.0]]])
    assert np.allclose(beer_lambert_counts(p, 1e4), 1e4 * np.exp(-p))
    expected, scale = tigre_counts(p, 1e4)
    assert scale == 4.0
    assert np.allclose(expected, 1e4 * np.exp([[[0, -0.25], [-0.5, -1]]]))


def test_spreads_are_those_of_error_propagation() -> None:
    # p' = -m ln(I'/dose): standard deviation m · sqrt(I + 10²) / I for I = dose · exp(-p/m).
    p = np.full((1, 300, 300), 2.0)
    p[0, 0, 0] = 4.0
    noisy = tigre_noise(p, 1e4, 10.0, np.random.default_rng(3))[0, 1:]
    counts = 1e4 * np.exp(-0.5)
    assert noisy.mean() == pytest.approx(2.0, abs=2e-3)
    assert noisy.std() == pytest.approx(4.0 * np.sqrt(counts + 100) / counts, rel=0.02)
    noisy = beer_lambert_noise(np.full((1, 300, 300), 2.0), 1e5, 10.0, np.random.default_rng(3))
    counts = 1e5 * np.exp(-2)
    assert noisy.std() == pytest.approx(np.sqrt(counts + 100) / counts, rel=0.02)


def test_only_tigre_clips_negatives() -> None:
    air = np.zeros((1, 60, 60))
    air[0, 0, 0] = 1.0
    assert tigre_noise(air, 1e4, 10.0, np.random.default_rng(0)).min() == 0
    plain = beer_lambert_noise(air, 1e4, 10.0, np.random.default_rng(0))[0, 1:]
    assert plain.min() < 0 and abs(plain.mean()) < 1e-3


@pytest.mark.parametrize("noise", BOTH)
def test_the_generator_decides_and_large_doses_leave_the_line_integrals_alone(noise) -> None:
    p = np.random.default_rng(0).uniform(0, 3, (2, 8, 9))
    one, same, other = (noise(p, 1e4, 10.0, np.random.default_rng(s)) for s in (5, 5, 6))
    assert np.array_equal(one, same) and not np.array_equal(one, other)
    assert one.dtype == np.float32 and one.shape == p.shape
    assert np.allclose(noise(p, 1e15, 10.0, np.random.default_rng(0)), p, atol=1e-5)


@pytest.mark.parametrize("noise", BOTH)
def test_finite_at_any_dose_and_any_line_integral(noise) -> None:
    p = np.array([[[0.0, 1e-9, 5.0], [50.0, 1e4, -3.0]]])
    for dose, electronic in product([1e-3, 1.0, 1e4, 1e9, 1e15, 1e19, 1e300], (0.0, 10.0, 1e3)):
        assert np.isfinite(noise(p, dose, electronic, np.random.default_rng(0))).all(), (dose, electronic)


@pytest.mark.parametrize("noise", BOTH)
def test_empty_scans_stay_close_to_zero(noise) -> None:
    for p in (np.zeros((2, 3, 4)), np.full((1, 2, 2), -0.1)):
        noisy = noise(p, 1e8, 0.0, np.random.default_rng(0))
        assert np.isfinite(noisy).all() and np.abs(noisy).max() < 0.11
    assert noise(np.zeros((0, 3, 4)), 1e4, 10.0, np.random.default_rng(0)).shape == (0, 3, 4)


@pytest.mark.parametrize("noise", BOTH)
def test_bad_settings_are_refused(noise) -> None:
    rng, p = np.random.default_rng(0), np.zeros((1, 2, 2))
    assert_refused({
        "dose: found 0": lambda: noise(p, 0, 10.0, rng), "electronic noise": lambda: noise(p, 1e4, -1.0, rng),
        "line integrals": lambda: noise(p + np.nan, 1e4, 10.0, rng),
    })  # fmt: skip
