"""The voxeliser and its adjoint against direct evaluation of the field in float64."""

import numpy as np
import pytest
from guarded import guard
from kernel_kit import assert_between, assert_classes, assert_near, by_gaussian, random_weights
from tolerances import CUTOFF_EDGE_NEEDLE, CUTOFF_EDGE_SIGMA, GRADIENT, SERIAL_SUM, VOXEL, VOXEL_NEEDLE

from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.gaussians import DENSITY
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA, DeviceGaussians, Voxeliser, voxelise
from phyradgs_cl.operators.twins.splat import voxel_field
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows, unpad_rows

# not a cube, no cubes as voxels, not centred, odd counts, one voxel thin, one voxel
GRIDS = [
    Grid((9, 14, 21), (0.2, 0.11, 0.09), (0.1, -0.2, 0.05)), Grid((17, 5, 33), (0.1, 0.35, 0.06)),
    Grid((1, 12, 16), (0.3, 0.15, 0.12), (0.2, 0.0, 0.0)), Grid((8, 16, 1), (0.2, 0.12, 0.3)),
    Grid((1, 1, 1), (0.4, 0.5, 0.6), (0.1, 0.2, 0.3)),
]
IDS = ["x".join(map(str, grid.shape)) for grid in GRIDS]


def cut_fields(rows: np.ndarray, grid: Grid, edge: float) -> list[np.ndarray]:
    """The twin's field with the cutoff a little nearer and a little farther."""
    return [voxel_field(rows, *grid.axes_mm(), DEFAULT_CUTOFF_SIGMA + e) for e in (-edge, edge)]


@pytest.mark.parametrize("grid", GRIDS[:2], ids=IDS[:2])
def test_cutoff_means_the_same_as_in_the_twin(two_rt, make_cloud, grid) -> None:
    rows = make_cloud(9, 42, scale=(0.03, 0.2))
    low, high = cut_fields(rows, grid, CUTOFF_EDGE_SIGMA)
    assert_between(voxelise(two_rt, rows, grid), low, high, VOXEL * rows[DENSITY].max())
    assert (high > 0).mean() < 1


def test_nothing_is_written_beside_a_whole_number_of_vectors(monkeypatch, make_cloud) -> None:
    """16 Gaussians, which leave no room behind the last one; in a GPU's launch shape PoCL had written there."""
    guard(monkeypatch.setattr)
    grid = Grid.cube(8, 2.0)
    for shape in ({}, {"lanes": 1, "pixel_items": True}):
        voxeliser = Voxeliser(Runtime(**shape), grid.shape)
        voxeliser.voxelise_adjoint(make_cloud(16, 49, scale=(0.1, 0.3)), grid, np.ones(grid.shape, np.float32))


def test_bricks_parts_of_a_grid_and_no_gaussian(two_rt, make_cloud) -> None:
    """Slabs of one voxel, some that divide the height badly, and a part in the middle."""
    rows, grid = make_cloud(30, 43), GRIDS[0]
    whole = voxelise(two_rt, rows, grid)
    assert whole.max() > 0.5
    for brick_bytes in (1, 4 * 14 * 48 * 2, 4 * 14 * 48 * 5):
        np.testing.assert_array_equal(voxelise(two_rt, rows, grid, brick_bytes=brick_bytes), whole)
    start, shape = (2, 3, 5), (4, 6, 7)
    part = Voxeliser(two_rt, shape).forward(DeviceGaussians.upload(two_rt, rows), grid, start)
    inside = tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))
    np.testing.assert_array_equal(unpad_rows(two_rt.download(part), shape), whole[inside])
    np.testing.assert_array_equal(voxelise(two_rt, np.zeros((11, 0)), GRIDS[0]), 0)


def test_needles_keep_their_digits_and_their_boxes(any_rt) -> None:
    """Aspect 1000, on and off the grid's axes; nothing of a needle is cut off by its bounding box."""
    rng = np.random.default_rng(44)
    grid = Grid((40, 40, 40), (0.05, 0.05, 0.05))
    for turn in [np.array([1.0, 0, 0, 0]), *rng.normal(size=(5, 4))]:
        middle = [axis[20] for axis in grid.axes_mm()[::-1]]  # a voxel's centre: the peak is seen
        rows = np.array([[*middle, 0.4, 0.0004, 0.004, *(turn / np.linalg.norm(turn)), 1.5]]).T
        rows = rows.astype(np.float32).astype(np.float64)
        low, high = cut_fields(rows, grid, CUTOFF_EDGE_NEEDLE)
        assert high.max() > 0.9
        assert_between(voxelise(any_rt, rows, grid), low, high, VOXEL_NEEDLE * 1.5)


@pytest.mark.parametrize("grid", GRIDS, ids=IDS)
def test_the_field_is_the_sum_of_gaussians_and_its_gradients_are_differences(
    two_rt, make_cloud, finite_differences, grid
) -> None:
    many, rows, axes = make_cloud(9, 41), make_cloud(3, 45, scale=(0.1, 0.3)), grid.axes_mm()
    voxeliser, h = Voxeliser(two_rt, grid.shape, cutoff_sigma=0.0), random_weights(grid.shape)
    assert_near(voxeliser.voxelise(many, grid), voxel_field(many, *axes), VOXEL, many[DENSITY].max())
    found = voxeliser.voxelise_adjoint(rows, grid, h)
    expected = by_gaussian(finite_differences, lambda r: (h * voxel_field(r, *axes)).sum(), rows)
    assert_classes(found, expected, GRADIENT)


@pytest.mark.parametrize("cutoff_sigma", [0.0, DEFAULT_CUTOFF_SIGMA])
def test_a_group_sums_what_one_item_sums(banded_rt, make_cloud, cutoff_sigma) -> None:
    """Rows are walked within the cutoff there and from side to side of a box here: thin and tilted Gaussians."""
    rows, grid = make_cloud(40, 49, scale=(0.01, 0.5)), Grid((21, 25, 30), (0.07, 0.06, 0.05))
    h = np.random.default_rng(10).normal(size=grid.shape).astype(np.float32)
    one, group = (
        Voxeliser(rt, grid.shape, cutoff_sigma=cutoff_sigma).voxelise_adjoint(rows, grid, h)
        for rt in (banded_rt, Runtime(lanes=1, pixel_items=True))
    )
    assert_classes(group, one, SERIAL_SUM)


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
    assert_near(found[:11, :3], before[:11, :3] + 0.25 * alone, VOXEL, np.abs(alone).max())
    np.testing.assert_array_equal(found[11:], before[11:])  # the statistic belongs to the image alone
