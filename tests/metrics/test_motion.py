"""Errors of a known motion: in mm, at edges, and the same whatever state the reference shows."""

from dataclasses import replace

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, control_points
from phyradgs_cl.metrics import edge_points_mm, motion_error_mm

GRID = Grid.cube(12, 6.0)
ORIGIN_MM, COUNTS = control_points(GRID, 1.5, 6.0)
TIMES_S = np.array([0.0, 1.0, 2.0])
POINTS_MM = np.random.default_rng(2).uniform(-2, 2, (50, 3))


def stretch(share: float, weights: list[float]) -> Deformation:
    """w = weight · share · x along x, exactly, since splines reproduce straight lines."""
    control_mm = np.zeros((1, *COUNTS, 3))
    control_mm[..., 0] = share * (ORIGIN_MM[0] + 1.5 * np.arange(COUNTS[2]))
    return Deformation(control_mm, ORIGIN_MM, 1.5, TIMES_S, np.array(weights)[:, None])


def test_errors_are_how_far_apart_two_descriptions_put_matter() -> None:
    truth, estimate = stretch(0.1, [0.0, 1.0, 0.5]), stretch(0.1, [0.0, 1.0, 0.0])
    assert motion_error_mm(truth, truth, POINTS_MM, TIMES_S) == pytest.approx((0, 0), abs=FLOAT64)
    mean_mm, high_mm = motion_error_mm(estimate, truth, POINTS_MM, TIMES_S)
    off_mm = np.abs(POINTS_MM[:, 0]) * (1 - 1 / 1.05)  # at the last time alone
    assert mean_mm == pytest.approx(off_mm.mean() / 2, rel=1e-5) and high_mm <= off_mm.max()


def test_the_state_that_the_reference_shows_does_not_matter() -> None:
    """The same motion, of a reference that is stretched by 1.1: y + w' = 1.1 (y + w)."""
    truth, other = stretch(0.1, [0.0, 1.0, 0.5]), stretch(0.1, [1.0, 2.1, 1.55])
    assert motion_error_mm(other, truth, POINTS_MM, TIMES_S) == pytest.approx((0, 0), abs=1e-5)
    still = replace(truth, weights=np.zeros((3, 1)))
    assert motion_error_mm(still, truth, POINTS_MM, TIMES_S)[0] > 0.05
    with pytest.raises(InputError, match="states"):
        motion_error_mm(truth, truth, POINTS_MM, TIMES_S[:1])


def test_points_stand_at_edges() -> None:
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    points_mm = edge_points_mm((x**2 + y**2 + z**2 < 4).astype(np.float32), GRID)
    assert len(points_mm) > 50 and np.abs(np.linalg.norm(points_mm, axis=1) - 2).max() < 1
    assert len(edge_points_mm(np.random.default_rng(0).random((40, 40, 40)), Grid.cube(40, 1.0))) <= 2000
