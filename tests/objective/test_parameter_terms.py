"""The term of the mean density: by hand; the kernel adds the same to its gradients as the twin."""

import numpy as np
import pytest
from kernel_kit import assert_near
from tolerances import FLOAT32, FLOAT64, PARAMETER_GRADIENT

from phyradgs_cl.fields import Activation
from phyradgs_cl.objective.terms import mean_density
from phyradgs_cl.optim import DeviceAdam

WEIGHT, ACTIVATION = 0.3, Activation(0.01, 0.6)


def test_values_by_hand() -> None:
    rows = np.zeros((11, 2))
    rows[10] = [1.0, 3.0]
    value, gradient = mean_density(rows, WEIGHT)
    assert value == pytest.approx(WEIGHT * 2, rel=FLOAT64)
    assert gradient[10] == pytest.approx([WEIGHT / 2] * 2) and not gradient[:10].any()
    value, gradient = mean_density(np.zeros((11, 0)), WEIGHT)
    assert value == 0 and gradient.shape == (11, 0)


def on_device(rt, raw: np.ndarray) -> tuple:
    """Raw numbers (11, count): the optimiser, them as they are, their activation, zeros for gradients and statistics."""
    count, stride = raw.shape[1], -(-raw.shape[1] // 16) * 16
    padded = np.zeros((11, stride), np.float32)
    padded[6], padded[:, :count] = 1.0, raw
    adam, device_raw, parameters = DeviceAdam(rt, ACTIVATION), rt.upload(padded), rt.zeros((11, stride))
    adam.activate(device_raw, parameters, count, stride)
    return adam, device_raw, parameters, rt.zeros((13, stride)), rt.zeros((2, stride))


@pytest.mark.parametrize("count", [1, 5, 16, 21])
def test_kernel_chains_them_to_raw_numbers(two_rt, make_cloud, finite_differences, count) -> None:
    raw = ACTIVATION.invert(make_cloud(count, 72, scale=(0.03, 0.3))).astype(np.float32).astype(float)
    raw[6:10] *= 1.7  # raw quaternions need not be unit
    adam, device_raw, parameters, gradients, statistics = on_device(two_rt, raw)
    active = two_rt.download(parameters)[:, :count]
    np.testing.assert_allclose(active, ACTIVATION.apply(raw), rtol=FLOAT32, atol=FLOAT32)
    adam.chain(device_raw, parameters, gradients, statistics, count, gradients.shape[1], density_weight=WEIGHT)
    found = two_rt.download(gradients)[:11, :count]
    expected = finite_differences(lambda r: mean_density(ACTIVATION.apply(r), WEIGHT)[0], raw)
    assert_near(found, expected, PARAMETER_GRADIENT)
    np.testing.assert_array_equal(two_rt.download(statistics), 0)  # nothing was in view


def test_statistics_gather_norms_and_sightings(any_rt, make_cloud) -> None:
    count, stride = 4, 16
    adam, device_raw, parameters, _, statistics = on_device(any_rt, ACTIVATION.invert(make_cloud(count, 73)))
    for _ in range(3):
        by = np.zeros((13, stride), np.float32)
        by[11, :count], by[12, :count] = [3.0, 0.0, -6.0, 0.0], [4.0, 2.0, 8.0, 0.0]
        adam.chain(device_raw, parameters, any_rt.upload(by), statistics, count, stride, density_weight=0.0)
    found = any_rt.download(statistics)
    np.testing.assert_allclose(found[0, :count], [15.0, 6.0, 30.0, 0.0], rtol=FLOAT32)
    np.testing.assert_array_equal(found[1, :count], [3, 3, 3, 0])
