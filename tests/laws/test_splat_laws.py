"""Splats: frames are linear in the densities, gradients their adjoint and the derivative, whatever the scanner."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from laws_kit import cloud, many, seeds, tables
from tolerances import ADJOINT, GRADIENT, SPLAT_CLOUD

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.fields.gaussians import DENSITY
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.operators.twins.splat import splat_frame
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows

STEP = 1e-5


def lines_first(shape: tuple[int, int], cells: TimeCells) -> tuple[int, int]:
    return shape if cells.axis == "rows" else shape[::-1]


def draw(rt: Runtime, rows: np.ndarray, shape: tuple[int, int], cells: TimeCells) -> np.ndarray:
    """The frame (lines, width), all of every Gaussian."""
    projector = SplatProjector(rt, *lines_first(shape, cells), cutoff_sigma=0.0)
    return projector.project(rows, DeviceCells.upload(rt, cells)).astype(np.float64)


def pull(
    rt: Runtime, rows: np.ndarray, shape: tuple[int, int], cells: TimeCells, h: np.ndarray
) -> np.ndarray:
    """Rows (11, G) of dL/d… for L = Σ h · frame, h (rows, columns)."""
    projector = SplatProjector(rt, *lines_first(shape, cells), cutoff_sigma=0.0)
    h = np.ascontiguousarray(h if cells.axis == "rows" else h.T)
    on_device, gaussians = DeviceCells.upload(rt, cells), DeviceGaussians.upload(rt, rows)
    projector.forward(gaussians, on_device)
    gradients = rt.zeros((13, gaussians.stride))
    projector.backward(gaussians, on_device, rt.upload(pad_rows(h)), gradients)
    return rt.download(gradients)[:11, : gaussians.count].astype(np.float64)


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
    one = float(np.vdot(draw(rt, rows, shape, cells), h if cells.axis == "rows" else h.T))
    other = float(np.vdot(rows[DENSITY], pull(rt, rows, shape, cells, h)[DENSITY]))
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
    gradient = pull(rt, rows, shape, cells, h)
    size = np.linalg.norm(gradient * direction)  # of what is added up, which may nearly cancel
    found, expected = float(np.vdot(gradient, direction)), (ends[0] - ends[1]) / (2 * STEP)
    assert abs(found - expected) <= 2 * GRADIENT * max(size, 1e-3)
