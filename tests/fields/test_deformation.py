"""Displacement fields of low rank on cubic B-splines: values, slopes, inverse, folding, and what is refused."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, control_points
from tests.tolerances import FLOAT32, FLOAT64

GRID = Grid((7, 9, 11), (1.0, 1.1, 0.9), (3.0, -2.0, 1.0))
SPACING_MM = 3.0


def a_deformation(scale_mm: float = 0.3) -> Deformation:
    origin_mm, counts = control_points(GRID, SPACING_MM)
    control_mm = scale_mm * np.random.default_rng(1).normal(size=(2, *counts, 3))
    return Deformation(control_mm, origin_mm, SPACING_MM, np.array([1.0, 2.0, 4.0]), np.array([[0, 0], [1, 0.5], [0, -1]]))


def centres_mm(grid: Grid) -> np.ndarray:
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    return np.stack([x.ravel(), y.ravel(), z.ravel()], -1)


def test_weights_are_linear_between_times_and_constant_outside() -> None:
    expected = [[0, 0], [0.5, 0.25], [1, 0.5], [0.5, -0.25], [0, -1]]
    np.testing.assert_allclose(a_deformation().weights_at([0.0, 1.5, 2.0, 3.0, 9.0]), expected, atol=FLOAT64)


def test_values_are_those_of_scipys_splines() -> None:
    """A single control vector, its components apart, at points on either side and beyond the spline's end."""
    control_mm = np.zeros((1, 3, 4, 5, 3))
    control_mm[0, 1, 2, 3] = [1.0, 2.0, 3.0]
    field = Deformation(control_mm, (-1.0, -2.0, -3.0), (1.0, 2.0, 4.0), np.zeros(1), np.ones((1, 1)))
    spline = BSpline.basis_element([-2, -1, 0, 1, 2], extrapolate=False)
    points_mm = np.random.default_rng(2).uniform(-4, 8, (300, 3))
    offsets = (points_mm - [2.0, 2.0, 1.0]) / [1.0, 2.0, 4.0]  # from control point x 3, y 2, z 1
    expected = np.nan_to_num(spline(offsets)).prod(axis=1)[:, None] * [1.0, 2.0, 3.0]
    np.testing.assert_allclose(field.displacement_mm(points_mm, [1.0]), expected, atol=FLOAT64)
    assert (expected == 0).any() and (expected > 0.1).any()


def test_dense_displacements_come_back_as_fields_of_low_rank() -> None:
    field, times_s = a_deformation(), [1.0, 1.4, 2.0, 3.0, 3.9]
    dense_mm = np.stack([field.on_grid_mm(GRID, weights) for weights in field.weights_at(times_s)])
    found = Deformation.of_displacements(dense_mm, GRID, times_s, SPACING_MM)
    assert found.rank == 2 and np.abs(found.weights).max(0) == pytest.approx([1, 1])
    again_mm = np.stack([found.on_grid_mm(GRID, weights) for weights in found.weights_at(times_s)])
    np.testing.assert_allclose(again_mm, dense_mm, atol=0.02 * np.abs(dense_mm).max())
    still = Deformation.of_displacements(0 * dense_mm, GRID, times_s, SPACING_MM, rank=7)
    assert still.rank == 5 and still.is_still
    with pytest.raises(InputError, match="displacements_mm"):
        Deformation.of_displacements(dense_mm[:4], GRID, times_s, SPACING_MM)


def test_jacobian_is_the_slope_of_the_displacement_which_a_grid_and_points_agree_on() -> None:
    field, weights, step_mm = a_deformation(), [0.7, -0.4], 1e-5
    points_mm = np.random.default_rng(3).normal(size=(200, 3)) * 8  # some of them beyond the splines
    slopes = field.jacobian(points_mm, weights)
    for axis in range(3):
        shift_mm = step_mm * np.eye(3)[axis]
        ahead, behind = (field.displacement_mm(points_mm + sign * shift_mm, weights) for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, :, axis], (ahead - behind) / (2 * step_mm), atol=1e-8)
    assert np.abs(slopes).max() > 0.01
    on_grid, at_points = field.on_grid_mm(GRID, weights), field.displacement_mm(centres_mm(GRID), weights)
    assert on_grid.shape == (*GRID.shape, 3) and on_grid.dtype == np.float32
    np.testing.assert_allclose(on_grid.reshape(-1, 3), at_points, atol=FLOAT32)


def test_inverse_undoes_the_displacement() -> None:
    field, weights = a_deformation(), [1.0, 0.5]
    moved_mm = field.inverse_on_grid_mm(GRID, weights).reshape(-1, 3)
    points_mm = centres_mm(GRID) + moved_mm
    np.testing.assert_allclose(points_mm + field.displacement_mm(points_mm, weights), centres_mm(GRID), atol=FLOAT32)
    assert np.abs(moved_mm).max() > 0.05
    with pytest.raises(InputError, match="no inverse"):
        a_deformation(20.0).inverse_on_grid_mm(GRID, weights)


def test_smallest_determinant_is_that_of_the_worst_state() -> None:
    field = a_deformation(2.0)
    states = [np.eye(3) + field.jacobian(centres_mm(GRID), weights) for weights in field.weights]
    expected = min(np.linalg.det(state).min() for state in states)
    assert field.smallest_determinant(GRID) == pytest.approx(expected, abs=0.02)  # weights to a 64th
    assert field.smallest_determinant() == pytest.approx(expected, abs=0.5)
    assert a_deformation(0.0).smallest_determinant() == 1
    assert a_deformation(20.0).smallest_determinant() < 0
