"""The two detector models."""

from functools import partial

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.detector import average


def _samples() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    weight = rng.uniform(0.1, 1, 6)
    return rng.uniform(0, 4, (6, 3, 5)), weight / weight.sum()


def test_both_models_from_their_definitions() -> None:
    p, w = _samples()
    mean = sum(w[i] * p[i] for i in range(6))
    light = sum(w[i] * np.exp(-p[i]) for i in range(6))
    assert np.allclose(average(p, w, "log"), mean, rtol=1e-14)
    assert np.allclose(average(p, w, "intensity"), -np.log(light), rtol=1e-13)


def test_a_detector_never_sees_more_attenuation_than_the_mean() -> None:
    """A constant comes through, however dark or bright; samples without weight do not count."""
    p, w = _samples()
    assert (average(p, w, "intensity") < average(p, w, "log")).all()  # Jensen
    assert np.allclose(average(np.broadcast_to(p[0], p.shape), w, "intensity"), p[0], rtol=1e-14)
    for shift in (2000.0, -2000.0):
        assert np.allclose(average(p + shift, w, "intensity"), average(p, w, "intensity") + shift, atol=1e-11)
    light = (np.exp(-1) + np.exp(-2)) / 2
    assert average([-5000.0, 1.0, 2.0], [0.0, 0.5, 0.5], "intensity") == pytest.approx(-np.log(light))


def test_wrong_arguments_are_refused() -> None:
    p, w = _samples()
    calls = {
        "detector model": (p, w, "linear"), "weight: found shape": (p, w[:-1], "log"),
        "weight: found sum 2": (p, 2 * w, "log"), "not negative": ([1.0, 1.0], [1.5, -0.5], "log"),
        "at least one time": (np.zeros((0, 3)), [], "log"),
    }  # fmt: skip
    assert_refused({words: partial(average, *call) for words, call in calls.items()})
