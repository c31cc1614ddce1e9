"""Counts to line integrals, and the two detector models."""

import numpy as np
import pytest

from phyradgs_cl.detector import average, counts_to_attenuation

KEY = np.array([2, 1, 0, 3, 0, 1, 2])


def test_flats_and_darks_are_averaged_and_the_inverse_inverts() -> None:
    """Whatever the gain, of frames in the order of KEY."""
    rng = np.random.default_rng(0)
    p = rng.uniform(0, 5, (2, 5, 6))
    flat, dark = rng.uniform(3e4, 6e4, (5, 6)), rng.uniform(50, 200, (5, 6))
    frames = np.empty((7, 5, 6))
    frames[KEY == 0] = dark + (flat - dark) * np.exp(-p)
    frames[KEY == 1] = np.stack([flat - 100, flat + 100])  # only their mean is the flat
    frames[KEY == 2] = np.stack([dark - 9, dark + 9])
    frames[KEY == 3] = np.nan
    for gain in (1.0, 7.5):
        result, unusable = counts_to_attenuation(gain * frames, KEY, "counts")
        assert result.dtype == np.float32 and result.shape == p.shape and np.allclose(result, p, atol=1e-5)
        assert unusable.dtype == bool and not unusable.any()


def test_counts_below_the_dark_dead_pixels_and_missing_darks() -> None:
    frames = np.array([[[100, 100]], [[1100, 1100]], [[90, 600]]], dtype=np.uint16)
    result, unusable = counts_to_attenuation(frames, [2, 1, 0], "counts")
    assert unusable.tolist() == [[[True, False]]]
    assert result[0, 0, 1] == pytest.approx(np.log(2)) and result[0, 0, 0] == pytest.approx(6 * np.log(10))
    frames = np.array([[[10.0, 10, 10, 10]], [[10.0, 1e4, 1e4, np.nan]], [[50.0, np.nan, np.inf, 50.0]]])
    result, unusable = counts_to_attenuation(frames, [2, 1, 0], "counts")
    assert unusable.all() and np.isfinite(result).all()
    frames = np.array([[[1000.0]], [[500.0]]])
    assert counts_to_attenuation(frames, [1, 0], "counts")[0].item() == pytest.approx(np.log(2))


def test_transmission_and_attenuation() -> None:
    data = np.array([[[1.0, 0.5, 0.0, -0.1, np.nan]]])
    result, unusable = counts_to_attenuation(data, [0], "transmission")
    assert np.allclose(result[0, 0, :2], [0, np.log(2)])
    assert unusable.tolist() == [[[False, False, True, True, True]]] and np.isfinite(result).all()
    result, unusable = counts_to_attenuation(data, [0], "attenuation")
    assert result[0, 0].tolist() == [1.0, 0.5, 0.0, pytest.approx(-0.1), 0.0]
    assert unusable.tolist() == [[[False, False, False, False, True]]]
    assert counts_to_attenuation(np.full((1, 1, 1), 1e300), [0], "attenuation")[1].all()


def test_both_models_from_their_definitions() -> None:
    """However dark or bright it is; samples without weight do not count."""
    rng = np.random.default_rng(0)
    w, p = rng.uniform(0.1, 1, 6), rng.uniform(0, 4, (6, 3, 5))
    w /= w.sum()
    mean, light = sum(w[i] * p[i] for i in range(6)), sum(w[i] * np.exp(-p[i]) for i in range(6))
    assert np.allclose(average(p, w, "log"), mean, rtol=1e-14)
    assert np.allclose(average(p, w, "intensity"), -np.log(light), rtol=1e-13)
    for shift in (2000.0, -2000.0):
        assert np.allclose(average(p + shift, w, "intensity"), average(p, w, "intensity") + shift, atol=1e-11)
    light = (np.exp(-1) + np.exp(-2)) / 2
    assert average([-5000.0, 1.0, 2.0], [0.0, 0.5, 0.5], "intensity") == pytest.approx(-np.log(light))
