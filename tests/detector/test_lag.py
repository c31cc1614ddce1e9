"""Detector lag: what it does to a step of light, and that undoing it gives the frames back."""

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Scan, Shutter
from phyradgs_cl.detector import add_lag, beer_lambert_noise, lagged, without_lag
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

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
    assert seen.sum() == pytest.approx(1.0)
    assert add_lag(np.ones((60, 1, 1)), 0.25)[-1, 0, 0] == pytest.approx(1.0)


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
    for lag in (-0.1, 0.95, float("nan")):
        with pytest.raises(InputError, match="lag"):
            scan(p, lag=lag)


def test_masks_follow_the_light_and_ghosts_are_masked() -> None:
    mask = np.zeros((5, *SHAPE), bool)
    mask[1, 2, 3] = True
    clean = without_lag(scan(lagged(frames(), 0.1), lag=0.1, pixel_mask=mask))
    expected = mask.copy()
    expected[2, 2, 3] = True  # what it gave to the next frame is not known
    np.testing.assert_array_equal(clean.pixel_mask, expected)
    fixed = without_lag(scan(lagged(frames(), 0.1), lag=0.1, pixel_mask=mask[1]))
    np.testing.assert_array_equal(fixed.pixel_mask, mask[1])
    p = frames(3)
    p[0, 1, 1], p[1, 1, 1] = 0.0, 9.0  # recorded: less than a tenth of the frame before
    clean = without_lag(scan(p, lag=0.1))
    assert clean.pixel_mask[1, 1, 1] and np.isfinite(clean.projections).all()
    assert not clean.pixel_mask[0].any()


def test_electronic_noise_grows_and_photon_noise_does_not() -> None:
    lag, count = 0.3, 4000
    p, rng = np.zeros((count, 2, 2)), np.random.default_rng(5)
    expected = {0.0: np.sqrt(1e4), 200.0: np.hypot(100.0, 200.0 * np.sqrt(1 + lag**2) / (1 - lag))}
    for electronic, deviation in expected.items():
        noisy = beer_lambert_noise(p, 1e4, electronic, rng, lag=lag)
        recorded = 1e4 * np.exp(-noisy.astype(np.float64))
        counts = (recorded - lag * np.roll(recorded, 1, axis=0)) / (1 - lag)
        assert counts[1:].std() == pytest.approx(deviation, rel=0.03)


def test_noise_without_lag_is_the_noise_it_was_and_less_light_is_more() -> None:
    p = frames()
    plain, zero = (
        beer_lambert_noise(p, 1e4, 10.0, np.random.default_rng(1), **m) for m in ({}, {"lag": 0.0})
    )
    np.testing.assert_array_equal(plain, zero)
    light = np.where(np.arange(200)[:, None] < 100, 1.0, 0.25)
    noisy = beer_lambert_noise(np.zeros((1, 200, 200)), 1e4, 0.0, np.random.default_rng(1), light)[0]
    assert noisy[100:].std() == pytest.approx(2 * noisy[:100].std(), rel=0.05)
    assert abs(noisy[100:].mean()) < 1e-3
