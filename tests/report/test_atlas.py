"""The volume in 3D on a page: its voxels, its budget, and the centres of Gaussians."""

import base64
import json

import numpy as np
import pytest

from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.report.atlas import MOST_CENTRES, MOST_EDGE, MOST_TEXT, space
from phyradgs_cl.report.images import Window, bytes_of

pytestmark = pytest.mark.slow


def data_of(parse, *arguments: object) -> dict:
    page = parse(space(*arguments))
    assert not page.open and {"space", "threshold", "turn", "tilt", "space-zoom", "space-reset"} <= set(page.ids)
    return json.loads(page.texts["script"][0])


def voxels_of(parse, data: dict) -> np.ndarray:
    """The voxels (nz, ny, nx) uint8 that the page's script reads from the atlas."""
    sheet = parse.pixels("data:image/png;base64," + data["atlas"])
    nx, ny, nz = data["counts"]
    rows, columns = (np.arange(nz) // data["columns"], np.arange(nz) % data["columns"])
    return np.stack([sheet[r * ny : (r + 1) * ny, c * nx : (c + 1) * nx] for r, c in zip(rows, columns, strict=True)])


def cloud(means_mm: np.ndarray, density: np.ndarray) -> Gaussians:
    count = len(means_mm)
    return Gaussians(means_mm, np.full((count, 3), 0.1), np.tile([1.0, 0, 0, 0], (count, 1)), density)


def test_the_atlas_has_every_voxel_in_the_steps_of_the_slices(any_volume, parse) -> None:
    volume, grid = any_volume
    window = Window.of(50.0, 400.0, volume)
    data = data_of(parse, volume, grid, window, None)
    assert data["counts"] == [8, 6, 5] and data["size_mm"] == pytest.approx([0.8, 1.2, 1.5])
    assert np.array_equal(voxels_of(parse, data), bytes_of(volume, window.least, window.most))
    black, white = (data["least"] + step / 255 * (data["most"] - data["least"]) for step in data["ends"])
    assert (black, white) == pytest.approx((50.0, 400.0)) and data["centres"] is None


def test_noise_that_nothing_compresses_stays_within_the_budget(parse) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (128, 128, 128)).astype(np.float32)
    data = data_of(parse, noise, Grid.cube(128, 10.0), Window.of(0.0, 255.0, noise, np.array([255.0])), None)
    assert 0.5 * MOST_TEXT < len(data["atlas"]) <= MOST_TEXT and MOST_TEXT == 2_000_000
    assert np.abs(voxels_of(parse, data).astype(float) - noise).max() <= 8  # 4 of 8 bits at least


def test_larger_volumes_are_means_over_blocks(parse) -> None:
    ramp = np.broadcast_to(np.arange(2.0 * MOST_EDGE, dtype=np.float32), (3, 4, 2 * MOST_EDGE))
    data = data_of(parse, ramp, Grid((3, 4, 2 * MOST_EDGE), (1.0, 1.0, 0.5)), Window.of(0.0, 255.0, ramp), None)
    assert data["counts"] == [MOST_EDGE, 4, 3] and "3 × 4 × 256 voxels (z, y, x), means over blocks" in data["words"]
    assert np.array_equal(voxels_of(parse, data)[0, 0], np.rint(np.arange(MOST_EDGE) * 2 + 0.5))


def test_centres_are_places_in_the_box_and_densities_and_many_are_thinned(parse) -> None:
    grid = Grid((4, 4, 4), (0.5, 0.5, 0.5), (1.0, 0.0, -1.0))  # z, y, x
    means = np.array([[-1.0, 0.0, 1.0], [-1.9, 0.5, 0.25], [5.0, 0.0, 1.0]])
    data = data_of(parse, np.ones((4, 4, 4)), grid, Window.of(0.0, 1.0, np.ones(1)), cloud(means, np.array([1.0, 0.5, 9.0])))
    places = np.frombuffer(base64.b64decode(data["centres"]["places"]), "<u2").reshape(-1, 3) / 65535
    assert places == pytest.approx(np.array([[0.5, 0.5, 0.5], [0.05, 0.75, 0.125]]), abs=1e-4)  # the third is outside
    densities = np.frombuffer(base64.b64decode(data["centres"]["densities"]), np.uint8)
    assert densities[0] >= 254 and abs(int(densities[1]) - 128) <= 1
    many = cloud(np.random.default_rng(2).uniform(-1, 1, (3 * MOST_CENTRES, 3)), np.ones(3 * MOST_CENTRES))
    markup = space(np.ones((4, 4, 4)), Grid.cube(4, 2.0), Window.of(0.0, 1.0, np.ones(1)), many)
    places = json.loads(parse(markup).texts["script"][0])["centres"]["places"]
    assert f"of {3 * MOST_CENTRES})" in markup and len(base64.b64decode(places)) == 6 * MOST_CENTRES


def test_the_first_threshold_divides_air_from_matter(parse) -> None:
    volume = np.full((8, 8, 8), 0.1, np.float32)
    volume[2:6, 2:6, 2:6] = 0.9
    page = parse(space(volume, Grid.cube(8, 2.0), Window.of(0.0, 1.0, volume), None))
    step = next(int(control["value"]) for control in page.all("input") if control["id"] == "threshold")
    assert step / 255 == pytest.approx(0.5, abs=0.01)  # in the middle of the gap
