"""The numbers of the benchmarks' tables, against values that are known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erfc
from tables.metrics import Bead, roundness
from tables.metrics.edge import RISE_PER_SIGMA, bead_edge, blurred_ball
from tables.metrics.roundness import bead_sections

from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

pytestmark = pytest.mark.slow
GRID = Grid.cube(64, 32.0)  # half a millimetre per voxel
CENTRE = (0.3, -0.2, 0.4)


def drawn(axes_mm: tuple[float, float, float], sigma_mm: float = 0.0) -> np.ndarray:
    """An ellipsoid of density 1 on a background of 0.2, blurred."""
    volume = EllipsoidPhantom((Ellipsoid(CENTRE, axes_mm, 1.0),), "bead").voxelise(GRID, 4) + 0.2
    return gaussian_filter(volume, sigma_mm / 0.5) if sigma_mm else volume


def test_the_rise_of_a_known_blur_is_found() -> None:
    for radius_mm, sigma_mm in ((3.0, 0.0), (3.0, 0.5), (6.0, 1.5)):
        edge = bead_edge(drawn((radius_mm,) * 3, sigma_mm), GRID, Bead(CENTRE, radius_mm))
        # 5 %: a voxel's box is not a Gaussian
        assert edge.rise_mm == pytest.approx(RISE_PER_SIGMA * float(np.hypot(sigma_mm, 0.5 / np.sqrt(12))), rel=0.05)
        assert edge.radius_mm == pytest.approx(radius_mm, abs=0.02)
    distance = np.linspace(97.0, 103.0, 13)
    straight = 0.5 * erfc((distance - 100) / np.sqrt(2))  # a large ball is a straight edge
    np.testing.assert_allclose(blurred_ball(distance, 100.0, 1.0), straight, atol=5e-3)


def test_round_beads_are_round_and_an_ellipsoid_is_out_of_round_by_its_axes() -> None:
    score = roundness(drawn((6.0,) * 3, 0.7), GRID, [Bead(CENTRE, 6.0)])
    assert score["roundness"] < 0.01 and score["centre_shift_mm"] < 0.02 and score["round_sections"] == 3
    sections = bead_sections(drawn((6.6, 6.0, 6.0)), GRID, Bead(CENTRE, 6.0))
    for name in ("axial", "coronal"):
        assert sections[name].span == pytest.approx(0.6 / 6.3, abs=0.02)
        # radii of an ellipse run between the axes as a cosine: RMS is the amplitude over √2
        assert sections[name].rms == pytest.approx(0.3 / 6.3 / np.sqrt(2), abs=0.006)
    assert np.isnan(roundness(np.zeros(GRID.shape), GRID, [Bead(CENTRE, 6.0)])["roundness"])
