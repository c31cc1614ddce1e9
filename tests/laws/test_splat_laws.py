"""Splats: frames are linear in the densities, gradients their adjoint and the derivative, whatever the scanner."""

import numpy as np
from hypothesis import given
from kernel_kit import splat_gradients
from laws_kit import many, seeds, tables
from tolerances import GRADIENT

from phyradgs_cl.operators.twins.splat import splat_frame

STEP = 1e-5


@many
@given(scanner=tables(), seed=seeds)
def test_the_gradient_is_the_derivative(rt, make_cloud, scanner, seed) -> None:
    """Along a random direction of all parameters, against central differences of the float64 twin."""
    shape, (cells, _) = scanner
    rng, rows = np.random.default_rng(seed), make_cloud(2, seed, spread=0.7, scale=(0.15, 0.5))
    h = rng.normal(size=shape).astype(np.float32)
    direction = rng.normal(size=rows.shape) * np.where(np.arange(11)[:, None] < 6, 0.1, 1.0)
    ends = [float((h * splat_frame(rows + s * STEP * direction, cells, shape)).sum()) for s in (1, -1)]
    gradient = splat_gradients(rt, rows, cells, h, cutoff_sigma=0.0).astype(np.float64)
    size = np.linalg.norm(gradient * direction)  # of what is added up, which may nearly cancel
    found, expected = float(np.vdot(gradient, direction)), (ends[0] - ends[1]) / (2 * STEP)
    assert abs(found - expected) <= 2 * GRADIENT * max(size, 1e-3)
