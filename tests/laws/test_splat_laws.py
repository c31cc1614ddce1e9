"""Splats: frames are linear in the densities, gradients their adjoint and the derivative, whatever the scanner."""

import numpy as np
from hypothesis import given
from kernel_kit import splat, splat_gradients
from laws_kit import cloud, many, seeds, tables
from tolerances import ADJOINT, GRADIENT, SPLAT_CLOUD

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields.gaussians import DENSITY
from phyradgs_cl.operators.twins.splat import splat_frame
from phyradgs_cl.runtime import Runtime

STEP = 1e-5


def draw(rt: Runtime, rows: np.ndarray, shape: tuple[int, int], cells: TimeCells) -> np.ndarray:
    """The frame (rows, columns), all of every Gaussian."""
    return splat(rt, rows, cells, shape, cutoff_sigma=0.0).astype(np.float64)


@many
@given(scanner=tables(), seed=seeds)
def test_frames_are_linear_in_densities(rt, scanner, seed) -> None:
    """Two clouds are drawn as one is that has both; and twice the density is twice the frame."""
    shape, (cells, _) = scanner
    first, second = cloud(seed), cloud(seed + 1)
    heavier = second.copy()
    heavier[DENSITY] *= 2
    expected = draw(rt, first, shape, cells) + 2 * draw(rt, second, shape, cells)
    found = draw(rt, np.concatenate([first, heavier], axis=1), shape, cells)
    assert np.isfinite(found).all()
    assert np.abs(found - expected).max() <= 2 * SPLAT_CLOUD * max(expected.max(), 1e-6)


@many
@given(scanner=tables(), seed=seeds)
def test_the_gradient_of_densities_is_the_adjoint(rt, scanner, seed) -> None:
    """⟨S ρ, h⟩ = ⟨ρ, Sᵀ h⟩ for images that are nowhere negative."""
    shape, (cells, _) = scanner
    rows = cloud(seed)
    h = np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)
    one = float(np.vdot(draw(rt, rows, shape, cells), h))
    gradient = splat_gradients(rt, rows, cells, h, cutoff_sigma=0.0).astype(np.float64)
    other = float(np.vdot(rows[DENSITY], gradient[DENSITY]))
    assert abs(one - other) <= ADJOINT * max(abs(one), abs(other))


@many
@given(scanner=tables(), seed=seeds)
def test_the_gradient_is_the_derivative(rt, scanner, seed) -> None:
    """Along a random direction of all parameters, against central differences of the float64 twin."""
    shape, (cells, _) = scanner
    rng, rows = np.random.default_rng(seed), cloud(seed, 2, smallest=0.15)
    h = rng.normal(size=shape).astype(np.float32)
    direction = rng.normal(size=rows.shape) * np.where(np.arange(11)[:, None] < 6, 0.1, 1.0)
    ends = [float((h * splat_frame(rows + s * STEP * direction, cells, shape)).sum()) for s in (1, -1)]
    gradient = splat_gradients(rt, rows, cells, h, cutoff_sigma=0.0).astype(np.float64)
    size = np.linalg.norm(gradient * direction)  # of what is added up, which may nearly cancel
    found, expected = float(np.vdot(gradient, direction)), (ends[0] - ends[1]) / (2 * STEP)
    assert abs(found - expected) <= 2 * GRADIENT * max(size, 1e-3)
