"""Averages over an exposure: gradients, and random subsets of times that are right on average."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from tolerances import FINITE_DIFFERENCE_STEP, FLOAT64, GRADIENT

from phyradgs_cl.errors import InputError
from phyradgs_cl.neural import NeuralOptions
from phyradgs_cl.neural.field import first_field
from phyradgs_cl.neural.trainer import intensity_average, line_integrals, log_squares, sample_shifts

RAYS, TIMES, SAMPLES = 6, 5, 24
SMALL = NeuralOptions(levels=2, base_resolution=3, width=8, first_share=0.3)


@pytest.fixture(scope="module")
def field() -> torch.nn.Module:
    """A field in float64 that varies in space."""
    made = first_field(SMALL, 16, 3).double()
    with torch.no_grad():
        made.encoding.table.uniform_(-1, 1, generator=torch.Generator().manual_seed(1))
    return made


@pytest.fixture(scope="module")
def bundle() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Sources, directions (R · K, 3) and shifts of rays that turn about the z axis with time."""
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 0.4, TIMES)
    source = np.tile(np.stack([4 * np.cos(angle), 4 * np.sin(angle), 0 * angle], -1), (RAYS, 1, 1))
    target = np.tile(rng.uniform(-0.5, 0.5, (RAYS, 1, 3)), (1, TIMES, 1))
    direction = target - source
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    shifts = sample_shifts(RAYS * TIMES, SAMPLES, "ray", rng).astype(np.float64)
    return torch.tensor(source.reshape(-1, 3)), torch.tensor(direction.reshape(-1, 3)), torch.tensor(shifts)


def loss(field, bundle, model: str, times: list[int]) -> torch.Tensor:
    """The mean squared error of a step against measurements of a bundle, from some times of each ray."""
    integrals = line_integrals(field, *bundle[:2], torch.ones(3, dtype=torch.float64), SAMPLES, bundle[2])
    part = integrals.reshape(RAYS, TIMES)[:, times]
    measured = torch.linspace(0.1, 0.9, RAYS, dtype=torch.float64)
    if model == "intensity":
        return ((intensity_average(part, 3.0) - measured) ** 2).mean()
    return log_squares(part, measured, TIMES).mean()


@pytest.mark.parametrize(
    ("model", "times"), [("log", [0, 1, 2, 3, 4]), ("log", [1, 4]), ("intensity", [0, 1, 2, 3, 4])]
)
def test_gradients_are_finite_differences(field, bundle, model, times) -> None:
    field.zero_grad()
    loss(field, bundle, model, times).backward()
    rng = np.random.default_rng(2)
    for parameter in field.parameters():
        direction = torch.tensor(rng.normal(size=parameter.shape))
        expected = float((parameter.grad * direction).sum())
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter += sign * FINITE_DIFFERENCE_STEP * direction
                values.append(float(loss(field, bundle, model, times)))
                parameter -= sign * FINITE_DIFFERENCE_STEP * direction
        found = (values[0] - values[1]) / (2 * FINITE_DIFFERENCE_STEP)
        assert found == pytest.approx(expected, rel=GRADIENT, abs=GRADIENT * float(parameter.grad.norm()))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_mean_over_all_subsets_of_times_is_the_loss_of_all_times(field, bundle, count) -> None:
    """Value and gradient: the plain square of a subset's mean would be too large by the variance over the exposure."""
    subsets = [list(times) for times in combinations(range(TIMES), count)]
    field.zero_grad()
    mean = sum(loss(field, bundle, "log", times) for times in subsets) / len(subsets)
    mean.backward()
    found = [p.grad.clone() for p in field.parameters()]
    field.zero_grad()
    whole = loss(field, bundle, "log", list(range(TIMES)))
    whole.backward()
    assert float(mean.detach()) == pytest.approx(float(whole.detach()), rel=FLOAT64)
    for gradient, parameter in zip(found, field.parameters(), strict=True):
        slack = 1e-8 * float(parameter.grad.abs().max())
        assert torch.allclose(gradient, parameter.grad, rtol=1e-8, atol=slack)


def test_how_many_times_a_step_looks_at_and_how_light_is_averaged(bundle) -> None:
    options = NeuralOptions()
    assert [options.times_for(5, model) for model in ("log", "intensity")] == [5, 5]
    assert replace(options, times=2).times_for(5, "log") == 2
    assert options.times_for(1, "log") == 1
    assert replace(options, times=9).times_for(5, "intensity") == 5
    with pytest.raises(InputError, match="option times: found 3 of 5 times in the intensity model.*biased"):
        replace(options, times=3).times_for(5, "intensity")
    with pytest.raises(InputError, match="option times: found 1 of 5 times.*biased"):
        replace(options, times=1).times_for(5, "log")
    integrals = torch.tensor([[0.1, 0.9, 2.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    expected = [-np.log(np.mean(np.exp(-4 * np.array(row)))) / 4 for row in integrals.tolist()]
    assert np.allclose(intensity_average(integrals, 4.0).tolist(), expected, rtol=1e-12)
