"""Voxel grids: centres, sizes, scaling, refusals."""

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

GRID = Grid((2, 3, 4), (1.0, 2.0, 3.0), (10.0, 20.0, 30.0))


def test_centres_are_symmetric_about_the_offset() -> None:
    z, y, x = GRID.axes_mm()
    np.testing.assert_allclose(z, [9.5, 10.5])
    np.testing.assert_allclose(y, [18, 20, 22])
    np.testing.assert_allclose(x, [25.5, 28.5, 31.5, 34.5])
    assert GRID.first_centre_mm == (9.5, 18.0, 25.5)
    assert GRID.size_mm == (2.0, 6.0, 12.0)
    assert GRID.half_longest_mm == 6.0
    cube = Grid.cube(4, 8.0)
    assert cube == Grid((4, 4, 4), (2.0, 2.0, 2.0))
    scaled = GRID.scaled(0.5)
    assert scaled.shape == GRID.shape
    for fine, coarse in zip(scaled.axes_mm(), GRID.axes_mm(), strict=True):
        np.testing.assert_allclose(fine, coarse / 2)


def test_impossible_grids_are_refused() -> None:
    for subject, *arguments in [
        ("shape", (0, 3, 4), (1, 1, 1)), ("shape", (3, 4), (1, 1, 1)), ("voxel_size", (2, 3, 4), (1, 0, 1)),
        ("voxel_size", (2, 3, 4), (1, np.nan, 1)), ("offset", (2, 3, 4), (1, 1, 1), (0, np.inf, 0)),
    ]:  # fmt: skip
        with pytest.raises(InputError, match=subject):
            Grid(*arguments)
