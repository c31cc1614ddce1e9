"""Operators in PyTorch; collected only where PyTorch is installed (conftest.py)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tolerances import FLOAT32

from phyradgs_cl.api import Projector, as_torch, ray_operator
from phyradgs_cl.errors import InputError


def test_a_linear_operator_has_its_transpose_as_gradient(rt, scan) -> None:
    operator = ray_operator(scan, device=rt)
    project = as_torch(operator)
    rng = np.random.default_rng(0)
    volume = torch.tensor(rng.random(operator.volume_shape), dtype=torch.float64, requires_grad=True)
    weights = rng.random(operator.frames_shape)
    frames = project(volume)
    assert frames.dtype == torch.float64 and frames.shape == operator.frames_shape
    expected = operator.forward(np.float32(volume.tolist()))
    assert np.allclose(np.array(frames.tolist()), expected, rtol=FLOAT32, atol=FLOAT32)
    (frames * torch.tensor(weights)).sum().backward()
    back = operator.adjoint(weights.astype(np.float32))
    assert np.allclose(np.array(volume.grad.tolist()), back, rtol=FLOAT32, atol=FLOAT32)


def test_a_linear_operator_can_be_differentiated_twice(rt, scan) -> None:
    operator = ray_operator(scan, device=rt)
    project = as_torch(operator)
    volume = torch.rand(operator.volume_shape, requires_grad=True)
    (gradient,) = torch.autograd.grad(0.5 * (project(volume) ** 2).sum(), volume, create_graph=True)
    direction = torch.rand(operator.volume_shape)
    (curved,) = torch.autograd.grad((gradient * direction).sum(), volume)
    expected = operator.adjoint(operator.forward(np.float32(direction.tolist())))
    assert np.allclose(np.array(curved.tolist()), expected, rtol=1e-4, atol=1e-4 * expected.max())


def test_gaussians_are_fitted_by_a_torch_optimiser(rt, scan, cloud) -> None:
    project = as_torch(Projector(scan, device=rt))
    wanted = project(torch.tensor(cloud.rows(), dtype=torch.float32))
    moved = cloud.rows()
    moved[:3] += 0.05
    moved[10] *= 0.8
    rows = torch.tensor(moved, dtype=torch.float32, requires_grad=True)
    optimiser = torch.optim.Adam([rows], lr=0.01)
    losses = []
    for _ in range(60):
        optimiser.zero_grad()
        loss = ((project(rows) - wanted) ** 2).mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss))
    assert losses[-1] < 0.05 * losses[0]


def test_what_does_not_fit_is_named_and_what_needs_no_gradient_has_none(rt, scan) -> None:
    project = as_torch(ray_operator(scan, device=rt))
    assert not project(torch.zeros(scan.grid.shape)).requires_grad
    with pytest.raises(InputError, match="volume.*shape"):
        project(torch.zeros(3))
