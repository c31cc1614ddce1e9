"""Grids and the choice of another."""

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.fields import Grid, GridChoice

SHIFTED = Grid((2, 3, 4), (1.0, 2.0, 3.0), (10.0, 20.0, 30.0))


def test_centres_are_symmetric_about_the_offset() -> None:
    z, y, x = SHIFTED.axes_mm()
    np.testing.assert_allclose(z, [9.5, 10.5])
    np.testing.assert_allclose(y, [18, 20, 22])
    np.testing.assert_allclose(x, [25.5, 28.5, 31.5, 34.5])
    assert SHIFTED.first_centre_mm == (9.5, 18.0, 25.5)
    assert SHIFTED.size_mm == (2.0, 6.0, 12.0) and SHIFTED.half_longest_mm == 6.0
    assert Grid.cube(4, 8.0) == Grid((4, 4, 4), (2.0, 2.0, 2.0))
    scaled = SHIFTED.scaled(0.5)
    assert scaled.shape == SHIFTED.shape
    for fine, coarse in zip(scaled.axes_mm(), SHIFTED.axes_mm(), strict=True):
        np.testing.assert_allclose(fine, coarse / 2)


GRID = Grid((10, 20, 40), (1.0, 1.0, 2.0), (1.0, 2.0, 3.0))  # z −4 to 6, y −8 to 12, x −37 to 43
BOX = (-2.0, 2.0, -4.0, 4.0, 0.0, 4.0)


@pytest.mark.parametrize(
    ("choice", "shape", "voxel_mm", "offset_mm"),
    [
        ({}, (10, 20, 40), (1, 1, 2), (1, 2, 3)),
        ({"size": [20]}, (5, 10, 20), (2, 2, 4), (1, 2, 3)),  # along the longest side, in proportion
        ({"size": (5, 20, 80.0)}, (5, 20, 80), (2, 1, 1), (1, 2, 3)),
        ({"size": 1}, (1, 1, 1), (10, 20, 80), (1, 2, 3)),
        ({"voxel_mm": 3}, (4, 7, 27), (3, 3, 3), (1, 2, 3)),  # whole voxels, about the same centre
        ({"size": (3, 4, 5), "voxel_mm": [0.1, 0.7, 100]}, (3, 4, 5), (0.1, 0.7, 100), (1, 2, 3)),
        ({"size": 20, "voxel_mm": 1}, (5, 10, 20), (1, 1, 1), (1, 2, 3)),
        ({"roi_mm": (-2, 2, -3.5, 4, 0, 4)}, (4, 8, 3), (1, 1, 2), (0, 0, 2)),  # the grid's own voxels: x −1 to 5
        ({"roi_mm": (-6, 2, -4, 4, 0.5, 0.6)}, (8, 8, 1), (1, 1, 2), (-2, 0, 0)),  # and beyond it
        ({"roi_mm": (-2.009, 2.009, -3.5, 4, -1.01, 4.9)}, (4, 8, 3), (1, 1, 2), (0, 0, 2)),  # rounded decimals
        ({"roi_mm": 8}, (8, 8, 4), (1, 1, 2), (1, 2, 3)),  # a cube about the grid's middle
        ({"roi_mm": (4, 8, 5)}, (4, 8, 4), (1, 1, 2), (1, 2, 3)),
        ({"roi_mm": BOX, "voxel_mm": 1.5}, (3, 6, 3), (1.5, 1.5, 1.5), (0, 0, 2)),
        ({"roi_mm": BOX, "size": (8, 8, 8)}, (8, 8, 8), (0.5, 1, 0.5), (0, 0, 2)),
    ],
)
def test_what_is_chosen(choice, shape, voxel_mm, offset_mm) -> None:
    found = GridChoice(**choice).of(GRID)
    assert found.shape == shape
    assert found.voxel_size_mm == pytest.approx(voxel_mm) and found.offset_mm == pytest.approx(offset_mm)
    again = GridChoice(**choice).of(found)
    assert again.shape == shape and again.offset_mm == pytest.approx(found.offset_mm, abs=1e-12)


def test_a_part_of_a_grid_knows_its_place_and_a_margin_is_whole_voxels_around_the_box() -> None:
    part = GRID.part((1, 2, 3), (4, 5, 6))
    assert part.slices_in(GRID) == (slice(1, 5), slice(2, 7), slice(3, 9))
    assert GRID.slices_in(GRID) == tuple(slice(0, n) for n in GRID.shape)
    for other in (GRID, GRID.scaled(1.1), Grid(part.shape, part.voxel_size_mm, (1.2, 2.0, 3.0))):
        assert other.slices_in(part) is None
    for margin_mm, shape in ((0, GRID.shape), (2, (14, 24, 42)), ((0, 0.1, 4.1), (10, 22, 46))):
        wide = GridChoice(margin_mm=margin_mm).with_margin(GRID)
        assert wide.shape == shape and wide.offset_mm == pytest.approx(GRID.offset_mm), margin_mm
        assert GRID.slices_in(wide) is not None
    assert GridChoice(size=5).with_margin(GRID) is GRID
    assert_refused({
        "--margin-mm: found a grid of": lambda: GridChoice(margin_mm=1e8).with_margin(GRID),
        "shape: found shape": lambda: GRID.in_shape(4), "parts: found 0": lambda: GRID.finer(0),  # type: ignore[arg-type]
    })  # fmt: skip
