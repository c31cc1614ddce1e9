"""The two detector models."""

from __future__ import annotations

import numpy as np
import pytest

from phyradgs_cl.detector import average
from phyradgs_cl.errors import InputError


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
    p, w = _samples()
    assert (average(p, w, "intensity") < average(p, w, "log")).all()  # Jensen
    still = np.broadcast_to(p[0], p.shape)
    assert np.allclose(average(still, w, "intensity"), p[0], rtol=1e-14)


@pytest.mark.parametrize("shift", [2000.0, -2000.0])
def test_no_overflow_and_a_constant_comes_through(shift: float) -> None:
    p, w = _samples()
    assert np.allclose(average(p + shift, w, "intensity"), average(p, w, "intensity") + shift, atol=1e-11)


def test_samples_without_weight_do_not_count() -> None:
    p = np.array([-5000.0, 1.0, 2.0])
    assert average(p, [0.0, 0.5, 0.5], "intensity") == pytest.approx(-np.log((np.exp(-1) + np.exp(-2)) / 2))


def test_wrong_arguments_are_refused() -> None:
    p, w = _samples()
    with pytest.raises(InputError, match="detector model"):
        average(p, w, "linear")
    with pytest.raises(InputError, match="weight: found shape"):
        average(p, w[:-1], "log")
    with pytest.raises(InputError, match="weight: found sum 2"):
        average(p, 2 * w, "log")
    with pytest.raises(InputError, match="not negative"):
        average([1.0, 1.0], [1.5, -0.5], "log")
    with pytest.raises(InputError, match="at least one time"):
        average(np.zeros((0, 3)), [], "log")
