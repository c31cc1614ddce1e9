"""Line integrals of known fields in the network's place, against closed forms along the scan's own rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from parallel_kit import SIDE, laminography_scan, parallel_scan
from tolerances import FLOAT32, RAY_SAMPLES, RAY_SAMPLES_SHARP

from phyradgs_cl.acquisition import MicroViews, OwnTimes, Static
from phyradgs_cl.acquisition.geometry import pixel_centres
from phyradgs_cl.fields import Grid
from phyradgs_cl.neural import NeuralOptions
from phyradgs_cl.neural.trainer import ExposureRays, box_span, line_integrals, sample_shifts
from phyradgs_cl.operators import RayOperator

VOXELS = 64  # of the longest side; 96 samples per ray by default
CENTRE, AXES = np.array([0.1, -0.2, 0.05]), np.array([0.45, 0.3, 0.5])


@pytest.fixture(scope="module")
def rays(scan) -> tuple[np.ndarray, np.ndarray]:
    """Sources and directions (R, 3) of pixels of a frame at five times of their lines, in half-sides."""
    table = OwnTimes().cells(scan, 3)
    exposure = ExposureRays.of_cells(table, scan.grid)
    rows, columns = scan.geometry.detector_shape
    pixels = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1).reshape(-1, 2)
    source, direction = exposure(pixels, np.tile(np.arange(exposure.times), (len(pixels), 1)))
    return source.reshape(-1, 3), direction.reshape(-1, 3)


def integrals(field, rays, jitter: str, seed: int = 0, times: int = 1) -> np.ndarray:
    """Integrals (R,) with as many samples as a pixel of so many times has by default."""
    samples = NeuralOptions().samples_for(VOXELS, times)
    shifts = sample_shifts(len(rays[0]), samples, jitter, np.random.default_rng(seed))
    source, direction = (torch.tensor(a.astype(np.float32)) for a in rays)
    box = torch.ones(3)
    return np.array(line_integrals(field, source, direction, box, samples, torch.tensor(shifts)).tolist())


def thinned(rays) -> tuple[np.ndarray, np.ndarray]:
    """A few of the rays that pass near the centre."""
    a, b, c = quadratic(rays)
    near = np.flatnonzero(c - b * b / a < 1)[::8]
    return rays[0][near], rays[1][near]


def many_draws(field, rays, jitter: str) -> np.ndarray:
    """Integrals (4096, R) with shifts drawn anew each time."""
    copies = tuple(np.tile(part, (64, 1)) for part in rays)
    return np.concatenate([integrals(field, copies, jitter, seed).reshape(64, -1) for seed in range(64)])


def quadratic(rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """a, b, c (R,) of |(s + t d − centre) / axes|² = a t² + 2 b t + c."""
    from_, along = (rays[0] - CENTRE) / AXES, rays[1] / AXES
    return (along**2).sum(1), (from_ * along).sum(1), (from_**2).sum(1)


def distance(x: torch.Tensor) -> torch.Tensor:
    """The square of a position's distance from the centre, in axes."""
    centre, axes = (torch.tensor(three.astype(np.float32)) for three in (CENTRE, AXES))
    return (((x - centre) / axes) ** 2).sum(1)


def through_gaussian(rays, shrink: float = 9.0) -> np.ndarray:
    """Integrals (R,) of a Gaussian whose σ is a third of the axes."""
    a, b, c = quadratic(rays)
    return np.sqrt(2 * np.pi / (shrink * a)) * np.exp(-shrink * (c - b * b / a) / 2)


def gaussian(x: torch.Tensor) -> torch.Tensor:
    return torch.exp(-9 * distance(x) / 2)


def through_fading(rays) -> np.ndarray:
    """Of the density 1 − q inside q < 1: the chord's ends are kinks, not steps."""
    a, b, c = quadratic(rays)
    return 4 / 3 * a * (np.sqrt(np.maximum(b * b / a - c + 1, 0) / a)) ** 3


def fading(x: torch.Tensor) -> torch.Tensor:
    return (1 - distance(x)).clamp(min=0)


def test_smooth_fields_and_their_means_over_an_exposure(rays) -> None:
    """With fewer samples per ray where a pixel has five rays."""
    for field, expected, jitter in [
        (gaussian, through_gaussian(rays), "ray"), (gaussian, through_gaussian(rays), "none"),
        (fading, through_fading(rays), "ray"),
    ]:  # fmt: skip
        assert expected.max() > 0.2
        assert np.abs(integrals(field, rays, jitter) - expected).max() <= RAY_SAMPLES * expected.max()
        mean, found = (expected.reshape(-1, 5).mean(1), integrals(field, rays, "ray", times=5).reshape(-1, 5).mean(1))
        assert np.abs(found - mean).max() <= RAY_SAMPLES * mean.max()


@pytest.mark.parametrize("jitter", ["ray", "sample"])
def test_an_ellipsoid_with_a_sharp_edge(rays, jitter) -> None:
    """A step costs a share of a sample in one draw; the average over draws has no such error."""
    few = thinned(rays)
    a, b, c = quadratic(few)
    expected = 2 * np.sqrt(np.maximum(b * b / a - c + 1, 0) / a)
    draws = many_draws(lambda x: (distance(x) < 1).float(), few, jitter)
    size = np.linalg.norm(expected)
    assert np.linalg.norm(draws[0] - expected) <= RAY_SAMPLES_SHARP * size
    assert np.linalg.norm(draws.mean(0) - expected) <= RAY_SAMPLES * size


def test_rays_are_those_of_the_cells(scan) -> None:
    """Every pixel's ray goes from the source of its line's cell to its own centre; columns too, and grids off centre."""
    table = MicroViews(3, 2).cells(scan, 1)
    grid = Grid(scan.grid.shape, scan.grid.voxel_size_mm, (0.1, -0.2, 0.3))
    for axis in ("rows", "columns"):
        exposure = ExposureRays.of_cells(replace(table, axis=axis), grid)
        pixels = np.array([[0, 5], [7, 23], [23, 0], [12, 12]])
        rays = exposure(pixels, np.tile([[0, 1]], (4, 1)))
        for (row, column), source, direction in zip(pixels, *rays, strict=True):
            line = row if axis == "rows" else column
            serving = table.pose[(table.line_start <= line) & (line < table.line_stop)]
            expected = (serving[:, :3] - np.array(grid.offset_mm[::-1])) / grid.half_longest_mm
            cells = [int(np.linalg.norm(expected - one, axis=1).argmin()) for one in source]
            assert sorted(cells) == [0, 1] and np.allclose(source, expected[cells], atol=1e-6)
            centres = [pixel_centres(pose, scan.geometry.detector_shape)[row, column] for pose in serving[cells]]
            wanted = np.array(centres) - serving[cells, :3]
            assert np.allclose(direction, wanted / np.linalg.norm(wanted, axis=1, keepdims=True), atol=1e-12)


def test_the_way_through_the_box_and_the_shadow_of_the_volume_which_holds_every_ray_that_meets_it(scan) -> None:
    source = torch.tensor([[5.0, 0, 0], [5, 0, 0], [5, 3, 0], [0, 0, 0], [5, 0, 0]])
    direction = torch.tensor([[-1.0, 0, 0], [-0.8, 0.6, 0], [-1, 0, 0], [0, 0, 1], [1, 0, 0]])
    first, length = box_span(source, direction, torch.tensor([1.0, 1.0, 0.5]))
    assert np.allclose(first[[0, 3]].tolist(), [4, 0])
    assert np.allclose(length.tolist(), [2, 0, 0, 0.5, 0], atol=FLOAT32)
    exposure, shape = ExposureRays.of_cells(OwnTimes().cells(scan, 2), scan.grid), scan.geometry.detector_shape
    assert_shadowed(exposure, np.array([0.6, 0.5, 0.3]), shape)
    assert exposure.shadow([10.0, 10.0, 10.0], shape) == (slice(0, shape[0]), slice(0, shape[1]))


def assert_shadowed(exposure: ExposureRays, half: np.ndarray, shape: tuple[int, int]) -> None:
    """The shadow of a box is less than half of the panel, and holds every pixel with a ray that meets the box."""
    pixels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)
    rays = exposure(pixels, np.tile(np.arange(exposure.times), (len(pixels), 1)))
    spans = box_span(*(torch.tensor(a.reshape(-1, 3)) for a in rays), torch.tensor(half))
    meets = np.array(spans[1].tolist()).reshape(len(pixels), -1).any(axis=1).reshape(shape)
    inside = np.zeros(shape, bool)
    inside[exposure.shadow(half, shape)] = True
    assert meets.any() and not np.any(meets & ~inside) and inside.sum() < 0.5 * inside.size


@pytest.mark.parametrize("make", [parallel_scan, laminography_scan])
def test_parallel_rays_are_those_of_the_projector(rt, make) -> None:
    """Chords of the box, and integrals of a smooth volume, against the ray projector's."""
    full = make(6)
    scan = replace(full, grid=Grid((64, 64, 64), (0.05, 0.05, 0.05), (0.1, -0.2, 0.05)))
    table = Static().cells(scan, 2)
    exposure = ExposureRays.of_cells(table, scan.grid)
    pixels = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"), -1).reshape(-1, 2)
    source, direction = (a.reshape(-1, 3) for a in exposure(pixels, np.zeros((len(pixels), 1), int)))
    np.testing.assert_allclose(direction, np.broadcast_to(table.pose[0, :3], direction.shape), atol=1e-12)
    half = scan.grid.half_longest_mm
    x, y, z = np.meshgrid(*(axis / half for axis in scan.grid.axes_mm()[::-1]), indexing="ij")
    centred = np.stack([x, y, z], -1).reshape(-1, 3) - np.array(scan.grid.offset_mm[::-1]) / half
    volume = gaussian(torch.tensor(centred)).numpy().reshape(64, 64, 64).transpose(2, 1, 0).astype(np.float32)
    projected = RayOperator(rt, scan.grid, (SIDE, SIDE), [table]).forward(volume)[0].ravel()
    found = half * integrals(gaussian, (source, direction), "none")
    assert np.abs(found - projected).max() <= 0.02 * projected.max()  # the projector interpolates voxels
    assert np.abs(half * through_gaussian((source, direction)) - found).max() <= RAY_SAMPLES * found.max()
    assert_shadowed(exposure, np.array([0.45, 0.4, 0.25]), (SIDE, SIDE))
