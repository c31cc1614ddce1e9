"""The named phantoms: known numbers, symmetries, sameness at every resolution, signed distances and textures."""

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import PHANTOMS, foot, jaw, make_phantom, shepp_logan
from phyradgs_cl.phantoms.implicit import Capsule, Lattice, capsule_distance, ratio_distance


def test_shepp_logan_grey_levels_and_ventricles() -> None:
    for variant, levels in [("toft", [1.0, 0.2, 0.0]), ("kak-slaney", [2.0, 1.02, 1.0])]:
        x, y, z = 80 * np.array([[0, 0, -0.22], [0.9, -0.3, 0], [0, 0, -0.25]])  # skull, brain, the left ventricle's centre
        assert np.allclose(shepp_logan(80.0, variant).density(x, y, z) * 80, levels)
    # of grey level one may be given
    assert shepp_logan(80.0, "toft", 0.02).density(0, 72, 0) == pytest.approx(0.02)
    # At 108 degrees the left ellipsoid's long axis runs from the middle at -y outwards to +y.
    phantom = shepp_logan(1.0)
    dx, dy = 0.38 * np.cos(np.deg2rad(108)), 0.38 * np.sin(np.deg2rad(108))
    assert phantom.density(-0.22 + dx * np.array([-1, 1]), -dy, -0.25) == pytest.approx([0.0, 0.2], abs=1e-12)


@pytest.mark.parametrize("draw", [foot, jaw])
def test_procedural_volumes_fill_the_cylinder_in_part_and_coarse_ones_are_block_means_of_fine_ones(draw) -> None:
    volume, coarse = draw(64, 5), draw(32, 5)
    assert volume.shape == (64, 64, 64) and volume.dtype == np.float32
    assert volume.min() == 0 and 0.7 < volume.max() <= 1
    centres = (np.arange(64) + 0.5) / 32 - 1
    outside = np.hypot(centres[:, None], centres[None]) > 1
    assert not volume[:, outside].any() and not volume[0].any() and not volume[-1].any()
    assert 0.03 < np.mean(volume > 0) < 0.5
    assert np.array_equal(coarse, draw(32, 5)) and not np.array_equal(coarse, draw(32, 4))
    fine = volume.reshape(32, 2, 32, 2, 32, 2).mean(axis=(1, 3, 5))
    error = np.sqrt(np.mean((coarse - fine) ** 2) / np.mean(fine**2))
    # Not exact: edges are averaged as if straight, and shells are thinner than a voxel of either.
    assert error < 0.12 and coarse.sum() == pytest.approx(fine.sum(), rel=0.04)


def test_registry_makes_every_phantom_with_its_kind() -> None:
    grid = Grid.cube(16, 60.0)
    for name in PHANTOMS:
        phantom = make_phantom(name, 30.0, resolution=16, seed=1)
        assert phantom.name == name and phantom.kind in ("analytic", "moving", "voxel")
        volume = phantom.voxelise(grid)
        assert volume.shape == grid.shape and volume.dtype == np.float32 and volume.max() > 0
        assert volume.max() * 30.0 <= 1.001
    assert {n for n in PHANTOMS if make_phantom(n, 1.0, 8).kind == "analytic"} == {"shepp-logan", "spheres"}


def test_unknown_names_and_sizes_are_refused() -> None:
    named = "'hand'; expected one of 'foot', 'jaw', 'shepp-logan', 'spheres', 'moving-sphere'"
    assert_refused({
        named: lambda: make_phantom("hand", 1.0), "half_size_mm": lambda: make_phantom("foot", -1.0),
        "resolution": lambda: make_phantom("foot", 1.0, 0), "variant": lambda: shepp_logan(1.0, "tofu"),
        "make the phantom at this resolution": lambda: make_phantom("jaw", 30.0, 16).voxelise(Grid.cube(17, 60.0)),
    })  # fmt: skip


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
