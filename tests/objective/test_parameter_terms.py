"""Density and shape terms: twin against finite differences; the kernel adds the same to its gradients."""

from dataclasses import FrozenInstanceError, asdict

import numpy as np
import pytest
from kernel_kit import assert_near
from tolerances import FLOAT32, FLOAT64, PARAMETER_GRADIENT, TWIN_GRADIENT

from phyradgs_cl.fields import Activation
from phyradgs_cl.objective.terms import ParameterTerms, parameter_loss
from phyradgs_cl.optim import DeviceAdam

TERMS = ParameterTerms(density_weight=0.3, shape_weight=0.7, shape_ratio=3.0, shape_floor=0.08)


def test_twin_is_differentiated_right(make_cloud, finite_differences) -> None:
    rows = make_cloud(12, 71, scale=(0.03, 0.3))
    ratio = rows[3:6].max(0) / rows[3:6].min(0)
    assert 0 < (ratio > TERMS.shape_ratio).sum() < 12  # both sides of both kinks
    assert 0 < (rows[3:6].min(0) < TERMS.shape_floor).sum() < 12
    expected = finite_differences(lambda r: parameter_loss(r, TERMS)[0], rows)
    assert_near(parameter_loss(rows, TERMS)[1], expected, TWIN_GRADIENT)


def test_values_by_hand() -> None:
    rows = np.zeros((11, 2))
    rows[3:6, 0], rows[3:6, 1], rows[10] = [0.1, 0.2, 0.5], [0.05, 0.1, 0.1], [1.0, 3.0]
    value, _ = parameter_loss(rows, TERMS)
    assert value == pytest.approx(0.3 * 2 + 0.7 * ((5 - 3) ** 2 + (0.08 - 0.05) ** 2) / 2, rel=FLOAT64)
    value, gradient = parameter_loss(np.zeros((11, 0)), TERMS)
    assert value == 0 and gradient.shape == (11, 0)
    assert ParameterTerms() == ParameterTerms(0.001, 0.0, 10.0, 0.004)
    with pytest.raises(FrozenInstanceError):
        TERMS.shape_weight = 1.0


@pytest.mark.parametrize("count", [1, 5, 16, 21])
def test_kernel_chains_them_to_raw_numbers(any_rt, make_cloud, finite_differences, count) -> None:
    activation = Activation(0.01, 0.6)
    raw = activation.invert(make_cloud(count, 72, scale=(0.03, 0.3))).astype(np.float32).astype(float)
    raw[6:10] *= 1.7  # raw quaternions need not be unit
    stride = -(-count // 16) * 16
    padded = np.zeros((11, stride), np.float32)
    padded[6] = 1.0
    padded[:, :count] = raw
    adam, device_raw = DeviceAdam(any_rt, activation), any_rt.upload(padded)
    parameters, gradients = any_rt.zeros((11, stride)), any_rt.zeros((13, stride))
    statistics = any_rt.zeros((2, stride))
    adam.activate(device_raw, parameters, count, stride)
    active = any_rt.download(parameters)[:, :count]
    np.testing.assert_allclose(active, activation.apply(raw), rtol=FLOAT32, atol=FLOAT32)
    adam.chain(device_raw, parameters, gradients, statistics, count, stride, **asdict(TERMS))
    found = any_rt.download(gradients)[:11, :count]
    expected = finite_differences(lambda r: parameter_loss(activation.apply(r), TERMS)[0], raw)
    assert_near(found, expected, PARAMETER_GRADIENT)
    np.testing.assert_array_equal(any_rt.download(statistics), 0)  # nothing was in view


def test_statistics_gather_norms_and_sightings(any_rt, make_cloud) -> None:
    activation, count, stride = Activation(0.01, 0.6), 4, 16
    raw = np.zeros((11, stride), np.float32)
    raw[6] = 1.0
    raw[:, :count] = activation.invert(make_cloud(count, 73))
    adam, device_raw = DeviceAdam(any_rt, activation), any_rt.upload(raw)
    statistics, parameters = any_rt.zeros((2, stride)), any_rt.zeros((11, stride))
    adam.activate(device_raw, parameters, count, stride)
    for _ in range(3):
        by = np.zeros((13, stride), np.float32)
        by[11, :count], by[12, :count] = [3.0, 0.0, -6.0, 0.0], [4.0, 2.0, 8.0, 0.0]
        weights = {"density_weight": 0.0, "shape_weight": 0.0, "shape_ratio": 10.0, "shape_floor": 0.0}
        adam.chain(device_raw, parameters, any_rt.upload(by), statistics, count, stride, **weights)
    found = any_rt.download(statistics)
    np.testing.assert_allclose(found[0, :count], [15.0, 6.0, 30.0, 0.0], rtol=FLOAT32)
    np.testing.assert_array_equal(found[1, :count], [3, 3, 3, 0])
