"""The splat kernels against their float64 twin: one Gaussian at a time on 512², clouds, odd cases; the twin itself."""

import numpy as np
import pytest
from kernel_kit import assert_between, assert_near
from kernel_kit import splat as render
from scipy.spatial.transform import Rotation
from tolerances import (
    CUTOFF_EDGE_NEEDLE,
    CUTOFF_EDGE_SIGMA,
    SPLAT_AFFINE,
    SPLAT_CLOUD,
    SPLAT_COMPACT,
    SPLAT_NEEDLE,
    TWIN_QUADRATURE,
)

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA, DeviceCells, SplatProjector
from phyradgs_cl.operators.splats.layout import projection_matrices
from phyradgs_cl.operators.twins.splat import splat_image
from phyradgs_cl.runtime.layout import unpad_rows

SIDE = 512
CROP = 32
LARGE = ConeGeometry(5.0, 7.5, (SIDE, SIDE), (3.9 / SIDE, 4.1 / SIDE))
SAMPLES, REACH_SIGMA = 4001, 12.0  # of the integrals along rays that know no closed form
PIXEL_AT_AXIS = LARGE.pixel_size_mm[0] / LARGE.magnification


def random_gaussian(rng: np.random.Generator, smallest_px: tuple[float, float], aspect: float) -> np.ndarray:
    """One Gaussian (11, 1) whose smallest axis covers so many pixels and whose longest is ``aspect`` times that."""
    smallest = np.exp(rng.uniform(*np.log(smallest_px))) * PIXEL_AT_AXIS
    ratio = np.array([1.0, aspect ** rng.uniform(), aspect])
    quaternion = rng.normal(size=4)
    scale = rng.permutation(smallest * ratio)
    row = [rng.uniform(-0.6, 0.6, 3), scale, quaternion / np.linalg.norm(quaternion), rng.uniform(0.5, 2, 1)]
    return np.concatenate(row).astype(np.float32).astype(np.float64)[:, None]


def centre_on_detector(rows: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Row and column, as fractions, where the Gaussian's centre is seen."""
    x, y, z = projection_matrices(pose[None]).reshape(3, 4) @ np.append(rows[:3, 0], 1.0)
    return float(y / z), float(x / z)


def part_of(pose: np.ndarray, first: tuple[float, float], step: int) -> np.ndarray:
    """The pose of a detector that has every ``step``-th pixel from ``first`` (row, column) on."""
    part = pose.copy()
    part[3:6] += first[0] * pose[9:12] + first[1] * pose[6:9]
    part[6:12] *= step
    return part


def error_of_peak(image: np.ndarray, rows: np.ndarray, pose: np.ndarray) -> float:
    """Largest deviation from the twin in a crop about the centre and on a coarse net over all, over the peak: that of the
    ray through the centre, as no pixel may lie on a Gaussian much smaller than a pixel."""
    centre = centre_on_detector(rows, pose)
    peak = splat_image(rows, part_of(pose, centre, 1), (1, 1))[0, 0]
    v, u = (int(np.clip(at - CROP / 2, 0, SIDE - CROP)) for at in centre)
    near = splat_image(rows, part_of(pose, (v, u), 1), (CROP, CROP))
    far = splat_image(rows, part_of(pose, (0, 0), 16), (SIDE // 16, SIDE // 16))
    errors = np.abs(image[v : v + CROP, u : u + CROP] - near).max(), np.abs(image[::16, ::16] - far).max()
    return float(max(errors) / peak)


@pytest.mark.parametrize(("smallest_px", "aspects", "tolerance"), [
    ((0.5, 15.0), (1.0, 3.0, 10.0), SPLAT_COMPACT), ((0.1, 1.0), (30.0, 100.0, 300.0, 1000.0), SPLAT_NEEDLE),
    ((0.02, 0.3), (1.0, 10.0, 1000.0), SPLAT_NEEDLE),
], ids=["compact", "needles", "below a pixel"])  # fmt: skip
def test_single_gaussians_on_512_pixels(two_rt, one_cell, smallest_px, aspects, tolerance) -> None:
    rng = np.random.default_rng(11)
    projector = SplatProjector(two_rt, SIDE, SIDE, cutoff_sigma=0.0)
    for aspect in aspects:
        for _ in range(6):
            pose = LARGE.pose(rng.uniform(0, 2 * np.pi))
            rows = random_gaussian(rng, smallest_px, aspect)
            image = projector.project(rows, DeviceCells.upload(two_rt, one_cell(pose, SIDE)))
            assert error_of_peak(image, rows, pose) <= tolerance, rows[:, 0]


def test_positions_keep_their_digits_far_from_pixel_0(any_rt, one_cell) -> None:
    """Column 4000 in plain float32 would be off by 2e-4 pixels, 2e-4 of the peak of a splat as sharp as these."""
    shape = (16, 4096)
    geometry = ConeGeometry(5.0, 7.5, shape, (3.9 / 4096, 3.9 / 4096))
    projector = SplatProjector(any_rt, *shape, cutoff_sigma=0.0)
    rng = np.random.default_rng(12)
    for y in (-1.2, -0.7, 0.9, 1.2):
        pose = geometry.pose(rng.uniform(0, 2 * np.pi))
        across = pose[6:9] / np.linalg.norm(pose[6:9])
        scale = 0.6 * geometry.pixel_size_mm[0] / geometry.magnification
        rows = np.array([[*y * across, scale, scale, scale, 1, 0, 0, 0, 1]], np.float32).T.astype(np.float64)
        image = projector.project(rows, DeviceCells.upload(any_rt, one_cell(pose, 16)))
        u = int(centre_on_detector(rows, pose)[1]) - 8
        expected = splat_image(rows, part_of(pose, (0, u), 1), (16, 16))
        assert expected.max() > 0.5 * np.sqrt(2 * np.pi) * rows[3, 0]
        assert_near(image[:, u : u + 16], expected, SPLAT_COMPACT)


@pytest.mark.parametrize("affine", [False, True])
def test_clouds_on_odd_detectors(any_rt, one_cell, make_cloud, make_geometry, affine) -> None:
    """Seven Gaussians, one, whole and cut, and none."""
    for shape in [(61, 77), (17, 5), (1, 1), (1, 33), (40, 1)]:
        rows, pose = make_cloud(7, 1), make_geometry(*shape, offset=(0.1, -0.2)).pose(0.4)
        image = render(any_rt, rows, one_cell(pose, shape[0]), shape, affine=affine, cutoff_sigma=0.0)
        assert_near(image, splat_image(rows, pose, shape, affine=affine), SPLAT_AFFINE if affine else SPLAT_CLOUD)
    one, pose = make_cloud(1, 4, spread=0.1, scale=(0.1, 0.2)), make_geometry(23, 19).pose(2.0)
    for cutoff_sigma in (0.0, DEFAULT_CUTOFF_SIGMA):
        image = render(any_rt, one, one_cell(pose, 23), (23, 19), affine=affine, cutoff_sigma=cutoff_sigma)
        assert_near(image, splat_image(one, pose, (23, 19), cutoff_sigma, affine), SPLAT_CLOUD)
    assert not render(any_rt, np.zeros((11, 0)), one_cell(pose, 23), (23, 19), affine=affine).any()


def cut_images(rows: np.ndarray, pose: np.ndarray, shape: tuple[int, int], edge: float, affine: bool = False):
    """The twin's image with the cutoff a little nearer and a little farther."""
    return [splat_image(rows, pose, shape, DEFAULT_CUTOFF_SIGMA + e, affine) for e in (-edge, edge)]


@pytest.mark.parametrize("affine", [False, True])
def test_cutoff_means_the_same_as_in_the_twin(two_rt, one_cell, make_cloud, make_geometry, affine) -> None:
    rows, pose, shape = make_cloud(9, 2, scale=(0.02, 0.3)), make_geometry(61, 77).pose(1.1), (61, 77)
    image = render(two_rt, rows, one_cell(pose, 61), shape, affine=affine)
    low, high = cut_images(rows, pose, shape, CUTOFF_EDGE_SIGMA, affine)
    assert_between(image, low, high, SPLAT_CLOUD * high.max())
    assert (high > 0).mean() < 1  # the cutoff leaves pixels without any splat


def test_an_ellipsoid_across_the_source_plane_stays_finite(two_rt, one_cell, make_cloud, make_geometry) -> None:
    """At 3.7 σ those nearer than 1.85 contain a point at the source's own depth: they are not drawn."""
    rows, pose = make_cloud(1, 7, scale=(0.5, 0.5)), make_geometry(20, 20).pose(0.0)
    for x in (4.8, 5.0, 5.2, 4.0, 3.0):
        rows[:3, 0] = x, 0.05, -0.03
        expected = splat_image(rows, pose, (20, 20), DEFAULT_CUTOFF_SIGMA)
        assert (expected.max() > 0) == (x == 3.0)
        image = render(two_rt, rows, one_cell(pose, 20), (20, 20))
        assert_near(image, expected, SPLAT_CLOUD, max(expected.max(), 1.0))
        assert np.all(np.isfinite(render(two_rt, rows, one_cell(pose, 20), (20, 20), cutoff_sigma=0.0))), x


def test_needle_bounding_boxes_hold_their_ellipse(two_rt, one_cell) -> None:
    """A needle at 22.5° across the detector: the box must reach its far ends, every tile in between too."""
    turn = (*np.cos([np.pi / 16, np.pi * 7 / 16]), 0, 0)
    rows = np.array([[0.01, 0.02, -0.01, 0.0005, 0.25, 0.0005, *turn, 1.0]]).T
    pose = LARGE.pose(0.0)
    image = render(two_rt, rows, one_cell(pose, SIDE), (SIDE, SIDE))
    low, high = cut_images(rows, pose, (SIDE, SIDE), CUTOFF_EDGE_NEEDLE)
    columns = np.flatnonzero(high.any(axis=0))
    assert columns.size > 150 and np.ptp(columns) > 300  # long, and thinner than a pixel
    assert_between(image, low, high, SPLAT_NEEDLE * high.max())


def test_padding_stays_zero(two_rt, one_cell, make_cloud, make_geometry) -> None:
    """Other kernels read past the ends of lines and count on zeros there."""
    shape = (11, 21)
    projector = SplatProjector(two_rt, *shape)
    rows, pose = make_cloud(6, 8), make_geometry(*shape).pose(0.3)
    image = projector.project(rows, DeviceCells.upload(two_rt, one_cell(pose, 11)))
    flat = two_rt.download(projector.image)
    assert np.count_nonzero(flat) == np.count_nonzero(image) > 0
    np.testing.assert_array_equal(unpad_rows(flat, shape), image)


def density_at(row: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The field (n,) of one Gaussian (11,) at points (n, 3), from the definition."""
    w, x, y, z = row[6:10] / np.linalg.norm(row[6:10])
    local = Rotation.from_quat([x, y, z, w]).inv().apply(points - row[:3]) / row[3:6]
    return row[10] * np.exp(-0.5 * (local**2).sum(-1))


def integrate(row: np.ndarray, source: np.ndarray, target: np.ndarray) -> float:
    """The field along the line through source and target, by the trapezoidal rule, which is exact to rounding here."""
    direction = (target - source) / np.linalg.norm(target - source)
    reach = REACH_SIGMA * row[3:6].max()
    at, step = np.linspace(-reach, reach, SAMPLES, retstep=True)
    at += direction @ (row[:3] - source)
    return float(step * density_at(row, source + at[:, None] * direction).sum())


@pytest.mark.parametrize("seed", range(3))
def test_twin_is_the_line_integral(make_cloud, make_geometry, seed) -> None:
    rows = make_cloud(1, seed, scale=(0.06, 0.3))
    geometry = make_geometry(24, 28, offset=(0.2, -0.3))
    pose = geometry.pose(0.7 * seed)
    image = splat_image(rows, pose, (24, 28))
    pixels = pixel_centres(pose, (24, 28))
    chosen = [(v, u) for v in range(1, 24, 4) for u in range(2, 28, 4)]
    chosen.append(tuple(np.unravel_index(image.argmax(), image.shape)))
    expected = [integrate(rows[:, 0], pose[:3], pixels[at]) for at in chosen]
    found = [image[at] for at in chosen]
    np.testing.assert_allclose(found, expected, rtol=0, atol=TWIN_QUADRATURE * image.max())
