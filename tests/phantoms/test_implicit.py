"""Signed distances and textures of the procedural phantoms."""

import numpy as np
import pytest

from phyradgs_cl.phantoms.implicit import Capsule, Lattice, capsule_distance, ratio_distance, texture


def test_covered_voxels_hold_the_volumes_of_a_capsule_and_an_ellipsoid() -> None:
    """Edges count as if straight and axis-aligned: a rounded body gains somewhat less than a per cent."""
    lattice = Lattice(48)
    x, y, z = lattice.points((slice(0, 48),) * 3)
    capsule = capsule_distance(Capsule((-0.3, 0, 0.1), (0.4, 0, 0.1), 0.25, 0.25), x, y, z)
    ellipsoid = ratio_distance((x - 0.1, y, z + 0.2), (0.6, 0.3, 0.4))
    value = ((x - 0.1) / 0.6) ** 2 + (y / 0.3) ** 2 + ((z + 0.2) / 0.4) ** 2
    assert ((ellipsoid < 0) == (value < 1)).mean() > 0.9999
    exact = np.pi * 0.25**2 * 0.7 + 4 / 3 * np.pi * 0.25**3, 4 / 3 * np.pi * 0.6 * 0.3 * 0.4
    volumes = [lattice.coverage(distance).sum() * lattice.step**3 for distance in (capsule, ellipsoid)]
    assert volumes == pytest.approx(exact, rel=1e-2)


def test_texture_has_unit_variance_and_coarse_is_the_mean_of_fine() -> None:
    fine = texture(Lattice(64), (0.2, 0.5), 64, np.random.default_rng(1)).astype(np.float64)
    coarse = texture(Lattice(32), (0.2, 0.5), 64, np.random.default_rng(1))
    assert np.std(fine) == pytest.approx(1.0, abs=0.1)
    assert np.allclose(fine.reshape(32, 2, 32, 2, 32, 2).mean(axis=(1, 3, 5)), coarse, atol=1e-4)
