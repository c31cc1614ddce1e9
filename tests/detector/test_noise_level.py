"""Estimates from frames: noise, transmission weights, and which raw counts are clipped."""

from itertools import product

import numpy as np
import pytest

from phyradgs_cl.detector import noise_level, noise_rms, transmission_weights
from phyradgs_cl.detector.effects import beer_lambert_noise
from phyradgs_cl.detector.noise_level import find_saturation, noise_behind


def smooth_frames(noise: float, seed: int = 0) -> np.ndarray:
    """A dome of height 1 over 160 columns, and air around it."""
    u = np.linspace(-1.2, 1.2, 192)
    dome = np.maximum(1 - u**2, 0) ** 2 * np.ones((5, 40, 1))
    noisy = dome + noise * (dome > 0) * np.random.default_rng(seed).normal(size=dome.shape)
    return noisy.astype(np.float32)


def test_white_noise_is_found_behind_the_object_in_pixels_that_are_valid() -> None:
    for noise in (0.01, 0.05):
        assert noise_level(smooth_frames(noise)) == pytest.approx(noise, rel=0.05)
    assert 0 < noise_level(smooth_frames(0.0)) < 1e-3
    some, rows = smooth_frames(0.02), np.s_[:, 20:21]
    behind = some > 0.2
    assert noise_rms(some[rows], behind[rows], behind[rows]) == pytest.approx(0.02, rel=0.1)  # a panel of one row
    for shape in [(2, 3, 2), (1, 1, 1), (2, 4, 8)]:
        assert noise_level(np.zeros(shape, np.float32)) == 0
    valid = np.ones(some.shape, bool)
    valid[:, :, 10:14] = False
    some[:, :, 10:14] += 10 * np.random.default_rng(1).normal(size=(5, 40, 4)).astype(np.float32)
    assert noise_level(some, valid) == pytest.approx(0.02, rel=0.05)


BODIES = {  # radii (v, u) in pixels, and how many of them a frame has
    "bead": ((2, 2), 1), "speck": ((0.6, 0.6), 1), "beads": ((3, 3), 4), "needle": ((20, 0.7), 1), "ball": ((20, 20), 1),
    "plate": ((3, 40), 1), "full": ((200, 200), 1),
}  # fmt: skip


def body_frames(name: str) -> np.ndarray:
    """Line integrals (8, 64, 96) of ellipsoids, up to 1 each, at other places in each frame; 0 in air."""
    (radii, count), rng = BODIES[name], np.random.default_rng(3)
    v, u = np.mgrid[:64, :96]
    frames = np.zeros((8, 64, 96))
    for frame in frames:
        for centre in rng.uniform(0.35, 0.65, (count, 2)) * (64, 96):
            far = ((v - centre[0]) / radii[0]) ** 2 + ((u - centre[1]) / radii[1]) ** 2
            frame += np.sqrt(np.maximum(1 - far, 0))
    return frames


@pytest.mark.parametrize("name", BODIES)
def test_edges_of_bodies_of_every_size_are_no_noise(name) -> None:
    """Air is 0 without noise, clipped at 0, or below 0 where the beam has become brighter."""
    p, every = body_frames(name), np.ones((8, 64, 96), bool)
    assert max(noise_level(p.astype(np.float32)), noise_behind(p.astype(np.float32), every)) < 5e-3
    for photons in (1e3, 1e4, 1e6):
        noisy = -np.log(np.random.default_rng(1).poisson(photons * np.exp(-p)) / photons)
        true = float(np.std(noisy - p))
        for air, least in ((0.0, 0.85), (-0.2, 0.85)):
            assert least * true < noise_level((noisy + air).astype(np.float32)) < 1.4 * true + 4e-4
        assert 0.4 * true < noise_level(np.maximum(noisy, 0).astype(np.float32)) < 1.4 * true + 4e-4
        if name in ("ball", "plate"):  # air that was set to 0
            masked, behind = np.where(p > 0, noisy, 0).astype(np.float32), float(np.std((noisy - p)[p > 0]))
            for found in (noise_level(masked), noise_behind(masked, every)):
                assert 0.85 * behind < found < 1.2 * behind + 8e-4


def test_the_noise_behind_the_object_does_not_depend_on_the_air() -> None:
    """Half of air's noise is gone in files that are clipped at 0, and most of their pixels are air."""
    u = np.linspace(-3, 3, 192)
    dome = np.maximum(1 - u**2, 0) ** 2 * np.ones((40, 40, 1))
    noisy = (dome + 0.02 * np.random.default_rng(0).normal(size=dome.shape)).astype(np.float32)
    every, clipped = np.ones(noisy.shape, bool), np.maximum(noisy, 0)
    assert noise_level(clipped) < 0.8 * 0.02
    for frames in (noisy, clipped):
        assert noise_behind(frames, every) == pytest.approx(0.02, rel=0.08)
    assert noise_behind(np.zeros((2, 3, 2), np.float32), np.ones((2, 3, 2), bool)) == 0


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


AIR, SHAPE = 50_000.0, (4, 48, 64)


def counts(noisy: bool, seed: int = 0) -> np.ndarray:
    """Counts (4, 48, 64) of a ball that moves, with air around it, rounded."""
    v, u = np.mgrid[:48, :64]
    chords = [2 * np.sqrt(np.clip(400 - (v - 23.5) ** 2 - (u - c) ** 2, 0, None)) for c in (25, 30, 35, 40)]
    expected = AIR * np.exp(-0.05 * np.stack(chords))
    return np.round(np.random.default_rng(seed).normal(expected, np.sqrt(expected))) if noisy else np.round(expected)


def test_a_panel_that_clips_is_found() -> None:
    for level, flat_too, dtype in product((40_000, 50_100), (False, True), (np.uint16, np.float32, np.float64)):
        frames = np.minimum(counts(noisy=True) + 400, level).astype(dtype)
        found = find_saturation(frames, np.full(SHAPE[1:], min(AIR + 400, level) if flat_too else AIR + 400))
        assert found.level == level and found.share == np.mean(frames == level) > 0.3
    scaled = np.minimum(counts(noisy=True), 40_000) / 7  # by a dose, or a mean of frames
    assert find_saturation(scaled, np.full(SHAPE[1:], AIR / 7)).share > 0.3


GOOD = {
    "noise": (counts(noisy=True), AIR), "no noise": (counts(noisy=False), AIR),
    "no noise at the end of 16 bits": (np.round(counts(noisy=False) * 65535 / AIR), 65535.0),
    "no noise, under a beam that falls": (counts(noisy=False) * np.array([0.971, 0.9, 0.8, 0.7])[:, None, None] + 0.3, AIR),
    "noise and a hot pixel": (np.where(np.arange(64) == 9, 65535, counts(noisy=True)) * (np.arange(48) == 9)[:, None], AIR),
    "NaN": (np.where(counts(True) > 50_500, np.nan, counts(True)), AIR),
}


def test_what_is_not_clipped_is_not_found_and_what_is_all_clipped_is(recwarn) -> None:
    for name, (frames, flat) in GOOD.items():
        found = find_saturation(frames, np.full(SHAPE[1:], flat))
        assert found.share == 0 and found.level == np.nanmax(frames), name
    for frames, share in ((np.full(SHAPE, 4095), 1.0), (np.full(SHAPE, np.nan), 0.0)):
        assert find_saturation(frames, np.full(SHAPE[1:], 4095.0)).share == share
    assert not recwarn
