"""The first cloud: at occupied voxels, spaced like its neighbours, never empty."""

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.splats.start import initial_cloud

pytestmark = pytest.mark.slow

GRID = Grid((6, 7, 8), (0.1, 0.2, 0.3), (0.5, 0.0, -0.5))
SETTINGS = {"threshold": 0.2, "density_share": 0.15, "scale_bounds": (0.001, 1.0), "scale_factor": 1.0}


@pytest.fixture
def volume() -> np.ndarray:
    return np.random.default_rng(111).uniform(-0.5, 1.0, GRID.shape)


def draw(volume: np.ndarray, count: int, seed: int = 0, **changes: object):
    return initial_cloud(volume, GRID, count, rng=np.random.default_rng(seed), **(SETTINGS | changes))


def test_centres_are_occupied_voxels_and_density_their_share(volume) -> None:
    cloud = draw(volume, 50)
    assert cloud.count == 50 and len({tuple(m) for m in cloud.mean}) == 50
    near = zip(GRID.axes_mm(), cloud.mean.T[::-1], strict=True)
    index = tuple(np.abs(axis[:, None] - c).argmin(axis=0) for axis, c in near)
    expected = [axis[i] for axis, i in zip(GRID.axes_mm(), index, strict=True)]
    np.testing.assert_allclose(cloud.mean.T[::-1], expected, rtol=0, atol=FLOAT64)
    assert np.all(volume[index] > 0.2)
    np.testing.assert_allclose(cloud.density, 0.15 * volume[index], rtol=FLOAT64)
    np.testing.assert_array_equal(cloud.quaternion, np.tile([1.0, 0, 0, 0], (50, 1)))


def test_scale_is_the_rms_distance_to_the_three_nearest(volume) -> None:
    cloud = draw(volume, 40, scale_factor=0.7)
    apart = np.linalg.norm(cloud.mean[:, None] - cloud.mean[None], axis=-1)
    nearest = np.sort(apart, axis=1)[:, 1:4]
    expected = 0.7 * np.sqrt((nearest**2).mean(axis=1))
    np.testing.assert_allclose(cloud.scale, np.repeat(expected[:, None], 3, axis=1), rtol=FLOAT64)
    bounded = draw(volume, 40, scale_bounds=(0.2, 0.25))
    assert bounded.scale.min() == 0.2 and bounded.scale.max() == 0.25
    assert draw(volume, 10**6).count == int((volume > 0.2).sum())  # no more than there are voxels
    one, same, other = (draw(volume, 20, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.mean, same.mean)
    assert np.any(one.mean != other.mean)


def test_hardly_anything_still_gives_a_cloud() -> None:
    for occupied in (0, 1, 2):
        cloud = draw((np.arange(np.prod(GRID.shape)) < occupied).reshape(GRID.shape) * 1.0, 30)
        assert cloud.count == max(occupied, 1)
        assert np.all(np.isfinite(cloud.scale)) and np.all(cloud.scale > 0) and np.all(cloud.density > 0)
