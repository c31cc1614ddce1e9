"""Adam: the kernel, its float64 twin and the textbook must take the same steps."""

import numpy as np
import pytest
from tolerances import ADAM_KERNEL, ADAM_SECOND_MOMENT, ADAM_TEXTBOOK, FLOAT32, FLOAT64

from phyradgs_cl.fields import Activation
from phyradgs_cl.optim import DeviceAdam, Rates, adam_step

STEPS = 6
RATES = np.array([1e-2] * 3 + [2e-2] * 3 + [5e-3] * 4 + [3e-2])


@pytest.fixture
def problem() -> tuple[np.ndarray, list[np.ndarray]]:
    """Raw parameters (11, 19) and gradients over six decades, some of them exactly zero."""
    rng = np.random.default_rng(91)
    raw = rng.normal(size=(11, 19)).astype(np.float32).astype(float)
    gradients = []
    for _ in range(STEPS):
        g = rng.normal(size=(11, 19)) * 10.0 ** rng.uniform(-6, 0, (11, 19))
        g[rng.uniform(size=g.shape) < 0.1] = 0
        gradients.append(g.astype(np.float32).astype(float))
    return raw, gradients


def textbook(raw: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Algorithm 1 of Kingma and Ba, bias corrections written out, ε = 1e-15."""
    theta, m, v = raw.copy(), np.zeros_like(raw), np.zeros_like(raw)
    for t, g in enumerate(gradients, start=1):
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g * g
        theta = theta - RATES[:, None] * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)
    return theta


def test_twin_is_the_textbooks(problem) -> None:
    raw, gradients = problem
    theta, moments = raw, np.zeros((2, *raw.shape))
    for step, g in enumerate(gradients, start=1):
        theta, moments = adam_step(theta, g, moments, RATES, step)
    np.testing.assert_allclose(theta, textbook(raw, gradients), rtol=0, atol=ADAM_TEXTBOOK * RATES.max())


def test_kernel_is_its_twin(any_rt, problem) -> None:
    raw, gradients = problem
    stride = 32
    padded = np.zeros((11, stride), np.float32)
    padded[:, :19] = raw
    device_raw, device_moments = any_rt.upload(padded), any_rt.zeros((2, 11, stride))
    adam = DeviceAdam(any_rt, Activation(0.01, 0.5))
    theta, moments = raw, np.zeros((2, *raw.shape))
    for step, g in enumerate(gradients, start=1):
        by = np.zeros((13, stride), np.float32)
        by[:11, :19] = g
        adam.step(device_raw, any_rt.upload(by), device_moments, stride, RATES, step)
        theta, moments = adam_step(theta, g, moments, RATES, step)
        moved = any_rt.download(device_raw)[:, :19] - raw
        np.testing.assert_allclose(moved, theta - raw, rtol=0, atol=ADAM_KERNEL * RATES.max())
    found = any_rt.download(device_moments)[:, :, :19]
    np.testing.assert_allclose(found[0], moments[0], rtol=FLOAT32)
    np.testing.assert_allclose(found[1], moments[1], rtol=ADAM_SECOND_MOMENT)
    np.testing.assert_array_equal(any_rt.download(device_raw)[:, 19:], 0)  # padding has no gradient


def test_rates_decay_exponentially() -> None:
    rates = Rates(position=(1e-2, 1e-4), scale=(4e-3, 4e-3), rotation=(1e-3, 1e-5), density=(1.0, 0.25))
    first, middle, last = (rates.at(p) for p in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(first, [1e-2] * 3 + [4e-3] * 3 + [1e-3] * 4 + [1.0], rtol=FLOAT64)
    np.testing.assert_allclose(last, [1e-4] * 3 + [4e-3] * 3 + [1e-5] * 4 + [0.25], rtol=FLOAT64)
    np.testing.assert_allclose(middle, np.sqrt(first * last), rtol=FLOAT64)
