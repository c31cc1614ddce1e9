"""Signed distances and textures of the procedural phantoms."""

import numpy as np
import pytest

from phyradgs_cl.phantoms.implicit import (
    Capsule,
    Lattice,
    capsule_distance,
    capsule_union,
    ellipsoid_distance,
    texture,
)


def _all(n: int) -> tuple[slice, slice, slice]:
    return (slice(0, n),) * 3


def test_covered_voxels_hold_the_volume_of_a_capsule() -> None:
    lattice = Lattice(48)
    distance = capsule_distance(Capsule((-0.3, 0, 0.1), (0.4, 0, 0.1), 0.25, 0.25), *lattice.points(_all(48)))
    exact = np.pi * 0.25**2 * 0.7 + 4 / 3 * np.pi * 0.25**3
    # Edges count as if straight and axis-aligned: a rounded body gains somewhat less than a per cent.
    assert lattice.coverage(distance).sum() * lattice.step**3 == pytest.approx(exact, rel=1e-2)


def test_ellipsoid_distance_has_the_surface_and_sign_of_the_ellipsoid() -> None:
    lattice = Lattice(40)
    x, y, z = lattice.points(_all(40))
    distance = ellipsoid_distance((0.1, 0.0, -0.2), (0.6, 0.3, 0.4), x, y, z)
    value = ((x - 0.1) / 0.6) ** 2 + (y / 0.3) ** 2 + ((z + 0.2) / 0.4) ** 2
    assert ((distance < 0) == (value < 1)).mean() > 0.9999
    volume = lattice.coverage(distance).sum() * lattice.step**3
    assert volume == pytest.approx(4 / 3 * np.pi * 0.6 * 0.3 * 0.4, rel=0.01)


def test_a_union_of_distant_bodies_is_the_nearer_one_whatever_the_box() -> None:
    lattice = Lattice(32)
    bodies = [Capsule((-0.5, 0, 0), (-0.5, 0, 0.2), 0.2, 0.1), Capsule((0.5, 0.1, 0), (0.4, 0, 0), 0.2, 0.2)]
    whole = capsule_union(lattice, bodies, 0.02, _all(32))
    nearest = np.minimum(*(capsule_distance(b, *lattice.points(_all(32))) for b in bodies))
    close = np.abs(nearest) < 0.05
    assert np.allclose(whole[close], nearest[close], atol=1e-4)
    part = (slice(10, 25), slice(8, 20), slice(3, 30))
    assert np.array_equal(capsule_union(lattice, bodies, 0.02, part), whole[part])


def test_texture_has_unit_variance_and_coarse_is_the_mean_of_fine() -> None:
    fine = texture(Lattice(64), (0.2, 0.5), 64, np.random.default_rng(1)).astype(np.float64)
    coarse = texture(Lattice(32), (0.2, 0.5), 64, np.random.default_rng(1))
    assert np.std(fine) == pytest.approx(1.0, abs=0.1)
    assert np.allclose(fine.reshape(32, 2, 32, 2, 32, 2).mean(axis=(1, 3, 5)), coarse, atol=1e-4)
