"""The voxeliser and its adjoint against direct evaluation of the field in float64."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import (
    CUTOFF_EDGE_NEEDLE,
    CUTOFF_EDGE_SIGMA,
    FINITE_DIFFERENCE_STEP,
    GRADIENT,
    VOXEL,
    VOXEL_NEEDLE,
)

from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.gaussians import DENSITY, MEAN, QUATERNION, SCALE
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA, DeviceGaussians, Voxeliser, voxelise
from phyradgs_cl.operators.twins.splat import voxel_field
from phyradgs_cl.runtime.layout import pad_rows, unpad_rows

# not a cube, no cubes as voxels, not centred, odd counts, one voxel thin, one voxel
GRIDS = [
    Grid((9, 14, 21), (0.2, 0.11, 0.09), (0.1, -0.2, 0.05)),
    Grid((17, 5, 33), (0.1, 0.35, 0.06)),
    Grid((1, 12, 16), (0.3, 0.15, 0.12), (0.2, 0.0, 0.0)),
    Grid((8, 16, 1), (0.2, 0.12, 0.3)),
    Grid((1, 1, 1), (0.4, 0.5, 0.6), (0.1, 0.2, 0.3)),
]
IDS = ["x".join(map(str, grid.shape)) for grid in GRIDS]
CLASSES = {"mean": MEAN, "scale": SCALE, "quaternion": QUATERNION, "density": DENSITY}


@pytest.mark.parametrize("grid", GRIDS, ids=IDS)
def test_field_is_the_sum_of_gaussians(any_rt, make_cloud, grid) -> None:
    rows = make_cloud(9, 41)
    volume = Voxeliser(any_rt, grid.shape, cutoff_sigma=0.0).voxelise(rows, grid)
    expected = voxel_field(rows, *grid.axes_mm())
    np.testing.assert_allclose(volume, expected, rtol=0, atol=VOXEL * rows[DENSITY].max())


@pytest.mark.parametrize("grid", GRIDS[:2], ids=IDS[:2])
def test_cutoff_means_the_same_as_in_the_twin(any_rt, make_cloud, grid) -> None:
    rows = make_cloud(9, 42, scale=(0.03, 0.2))
    volume = voxelise(any_rt, rows, grid)
    low, high = (
        voxel_field(rows, *grid.axes_mm(), DEFAULT_CUTOFF_SIGMA + edge)
        for edge in (-CUTOFF_EDGE_SIGMA, CUTOFF_EDGE_SIGMA)
    )
    slack = VOXEL * rows[DENSITY].max()
    assert np.all(volume >= low - slack) and np.all(volume <= high + slack)
    assert (high > 0).mean() < 1
    np.testing.assert_array_equal(volume[high == 0], 0)


@pytest.mark.parametrize("brick_bytes", [1, 4 * 14 * 48 * 2, 4 * 14 * 48 * 5])
def test_bricks_change_nothing(any_rt, make_cloud, brick_bytes) -> None:
    """Slabs of one voxel, and of some that divide the height badly."""
    rows, grid = make_cloud(30, 43), GRIDS[0]
    whole = voxelise(any_rt, rows, grid)
    bricks = voxelise(any_rt, rows, grid, brick_bytes=brick_bytes)
    np.testing.assert_array_equal(bricks, whole)
    assert whole.max() > 0.5


def test_a_part_of_a_grid_has_the_bits_of_the_whole(any_rt, make_cloud) -> None:
    rows, grid = make_cloud(30, 47), GRIDS[0]
    start, shape = (2, 3, 5), (4, 6, 7)
    part = Voxeliser(any_rt, shape).forward(DeviceGaussians.upload(any_rt, rows), grid, start)
    values = unpad_rows(any_rt.download(part), shape)
    inside = tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))
    np.testing.assert_array_equal(values, voxelise(any_rt, rows, grid)[inside])


def test_no_gaussian_gives_an_empty_volume(any_rt) -> None:
    np.testing.assert_array_equal(voxelise(any_rt, np.zeros((11, 0)), GRIDS[0]), 0)


def test_needles_keep_their_digits_and_their_boxes(any_rt) -> None:
    """Aspect 1000, on and off the grid's axes; nothing of a needle is cut off by its bounding box."""
    rng = np.random.default_rng(44)
    grid = Grid((40, 40, 40), (0.05, 0.05, 0.05))
    for turn in [np.array([1.0, 0, 0, 0]), *rng.normal(size=(5, 4))]:
        middle = [axis[20] for axis in grid.axes_mm()[::-1]]  # a voxel's centre: the peak is seen
        rows = np.array([[*middle, 0.4, 0.0004, 0.004, *(turn / np.linalg.norm(turn)), 1.5]]).T
        rows = rows.astype(np.float32).astype(np.float64)
        volume = voxelise(any_rt, rows, grid)
        low, high = (
            voxel_field(rows, *grid.axes_mm(), DEFAULT_CUTOFF_SIGMA + e)
            for e in (-CUTOFF_EDGE_NEEDLE, CUTOFF_EDGE_NEEDLE)
        )
        assert high.max() > 0.9
        assert np.all(volume >= low - VOXEL_NEEDLE * 1.5) and np.all(volume <= high + VOXEL_NEEDLE * 1.5)


@pytest.mark.parametrize("grid", GRIDS[:4], ids=IDS[:4])
def test_gradients(any_rt, make_cloud, finite_differences, grid) -> None:
    rows = make_cloud(3, 45, scale=(0.1, 0.3))
    h = np.random.default_rng(6).normal(size=grid.shape).astype(np.float32).astype(np.float64)
    found = Voxeliser(any_rt, grid.shape, cutoff_sigma=0.0).voxelise_adjoint(rows, grid, h)
    axes = grid.axes_mm()
    expected = np.stack(
        [
            finite_differences(
                lambda r: float((h * voxel_field(r[:, None], *axes)).sum()), row, FINITE_DIFFERENCE_STEP
            )
            for row in rows.T
        ],
        -1,
    )
    for name, part in CLASSES.items():
        error = np.linalg.norm(found[part] - expected[part]) / np.linalg.norm(expected[part])
        assert error <= GRADIENT, name


def test_rounding_does_not_turn_a_round_gaussian(any_rt, make_cloud) -> None:
    rows, grid = make_cloud(5, 48, scale=(0.1, 0.3)), GRIDS[0]
    rows[SCALE] = rows[SCALE][:1] * (1 + 3e-6 * np.array([[1.0], [0.0], [-1.0]]))
    h = np.random.default_rng(9).normal(size=grid.shape).astype(np.float32)
    voxeliser = Voxeliser(any_rt, grid.shape)
    found = voxeliser.voxelise_adjoint(rows, grid, h)
    assert not found[QUATERNION].any() and found[SCALE].any()
    rows[SCALE] *= 1 + 1e-4 * np.array([[1.0], [0.0], [0.0]])
    assert voxeliser.voxelise_adjoint(rows, grid, h)[QUATERNION].any()


def test_backward_adds_with_a_weight(rt, make_cloud) -> None:
    """The objective lays the total variation's gradient onto the image's."""
    rows, grid = make_cloud(3, 46), GRIDS[0]
    h = np.random.default_rng(7).normal(size=grid.shape).astype(np.float32)
    voxeliser, gaussians = Voxeliser(rt, grid.shape), DeviceGaussians.upload(rt, rows)
    voxeliser.forward(gaussians, grid)
    before = np.random.default_rng(8).normal(size=(13, gaussians.stride)).astype(np.float32)
    gradients = rt.upload(before)
    voxeliser.backward(gaussians, grid, rt.upload(pad_rows(h)), gradients, add=True, weight=0.25)
    found = rt.download(gradients)
    alone = voxeliser.voxelise_adjoint(rows, grid, h)
    np.testing.assert_allclose(
        found[:11, :3], before[:11, :3] + 0.25 * alone, rtol=0, atol=VOXEL * np.abs(alone).max()
    )
    np.testing.assert_array_equal(found[11:], before[11:])  # the statistic belongs to the image alone
