"""Noise against the moments of its distributions, at any dose; lag on a step of light, and undone."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Scan, Shutter
from phyradgs_cl.detector.effects import (
    add_lag,
    beer_lambert_noise,
    lagged,
    sample_counts,
    tigre_noise,
    without_lag,
)
from phyradgs_cl.fields import Grid


def test_counts_have_poisson_mean_and_variance_plus_the_electronic_variance() -> None:
    for expected in (3.0, 400.0, 1e6, 3e9, 1e15):
        counts, variance = sample_counts(np.full(200_000, expected), 10.0, np.random.default_rng(1)), expected + 100
        # Five standard errors of a mean and of a variance of 200,000 draws.
        assert counts.mean() == pytest.approx(expected, abs=5 * np.sqrt(variance / 2e5))
        assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / 2e5) + 0.01)
    whole = sample_counts(np.array([0.0, 2.5, 1e5, 5e9]), 0.0, np.random.default_rng(0))  # without electronics
    assert np.array_equal(whole, np.rint(whole)) and whole[0] == 0


def test_spreads_are_those_of_error_propagation() -> None:
    # p' = -m ln(I'/dose): standard deviation m · sqrt(I + 10²) / I for I = dose · exp(-p/m).
    p = np.full((1, 300, 300), 2.0)
    p[0, 0, 0] = 4.0
    noisy, counts = tigre_noise(p, 1e4, 10.0, np.random.default_rng(3))[0, 1:], 1e4 * np.exp(-0.5)
    assert noisy.mean() == pytest.approx(2.0, abs=2e-3)
    assert noisy.std() == pytest.approx(4.0 * np.sqrt(counts + 100) / counts, rel=0.02)
    for light in (1.0, 0.25):
        of_pixels, counts = np.full((300, 300), light), light * 1e5 * np.exp(-2)
        noisy = beer_lambert_noise(np.full((1, 300, 300), 2.0), 1e5, 10.0, np.random.default_rng(3), of_pixels)
        assert noisy.std() == pytest.approx(np.sqrt(counts + 100) / counts, rel=0.02)
        assert noisy.mean() == pytest.approx(2.0, abs=2e-3)


def test_only_tigre_clips_negatives() -> None:
    air = np.zeros((1, 60, 60))
    air[0, 0, 0] = 1.0
    assert tigre_noise(air, 1e4, 10.0, np.random.default_rng(0)).min() == 0
    plain = beer_lambert_noise(air, 1e4, 10.0, np.random.default_rng(0))[0, 1:]
    assert plain.min() < 0 and abs(plain.mean()) < 1e-3


@pytest.mark.parametrize("noise", [tigre_noise, beer_lambert_noise])
def test_the_generator_decides_and_every_dose_leaves_finite_numbers_and_large_ones_the_line_integrals(noise) -> None:
    p = np.random.default_rng(0).uniform(0, 3, (2, 8, 9))
    one, same, other = (noise(p, 1e4, 10.0, np.random.default_rng(s)) for s in (5, 5, 6))
    assert np.array_equal(one, same) and not np.array_equal(one, other)
    assert one.dtype == np.float32 and one.shape == p.shape
    assert np.allclose(noise(p, 1e15, 10.0, np.random.default_rng(0)), p, atol=1e-5)
    p = np.array([[[0.0, 1e-9, 5.0], [50.0, 1e4, -3.0]]])
    for dose, electronic in product([1e-3, 1.0, 1e4, 1e9, 1e15, 1e19, 1e300], (0.0, 10.0, 1e3)):
        assert np.isfinite(noise(p, dose, electronic, np.random.default_rng(0))).all(), (dose, electronic)
    for empty in (np.zeros((2, 3, 4)), np.full((1, 2, 2), -0.1), np.zeros((0, 3, 4))):
        noisy = noise(empty, 1e8, 0.0, np.random.default_rng(0))
        assert noisy.shape == empty.shape and (np.abs(noisy) < 0.11).all()


SHAPE = (6, 8)
GEOMETRY = ConeGeometry(50.0, 70.0, SHAPE, (0.6, 0.5))


def scan(projections: np.ndarray, **changes: object) -> Scan:
    orbit, start_s = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, 0.25)), np.arange(float(len(projections)))
    frames, shutter = projections.astype(np.float32), Shutter(0.8, 0.3)
    return Scan(frames, GEOMETRY, orbit, shutter, start_s, Grid.cube(4, 2.0), **changes)


def frames(count: int = 5, peak: float = 4.0) -> np.ndarray:
    return np.random.default_rng(3).uniform(0, peak, (count, *SHAPE))


def test_a_flash_fades_exponentially_and_no_light_is_lost() -> None:
    flash = np.zeros((40, 1, 1))
    flash[0] = 1.0
    seen = add_lag(flash, 0.25)[:, 0, 0]
    np.testing.assert_allclose(seen, 0.75 * 0.25 ** np.arange(40), rtol=1e-12)
    assert seen.sum() == pytest.approx(1.0) and add_lag(np.ones((60, 1, 1)), 0.25)[-1, 0, 0] == pytest.approx(1.0)


def test_a_scan_gets_its_frames_back() -> None:
    p = frames()
    for lag in (0.0, 0.05, 0.3):
        recorded = scan(lagged(p, lag), lag=lag)
        clean = without_lag(recorded)
        assert clean.lag == 0 and clean.pixel_mask is None
        # recorded line integrals are float32: exp(p) of a dark pixel times that of a bright one before it
        np.testing.assert_allclose(clean.projections, p, atol=FLOAT32 * np.exp(4.0))
        assert (clean is recorded) == (lag == 0)
        assert lag == 0 or np.abs(recorded.projections - p).max() > lag


@pytest.mark.parametrize("lag", [0.05, 0.3])
@pytest.mark.parametrize("photons", [500, None])
@pytest.mark.parametrize("covered", [False, True])
@pytest.mark.parametrize("before", ["off", "the same image", "air"])
def test_the_first_frame_says_whether_the_beam_was_on_before(before, covered, photons, lag, caplog) -> None:
    """A ball that moves by a pixel a frame, or a body that leaves no air, in a beam that was off, on, or on without it."""
    v, u = np.mgrid[-16:16, -16:16] / 16
    p = np.stack([2 * np.sqrt(np.maximum(0.25 - (u - f / 16) ** 2 - v**2, 0)) + covered * (1 + 0.1 * v) for f in range(8)])
    light = np.exp(-p)
    if photons:
        light = np.random.default_rng(1).poisson(photons * light) / photons
    start = {"off": 0 * light[0], "the same image": light[0], "air": np.ones_like(light[0])}[before]
    seen = (add_lag(light, lag) + lag ** np.arange(1, 9)[:, None, None] * start).clip(1e-4)
    panel = replace(GEOMETRY, detector_shape=v.shape)
    orbit = CircularOrbit(panel, ConstantSpeed(0.1, 0.25))
    recorded = replace(scan(frames(8), lag=lag), geometry=panel, trajectory=orbit, projections=np.float32(-np.log(seen)))
    clean = without_lag(recorded)
    np.testing.assert_allclose(np.exp(-clean.projections)[clean.valid], light[clean.valid], atol=1e-3)
    assert ("beam was on" in caplog.text) == (before != "off") and (before == "off" or before in caplog.text)


def test_masks_follow_the_light_and_ghosts_are_masked() -> None:
    mask = np.zeros((5, *SHAPE), bool)
    mask[1, 2, 3] = True
    clean, expected = without_lag(scan(lagged(frames(), 0.1), lag=0.1, pixel_mask=mask)), mask.copy()
    expected[2, 2, 3] = True  # what it gave to the next frame is not known
    np.testing.assert_array_equal(clean.pixel_mask, expected)
    fixed = without_lag(scan(lagged(frames(), 0.1), lag=0.1, pixel_mask=mask[1]))
    np.testing.assert_array_equal(fixed.pixel_mask, mask[1])
    p = frames(3)
    p[0, 1, 1], p[1, 1, 1] = 0.0, 9.0  # recorded: less than a tenth of the frame before
    clean = without_lag(scan(p, lag=0.1))
    assert clean.pixel_mask[1, 1, 1] and np.isfinite(clean.projections).all() and not clean.pixel_mask[0].any()


def test_electronic_noise_grows_and_photon_noise_does_not() -> None:
    lag, count = 0.3, 4000
    p, rng = np.zeros((count, 2, 2)), np.random.default_rng(5)
    expected = {0.0: np.sqrt(1e4), 200.0: np.hypot(100.0, 200.0 * np.sqrt(1 + lag**2) / (1 - lag))}
    for electronic, deviation in expected.items():
        noisy = beer_lambert_noise(p, 1e4, electronic, rng, lag=lag)
        recorded = 1e4 * np.exp(-noisy.astype(np.float64))
        counts = (recorded - lag * np.roll(recorded, 1, axis=0)) / (1 - lag)
        assert counts[1:].std() == pytest.approx(deviation, rel=0.03)
