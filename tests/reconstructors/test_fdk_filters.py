"""Ramp filters: the space-domain kernel, and what windows do to spectrum and noise."""

import numpy as np
import pytest
from tolerances import FLOAT64, RAMP

from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import fdk_volume, ramp_filter, ramp_spectrum


@pytest.mark.parametrize("width", [1, 2, 17, 64])
def test_ramp_filter_is_a_convolution(width) -> None:
    """Kak and Slaney's kernel h(0) = 1/4τ², h(odd n) = −1/(πnτ)², times τ, without wrapping around."""
    spacing_mm, n, kernel = 0.37, np.arange(-(width - 1), width), np.zeros(2 * width - 1)
    kernel[n % 2 != 0] = -1 / (np.pi * n[n % 2 != 0] * spacing_mm) ** 2
    kernel[n == 0] = 1 / (4 * spacing_mm**2)
    for dtype in (np.float32, np.float64):
        rows = np.random.default_rng(63).normal(size=(3, width)).astype(dtype)
        expected = np.stack([np.convolve(row, kernel) for row in rows])[:, width - 1 : 2 * width - 1] * spacing_mm
        found = ramp_filter(rows, spacing_mm)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, rtol=0, atol=RAMP * np.abs(expected).max())


def test_spectra_of_the_ramp_and_its_windows() -> None:
    """And a row of odd length, which has no sample at that frequency."""
    sinc = np.sin(np.pi / 4) / (np.pi / 4)
    at = {"ram-lak": (1, 1), "shepp-logan": (sinc, 2 / np.pi), "cosine": (np.sqrt(0.5), 0), "hamming": (0.54, 0.08)}
    for window, (quarter, nyquist) in {**at, "hann": (0.5, 0)}.items():
        ratio = ramp_spectrum(256, window) / ramp_spectrum(256)
        assert ratio[[0, 64, 128]] == pytest.approx([1, quarter, nyquist], rel=FLOAT64, abs=FLOAT64), window
    ratio = ramp_spectrum(225, "hann") / ramp_spectrum(225)
    np.testing.assert_allclose(ratio, 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(113) / 225), rtol=FLOAT64)
    spectrum = ramp_spectrum(256)
    np.testing.assert_allclose(spectrum, np.arange(129) / 256, atol=0.01)
    assert 0 < spectrum[0] < 0.002


def test_noise_falls_from_window_to_window(rt) -> None:
    geometry = ConeGeometry(6.0, 9.0, (8, 48), (0.075, 0.075))
    pose = geometry.pose(np.arange(40) * 2 * np.pi / 40)
    frames = np.random.default_rng(66).normal(size=(40, 8, 48)).astype(np.float32)
    grid = Grid((2, 24, 24), (0.05, 0.06, 0.06))
    windows = ["ram-lak", "shepp-logan", "cosine", "hamming", "hann"]
    noise = [fdk_volume(rt, frames, pose, grid, window=window).std() for window in windows]
    assert all(after < 0.97 * before for before, after in zip(noise[:-1], noise[1:], strict=True))
