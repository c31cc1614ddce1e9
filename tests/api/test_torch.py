"""Operators in PyTorch; collected only where PyTorch is installed (conftest.py)."""

import numpy as np
import pytest
import torch
from tolerances import FLOAT32

from phyradgs_cl.api import LinearOperator, as_torch, ray_operator, splat_operator, voxel_operator
from phyradgs_cl.errors import InputError


def numbers(tensor: torch.Tensor) -> np.ndarray:
    return np.from_dlpack(tensor.detach())


def test_a_linear_operator_can_be_differentiated_twice(rt, scan) -> None:
    operator = ray_operator(scan, device=rt)
    project, volume = as_torch(operator), torch.rand(operator.domain_shape, requires_grad=True)
    (gradient,) = torch.autograd.grad(0.5 * (project(volume) ** 2).sum(), volume, create_graph=True)
    direction = torch.rand(operator.domain_shape)
    (curved,) = torch.autograd.grad((gradient * direction).sum(), volume)
    expected = operator.T(operator(direction))
    assert np.allclose(numbers(curved), expected, rtol=1e-4, atol=1e-4 * expected.max())


@pytest.mark.parametrize("which", ["splats", "splat intensity", "rays", "ray intensity", "voxels"])
def test_each_call_has_its_own_gradient(rt, scan, cloud, which) -> None:
    splats, rays = splat_operator(scan, device=rt), ray_operator(scan, device=rt)
    kinds = {"splats": splats, "splat intensity": splats.intensity, "rays": rays, "ray intensity": rays.intensity}
    operator = kinds[which] if which in kinds else voxel_operator(scan.grid, device=rt)
    like, dtype = scan.reference if "ray" in which else cloud.rows(), torch.float64 if which == "rays" else torch.float32
    x, function = torch.tensor(np.float32(like).tolist(), dtype=dtype, requires_grad=True), as_torch(operator)
    options = [{}] if which == "voxels" else [{"frames": [3]}, {"frames": [1, 4]}]
    values = [function(x, **chosen) for chosen in options]  # all before any goes back
    sum((value**2).sum() / 2 for value in values).backward()
    expected = np.zeros(x.shape, np.float32)
    for chosen, value in zip(options, values, strict=True):
        part = operator.frames(chosen["frames"]) if chosen else operator
        y, back = part.vjp(numbers(x))
        expected += back(y)
        assert value.dtype == dtype and np.allclose(numbers(value), y, rtol=FLOAT32, atol=FLOAT32 * y.max())
    assert np.allclose(numbers(x.grad), expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_tensors_on_the_host_are_not_copied(rt, scan, monkeypatch) -> None:
    operator, seen = ray_operator(scan, device=rt), []
    whole = LinearOperator.__call__

    def noted(self: LinearOperator, x: np.ndarray) -> np.ndarray:
        seen.extend([x, whole(self, x)])
        return seen[1]

    monkeypatch.setattr(LinearOperator, "__call__", noted)
    volume = torch.rand(operator.domain_shape)
    frames = as_torch(operator)(volume)
    assert np.shares_memory(seen[0], numbers(volume)) and np.shares_memory(seen[1], numbers(frames))


def test_what_does_not_fit_is_named_and_what_needs_no_gradient_has_none(rt, scan, cloud) -> None:
    rays, still = ray_operator(scan, device=rt), torch.zeros(scan.grid.shape)
    project = as_torch(rays)
    assert not project(still).requires_grad
    for words, call in {
        "x: found Gaussians.*expected a tensor; of a cloud": lambda: as_torch(splat_operator(scan, device=rt))(cloud),
        "volume.*shape": lambda: project(torch.zeros(3)), "frames": lambda: project(still, frames=[99]),
        "detach": lambda: rays(torch.zeros(scan.grid.shape, requires_grad=True)),
    }.items():
        with pytest.raises(InputError, match=words):
            call()
