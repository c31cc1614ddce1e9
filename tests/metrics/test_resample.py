"""A volume on another grid, against what trilinear interpolation is exact for."""

import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import resampled

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


def test_means_of_eight_and_nothing_outside() -> None:
    volume = np.random.default_rng(0).random((8, 8, 8)).astype(np.float32)
    values, _ = resampled(volume, Grid.cube(8, 2.0), Grid.cube(4, 2.0))
    np.testing.assert_allclose(values, volume.reshape(4, 2, 4, 2, 4, 2).mean(axis=(1, 3, 5)), rtol=1e-5)
    ones, inner = np.ones((4, 4, 4), np.float32), Grid.cube(4, 2.0)
    values, share = resampled(ones, inner, Grid.cube(8, 4.0))
    assert share == pytest.approx(1 / 8) and values.sum() == 64 and np.all(values[2:6, 2:6, 2:6] == 1)
    values, share = resampled(ones, inner, Grid((4, 4, 4), (0.5,) * 3, (0, 0, 2.0)))
    assert share == 0 and not values.any()
