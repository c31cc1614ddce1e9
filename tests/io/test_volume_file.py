"""Volume files: what is written comes back, viewers find their axes, damage is named."""

import hashlib

import h5py
import numpy as np
import pytest
from damage import on, removed, value

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gaussians, Grid, States
from phyradgs_cl.io import read_states, read_volume, sha256_of, volume_summary, write_volume

GRID = Grid((2, 3, 4), (1.5, 1.25, 1.0), (0.1, -0.2, 0.3))
PROVENANCE = {"method": "fdk", "seed": 7, "options": {"filter": "ram-lak", "M": [1, 2]}, "loss": float("inf")}


@pytest.fixture
def stored(tmp_path):
    volume = np.arange(24, dtype=np.float32).reshape(GRID.shape) / 1000
    rows = np.arange(5 * 11.0).reshape(5, 11)
    gaussians = Gaussians(rows[:, :3], rows[:, 3:6], rows[:, 6:10], rows[:, 10])
    parts = PROVENANCE, gaussians, {"psnr_db": np.float64(31.5)}
    write_volume(tmp_path / "volume.h5", volume, GRID, *parts)
    return tmp_path / "volume.h5", volume, gaussians


def test_everything_comes_back(stored) -> None:
    path, volume, gaussians = stored
    again = read_volume(path)
    np.testing.assert_array_equal(again.values, volume)
    assert again.values.dtype == np.float32
    assert (again.grid, again.provenance, again.metrics) == (GRID, PROVENANCE, {"psnr_db": 31.5})
    for name, values in vars(gaussians).items():
        np.testing.assert_array_equal(getattr(again.gaussians, name), values)
    facts = volume_summary(path)
    assert facts["shape"] == (2, 3, 4) and facts["gaussians"] == 5
    assert facts["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest() == sha256_of(path)
    write_volume(path, np.zeros(GRID.shape), GRID, {})
    again = read_volume(path)
    assert again.gaussians is None and again.metrics is None and again.provenance == {}


def test_viewers_find_signal_axes_and_plain_facts(stored) -> None:
    path, volume, _ = stored
    with h5py.File(path) as file:
        group = file["entry/reconstruction"]
        assert group.attrs["NX_class"] == "NXdata" and group.attrs["signal"] == "volume"
        assert list(group.attrs["axes"]) == ["z", "y", "x"]
        assert group["volume"].attrs["units"] == "1/mm" and group["x"].attrs["units"] == "mm"
        np.testing.assert_allclose(group["x"], 0.3 + np.array([-1.5, -0.5, 0.5, 1.5]))
        np.testing.assert_allclose(group["z"], 0.1 + np.array([-0.75, 0.75]))
        assert [len(group[axis]) for axis in "zyx"] == list(volume.shape)
        facts = file["entry/provenance"].attrs
        assert facts["method"] == "fdk" and facts["seed"] == 7


def test_the_axes_alone_give_the_grid(stored) -> None:
    path, _, _ = stored
    with h5py.File(path, "r+") as file:
        del file["entry/grid"]
    grid = read_volume(path).grid
    np.testing.assert_allclose(grid.voxel_size_mm, GRID.voxel_size_mm)
    np.testing.assert_allclose(grid.offset_mm, GRID.offset_mm)


def test_volumes_that_do_not_fit_are_refused(tmp_path) -> None:
    for wrong in (np.zeros((2, 3, 5)), np.full(GRID.shape, np.nan), np.zeros(3)):
        with pytest.raises(InputError, match="^volume: "):
            write_volume(tmp_path / "v.h5", wrong, GRID, {})
    assert list(tmp_path.iterdir()) == []


VOLUME = "entry/reconstruction/volume"
DAMAGE = [
    (VOLUME, value(np.zeros((3, 3, 4)))), (VOLUME, value(np.full(GRID.shape, np.nan))),
    ("entry/grid/voxel_size", value([1.0, 0.0, 1.0])), ("entry/provenance/json", value("[1]")),
    ("entry/gaussians/scale", value(-np.ones((5, 3)))),
    ("entry/time_series/time_s", value([3.0, 2.0])), ("entry/time_series/time_s", removed),
    ("entry/time_series/volume", value(np.zeros((3, *GRID.shape)))), ("entry/time_series/volume", removed),
]


def test_damage_is_named(stored) -> None:
    path, volume, gaussians = stored
    states = States(np.array([1.0, 2.0]), np.stack([volume, volume]))
    write_volume(path, volume, GRID, PROVENANCE, gaussians, states=states)
    content = path.read_bytes()
    for address, damage in DAMAGE:
        path.write_bytes(content)
        on(address, damage)(path)
        for read in (read_volume, read_states, volume_summary) if "time" in address else (read_volume,):
            with pytest.raises(InputError) as caught:
                read(path)
            assert caught.value.subject == f"{path}:/{address}"
