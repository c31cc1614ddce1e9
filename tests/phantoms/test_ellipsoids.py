"""Closed-form integrals against sums of samples, known volumes and chords."""

from functools import partial

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import ellipsoids as module
from phyradgs_cl.phantoms.ellipsoids import Cylinder, Ellipsoid, EllipsoidPhantom, rotation_about_z


def _random_rotation(rng: np.random.Generator) -> tuple:
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return tuple(map(tuple, q.tolist()))


def _random_phantom(seed: int) -> EllipsoidPhantom:
    rng = np.random.default_rng(seed)
    draws = lambda: (rng.uniform(-20, 20, 3), rng.uniform(5, 25, 3), rng.uniform(-0.02, 0.05))  # noqa: E731
    return EllipsoidPhantom(tuple(Ellipsoid(*draws(), _random_rotation(rng)) for _ in range(5)), "random")


def _marched(phantom: EllipsoidPhantom, source: np.ndarray, target: np.ndarray, n: int = 40000) -> float:
    """Midpoint sum along one segment, the surface tested by the quadratic form of the inverse covariance."""
    t = (np.arange(n) + 0.5) / n
    points, total = source + t[:, None] * (target - source), np.zeros(n)
    for e in phantom.ellipsoids:
        r = np.array(e.rotation)
        form, d = r @ np.diag(1 / np.array(e.semi_axes_mm) ** 2) @ r.T, points - np.array(e.centre_mm)
        total += e.attenuation_per_mm * (np.sum((d @ form) * d, axis=1) < 1)
    return float(total.mean() * np.linalg.norm(target - source))


def test_line_integrals_equal_brute_force_sampling_also_from_inside_and_backwards(monkeypatch) -> None:
    """And chunks of rays do not show."""
    phantom, rng = _random_phantom(1), np.random.default_rng(2)
    source = rng.uniform(-60, 60, (30, 3))  # some sources and targets lie inside ellipsoids
    target = rng.uniform(-60, 60, (30, 3))
    expected = [_marched(phantom, s, t) for s, t in zip(source, target, strict=True)]
    # 40,000 samples of a step function along 200 mm: each surface is off by at most half a sample.
    assert np.allclose(whole := phantom.line_integrals(source, target), expected, atol=5e-4, rtol=0)
    assert whole.dtype == np.float64 and np.allclose(whole, phantom.line_integrals(target, source), atol=1e-13)
    monkeypatch.setattr(module, "RAYS_PER_CHUNK", 3)
    assert np.array_equal(phantom.line_integrals(source[:, None], target)[range(30), range(30)], whole)


def test_wires_are_sampled_alike_from_any_side_and_cut_off_flat() -> None:
    rng, wire = np.random.default_rng(3), EllipsoidPhantom((Cylinder(((-3, 1, -8), (5, -2, 9)), 2.5, 0.3),), "wire")
    source, target = rng.uniform(-12, 12, (2, 40, 3))
    share = (np.arange(20000) + 0.5) / 20000
    for s, t in zip(source, target, strict=True):
        points = s + share[:, None] * (t - s)
        expected = wire.density(*points.T).mean() * np.linalg.norm(t - s)
        assert abs(wire.line_integrals(s, t) - expected) < 2e-3, (s, t)
    upright = EllipsoidPhantom((Cylinder(((0, 0, -2), (0, 0, 3)), 1.0, 1.0),), "upright")
    along, across = upright.line_integrals([0.5, 0, -9], [0.5, 0, 9]), upright.line_integrals([-9, 0, 2.9], [9, 0, 2.9])
    assert np.allclose([along, across], [5, 2]) and upright.line_integrals([1.5, 0, -9], [1.5, 0, 9]) == 0
    grid = Grid.cube(40, 8.0)
    assert upright.voxelise(grid, 4).sum() * 0.2**3 == pytest.approx(5 * np.pi, rel=0.01)
    assert np.allclose(wire.ellipsoids[0].centre_mm, (1, -0.5, 0.5))


def test_sphere_chords_in_closed_form_and_segments_that_stop() -> None:
    ball = EllipsoidPhantom((Ellipsoid((0, 0, 0), (2, 2, 2), 0.5),), "ball")
    height = np.array([0.0, 1.0, 1.9, 1.999999, 2.1])
    source = np.stack([np.full(5, 1e4), np.zeros(5), height], axis=-1)
    target, expected = source * [-1, 1, 1], 0.5 * 2 * np.sqrt(np.maximum(4 - height**2, 0))
    assert np.allclose(ball.line_integrals(source, target), expected, atol=1e-9)
    target = np.array([[1, 0, 0], [9, 0, 0], [-1, 0, 0], [0, 0, 0]])
    assert np.allclose(ball.line_integrals([0, 0, 0], target), [0.5, 1, 0.5, 0])
    assert ball.line_integrals([5, 0, 0], [9, 0, 0]) == 0  # the ball lies behind the source
    assert ball.line_integrals([5, 0, 0], [3, 0, 0]) == 0  # and here beyond the target


def test_voxels_hold_the_volume_and_sit_where_the_density_is() -> None:
    phantom = EllipsoidPhantom((Ellipsoid((2, -3, 4), (9, 5, 7), 0.1, rotation_about_z(0.6)),), "one")
    grid = Grid((30, 26, 28), (1.0, 1.1, 0.9), (4.0, -3.0, 2.0))
    volume = phantom.voxelise(grid, 3)
    assert volume.shape == grid.shape and volume.dtype == np.float32
    assert volume.sum() * 0.99 == pytest.approx(0.1 * 4 / 3 * np.pi * 9 * 5 * 7, rel=3e-3)
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    clear = (volume == 0) | np.isclose(volume, 0.1)
    assert np.allclose(phantom.density(x, y, z)[clear], volume[clear], atol=1e-7)
    centre = [float((volume * c).sum() / volume.sum()) for c in (x, y, z)]
    assert np.allclose(centre, (2, -3, 4), atol=0.02)
    phantom, grid = _random_phantom(6), Grid((11, 13, 9), (5.0, 4.0, 6.0), (1.0, 2.0, 3.0))
    z, y, x = grid.axes_mm()
    expected = phantom.density(x, y[:, None], z[:, None, None])
    assert np.allclose(phantom.voxelise(grid, 1), expected, atol=1e-8)


def test_impossible_ellipsoids_and_rays_are_refused() -> None:
    origin, phantom = (0, 0, 0), _random_phantom(0)
    assert_refused({
        "semi-axis": lambda: Ellipsoid(origin, (1, 0, 1), 1.0),
        "rotation": lambda: Ellipsoid(origin, (1, 1, 1), 1.0, ((1, 0, 0), (0, 2, 0), (0, 0, 1))),
        "semi_axes_mm: found shape": lambda: Ellipsoid(origin, (1, 1), 1.0),  # type: ignore[arg-type]
        "supersampling": lambda: phantom.voxelise(Grid.cube(4, 1.0), 0),
    })  # fmt: skip
    for source, target in [([0, 0], [1, 1]), (np.zeros((4, 3)), np.zeros((5, 3))), (0.0, 1.0)]:
        assert_refused({"ray source and target": partial(phantom.line_integrals, source, target)})
