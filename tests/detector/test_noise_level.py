"""The estimate of noise from the line integrals themselves."""

import numpy as np
import pytest

from phyradgs_cl.detector import noise_behind, noise_level, noise_rms


def smooth_frames(noise: float, seed: int = 0) -> np.ndarray:
    """A dome of height 1 over 160 columns, and air around it."""
    u = np.linspace(-1.2, 1.2, 192)
    dome = np.maximum(1 - u**2, 0) ** 2 * np.ones((5, 40, 1))
    noisy = dome + noise * (dome > 0) * np.random.default_rng(seed).normal(size=dome.shape)
    return noisy.astype(np.float32)


def test_white_noise_is_found_behind_the_object() -> None:
    for noise in (0.01, 0.05):
        assert noise_level(smooth_frames(noise)) == pytest.approx(noise, rel=0.05)
    assert 0 < noise_level(smooth_frames(0.0)) < 1e-3
    some, rows = smooth_frames(0.02), np.s_[:, 20:21]
    behind = some > 0.2
    assert noise_rms(some[rows], behind[rows], behind[rows]) == pytest.approx(0.02, rel=0.1)  # a panel of one row
    for shape in [(2, 3, 2), (1, 1, 1), (2, 4, 8)]:
        assert noise_level(np.zeros(shape, np.float32)) == 0


def test_pixels_that_are_not_valid_do_not_count() -> None:
    frames = smooth_frames(0.02)
    valid = np.ones(frames.shape, bool)
    valid[:, :, 10:14] = False
    frames[:, :, 10:14] += 10 * np.random.default_rng(1).normal(size=(5, 40, 4)).astype(np.float32)
    assert noise_level(frames, valid) == pytest.approx(0.02, rel=0.05)


def test_the_noise_behind_the_object_does_not_depend_on_the_air() -> None:
    """Half of air's noise is gone in files that are clipped at 0, and most of their pixels are air."""
    u = np.linspace(-3, 3, 192)
    dome = np.maximum(1 - u**2, 0) ** 2 * np.ones((40, 40, 1))
    noisy = (dome + 0.02 * np.random.default_rng(0).normal(size=dome.shape)).astype(np.float32)
    every = np.ones(noisy.shape, bool)
    clipped = np.maximum(noisy, 0)
    assert noise_level(clipped) < 0.8 * 0.02
    for frames in (noisy, clipped):
        assert noise_behind(frames, every) == pytest.approx(0.02, rel=0.08)
    assert noise_behind(np.zeros((2, 3, 2), np.float32), np.ones((2, 3, 2), bool)) == 0
