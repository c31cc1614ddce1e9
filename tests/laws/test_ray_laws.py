"""The ray-driven projector is linear and its adjoint is one, whatever the scanner, the shutter and the grid."""

import numpy as np
from hypothesis import given
from laws_kit import grids, many, seeds, tables
from tolerances import ADJOINT, FLOAT32

from phyradgs_cl.operators import RayOperator


def noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0.0, 1.0, shape).astype(np.float32)


@many
@given(scanner=tables(), grid=grids(), seed=seeds)
def test_adjoint(rt, scanner, grid, seed) -> None:
    """⟨Ax, y⟩ = ⟨x, Aᵀy⟩ relative to both, for volumes and frames that are nowhere negative."""
    shape, cells = scanner
    operator, rng = RayOperator(rt, grid, shape, cells), np.random.default_rng(seed)
    x, y = noise(operator.volume_shape, rng), noise(operator.frames_shape, rng)
    forward, backward = operator.forward(x), operator.adjoint(y)
    assert np.isfinite(forward).all() and np.isfinite(backward).all()
    one, other = np.vdot(forward.astype(np.float64), y), np.vdot(backward.astype(np.float64), x)
    assert abs(one - other) <= ADJOINT * max(abs(one), abs(other))


@many
@given(scanner=tables(), grid=grids(), seed=seeds)
def test_linearity(rt, scanner, grid, seed) -> None:
    shape, cells = scanner
    operator, rng = RayOperator(rt, grid, shape, cells), np.random.default_rng(seed)
    x, y = noise(operator.volume_shape, rng), noise(operator.volume_shape, rng)
    a, b = rng.uniform(0.1, 3, 2).astype(np.float32)
    found, expected = operator.forward(a * x + b * y), a * operator.forward(x) + b * operator.forward(y)
    assert np.abs(found - expected).max() <= 10 * FLOAT32 * max(expected.max(), 1e-6)
    u, v = noise(operator.frames_shape, rng), noise(operator.frames_shape, rng)
    found, expected = operator.adjoint(a * u + b * v), a * operator.adjoint(u) + b * operator.adjoint(v)
    assert np.abs(found - expected).max() <= 10 * FLOAT32 * max(expected.max(), 1e-6)
