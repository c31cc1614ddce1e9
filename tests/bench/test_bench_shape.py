"""Roundness and edge sharpness against beads whose blur, place and ellipticity are known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erfc
from tables.metrics import Bead, edge_sharpness, roundness
from tables.metrics.beads import resolved
from tables.metrics.edge import RISE_PER_SIGMA, bead_edge, blurred_ball
from tables.metrics.roundness import bead_sections

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

GRID = Grid.cube(64, 32.0)  # half a millimetre per voxel
CENTRE = (0.3, -0.2, 0.4)
NOISE = 0.1


def drawn(
    axes_mm: tuple[float, float, float], sigma_mm: float = 0.0, centre: tuple[float, ...] = CENTRE
) -> np.ndarray:
    """An ellipsoid of density 1 on a background of 0.2, blurred."""
    phantom = EllipsoidPhantom((Ellipsoid(centre, axes_mm, 1.0),), "bead")  # type: ignore[arg-type]
    volume = phantom.voxelise(GRID, 4) + 0.2
    return gaussian_filter(volume, sigma_mm / 0.5) if sigma_mm else volume


def noisy(volume: np.ndarray) -> np.ndarray:
    return volume + NOISE * np.random.default_rng(0).standard_normal(volume.shape)


def expected_rise_mm(sigma_mm: float) -> float:
    return RISE_PER_SIGMA * float(np.hypot(sigma_mm, 0.5 / np.sqrt(12)))


@pytest.mark.parametrize("radius_mm", [3.0, 6.0])
@pytest.mark.parametrize("sigma_mm", [0.0, 0.5, 1.5])
def test_the_rise_of_a_known_blur_is_found(radius_mm: float, sigma_mm: float) -> None:
    volume, bead = drawn((radius_mm,) * 3, sigma_mm), Bead(CENTRE, radius_mm)
    edge = bead_edge(volume, GRID, bead)
    # 5 %: a voxel's box is not a Gaussian; noise of a tenth of the contrast adds 2 to 7 %
    assert edge.rise_mm == pytest.approx(expected_rise_mm(sigma_mm), rel=0.05)
    assert edge.radius_mm == pytest.approx(radius_mm, abs=0.02)
    assert (edge.inside, edge.outside) == pytest.approx((1.2, 0.2), abs=0.02)
    assert bead_edge(noisy(volume), GRID, bead).rise_mm == pytest.approx(expected_rise_mm(sigma_mm), rel=0.1)


def test_profiles_are_those_of_limits_with_closed_forms() -> None:
    distance = np.linspace(97.0, 103.0, 13)
    straight = 0.5 * erfc((distance - 100) / np.sqrt(2))  # a large ball is a straight edge
    np.testing.assert_allclose(blurred_ball(distance, 100.0, 1.0), straight, atol=5e-3)
    # at the centre the mass within the bead; chi distribution: the share of a 3D Gaussian within R = 2 σ
    assert blurred_ball(np.zeros(1), 2.0, 1.0)[0] == pytest.approx(0.7385358700508889, rel=1e-6)


def test_round_beads_are_round_wherever_they_are() -> None:
    volume = drawn((6.0,) * 3, 0.7)
    found = roundness(volume, GRID, [Bead(CENTRE, 6.0)])
    assert found["roundness"] < 0.01 and found["roundness_rms"] < 0.003
    assert found["centre_shift_mm"] < 0.02 and found["round_sections"] == 3
    with_noise = roundness(noisy(volume), GRID, [Bead(CENTRE, 6.0)])
    assert with_noise["roundness_rms"] < 0.03 and with_noise["round_sections"] == 3
    # seen from a centre that is 0.6 mm off along x: sagittal sections do not see that shift
    moved = roundness(volume, GRID, [Bead((CENTRE[0] + 0.6, *CENTRE[1:]), 6.0)])
    assert moved["centre_shift_mm"] == pytest.approx(0.6 * 2 / 3, abs=0.03) and moved["roundness"] < 0.02


def test_an_ellipsoid_is_out_of_round_by_its_axes() -> None:
    sections = bead_sections(drawn((6.6, 6.0, 6.0)), GRID, Bead(CENTRE, 6.0))
    for name in ("axial", "coronal"):
        assert sections[name].span == pytest.approx(0.6 / 6.3, abs=0.02)
        # radii of an ellipse run between the axes as a cosine: RMS is the amplitude over √2
        assert sections[name].rms == pytest.approx(0.3 / 6.3 / np.sqrt(2), abs=0.006)
    assert sections["sagittal"].span < 0.025
    assert sections["sagittal"].radius_mm == pytest.approx(6.0, abs=0.03)


def test_unresolved_and_missing_beads_give_no_number() -> None:
    small, outside = Bead(CENTRE, 1.0), Bead((12.0, 0.0, 0.0), 6.0)
    assert resolved([small, outside, Bead(CENTRE, 3.0)], GRID) == [Bead(CENTRE, 3.0)]
    empty = np.zeros(GRID.shape)
    assert np.isnan(roundness(empty, GRID, [Bead(CENTRE, 6.0)])["roundness"])
    assert np.isnan(edge_sharpness(empty, GRID, [Bead(CENTRE, 6.0)])["edge_rise_mm"])
    assert edge_sharpness(drawn((6.0,) * 3), GRID, [small])["edge_balls"] == 0
    with pytest.raises(InputError, match="bead radius"):
        Bead(CENTRE, 0.0)
    with pytest.raises(InputError, match="volume: found shape"):
        roundness(np.zeros((3, 3, 3)), GRID, [])
    with pytest.raises(InputError, match="NaN"):
        edge_sharpness(np.full(GRID.shape, np.nan), GRID, [])
