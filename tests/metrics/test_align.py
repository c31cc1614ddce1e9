"""A volume and its reference on one grid, by blocks or resampled."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import aligned, compare, psnr, reference_on, resampled


def _truth(shape: tuple[int, int, int]) -> np.ndarray:
    return np.random.default_rng(0).random(shape).astype(np.float32)


@pytest.mark.parametrize("factors", [(2, 2, 2), (3, 1, 2)])
def test_a_finer_truth_is_averaged_over_the_volumes_voxels(factors) -> None:
    """The mean of what a voxel holds has no error; a gain in noise shows in full, as no interpolation can."""
    grid = Grid((4, 6, 5), (0.6, 0.4, 0.5), (1.0, -2.0, 0.5))
    counts = tuple(n * f for n, f in zip(grid.shape, factors, strict=True))
    fine = Grid(counts, tuple(d / f for d, f in zip(grid.voxel_size_mm, factors, strict=True)), grid.offset_mm)
    truth = _truth(fine.shape)
    means = truth.reshape(4, factors[0], 6, factors[1], 5, factors[2]).mean((1, 3, 5))
    noise, scores = np.random.default_rng(1).normal(0, 0.05, means.shape).astype(np.float32), []
    for part in (noise, noise / np.float32(np.sqrt(2))):  # 3.01 dB apart
        pair = aligned(means + part, grid, truth, fine)
        assert pair is not None and pair.grid == grid and pair.share == 1
        assert "means of the reference over " + "×".join(map(str, factors[::-1])) in pair.how
        scores.append(compare(pair.volume, pair.reference)["psnr_db"])
    assert scores[1] - scores[0] == pytest.approx(10 * np.log10(2), abs=1e-3)
    np.testing.assert_allclose(reference_on(grid, truth, fine), means, rtol=1e-6)
    part = grid.part((1, 0, 2), (3, 5, 2))
    pair = aligned(np.zeros(part.shape, np.float32), part, truth, fine)
    assert pair is not None and pair.share == 30 / 120 and "25 % of the reference" in pair.how
    np.testing.assert_allclose(pair.reference, means[1:4, :5, 2:4], rtol=1e-6)


def test_the_same_voxels_are_compared_one_by_one() -> None:
    grid = Grid((6, 5, 4), (0.5, 0.4, 0.3), (1.0, 0.0, 2.0))
    truth = _truth(grid.shape)
    rounded = Grid(grid.shape, tuple(float(np.float32(d)) for d in grid.voxel_size_mm), grid.offset_mm)
    pair = aligned(truth, rounded, truth, grid)
    assert pair is not None and pair.how == "voxel by voxel" and pair.reference is truth
    part = grid.part((1, 0, 2), (3, 5, 2))
    pair = aligned(truth[1:4, :, 2:], part, truth, grid)
    assert pair is not None and pair.how == "voxel by voxel, on 25 % of the reference"
    assert psnr(pair.volume, pair.reference) == np.inf


@pytest.mark.parametrize(
    "grid",
    [
        Grid((12, 12, 12), (0.5,) * 3),  # finer than the truth
        Grid((4, 4, 4), (1.5,) * 3),  # one and a half times coarser
        Grid((3, 3, 3), (2.0,) * 3, (0.25, 0.0, 0.0)),  # twice coarser, but the faces do not meet
        Grid((4, 4, 4), (2.0,) * 3),  # twice coarser, but beyond the truth
    ],
)
def test_any_other_volume_is_resampled_onto_the_truth_unless_it_lies_elsewhere(grid) -> None:
    truth_grid = Grid((6, 6, 6), (1.0,) * 3)
    truth, volume = _truth(truth_grid.shape), _truth(grid.shape)
    pair = aligned(volume, grid, truth, truth_grid)
    assert pair is not None and "resampled (linear) from" in pair.how
    np.testing.assert_array_equal(pair.volume, resampled(volume, grid, pair.grid)[0])
    np.testing.assert_array_equal(pair.reference, truth[pair.grid.slices_in(truth_grid)])
    assert reference_on(grid, truth, truth_grid) is None
    assert aligned(volume, replace(grid, offset_mm=(0.0, 9.0, 0.0)), truth, truth_grid) is None


FROM = Grid((9, 8, 7), (0.5, 0.4, 0.3), (1.0, -2.0, 3.0))


def plane_through(grid: Grid) -> np.ndarray:
    """A function of place that is linear along every axis."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    return (2 * z - 3 * y + 5 * x + 0.5 * z * y).astype(np.float32)


@pytest.mark.parametrize(
    "onto", [FROM, Grid((5, 4, 3), (0.7, 0.6, 0.5), (1.1, -2.1, 2.9)), Grid((16, 16, 16), (0.1,) * 3, (1, -2, 3))]
)
def test_what_is_linear_stays_as_it_is(onto) -> None:
    values, share = resampled(plane_through(FROM), FROM, onto)
    assert share == 1 and values.dtype == np.float32
    np.testing.assert_allclose(values, plane_through(onto), rtol=1e-5)


@pytest.mark.parametrize("count", [7, 8, 11])
def test_centres_on_the_faces_of_a_part_are_inside(count) -> None:
    """Rounding put zeros there, which cost 14 dB."""
    onto = Grid.cube(32, 2.2)
    side_mm = onto.voxel_size_mm[0]
    part = Grid((count,) * 3, (side_mm,) * 3, ((1 - count % 2) * side_mm / 2,) * 3)
    pair = aligned(np.ones(part.shape, np.float32), part, np.ones(onto.shape, np.float32), onto)
    assert pair is not None and np.all(pair.volume == 1)


def test_means_of_eight_and_nothing_outside() -> None:
    volume = np.random.default_rng(0).random((8, 8, 8)).astype(np.float32)
    values, _ = resampled(volume, Grid.cube(8, 2.0), Grid.cube(4, 2.0))
    np.testing.assert_allclose(values, volume.reshape(4, 2, 4, 2, 4, 2).mean(axis=(1, 3, 5)), rtol=1e-5)
    ones, inner = np.ones((4, 4, 4), np.float32), Grid.cube(4, 2.0)
    values, share = resampled(ones, inner, Grid.cube(8, 4.0))
    assert share == pytest.approx(1 / 8) and values.sum() == 64 and np.all(values[2:6, 2:6, 2:6] == 1)
    values, share = resampled(ones, inner, Grid((4, 4, 4), (0.5,) * 3, (0, 0, 2.0)))
    assert share == 0 and not values.any()
