"""Volume files: what is written comes back, viewers find their axes, damage is named; and bare arrays."""

import hashlib
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from damage import attribute, on, removed, value

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gaussians, Grid, States
from phyradgs_cl.importers import load_attenuation, load_volume
from phyradgs_cl.io import read_states, read_volume, sha256_of, volume_summary, write_volume
from phyradgs_cl.io.attenuation import attenuation_of

GRID = Grid((2, 3, 4), (1.5, 1.25, 1.0), (0.1, -0.2, 0.3))
PROVENANCE = {"method": "fdk", "seed": 7, "options": {"filter": "ram-lak", "M": [1, 2]}, "loss": float("inf")}


@pytest.fixture
def stored(tmp_path):
    volume, rows = np.arange(24, dtype=np.float32).reshape(GRID.shape) / 1000, np.arange(5 * 11.0).reshape(5, 11)
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


def test_volumes_that_do_not_fit_are_refused(tmp_path) -> None:
    for wrong in (np.zeros((2, 3, 5)), np.full(GRID.shape, np.nan)):
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


# --- volumes as other programs write them -------------------------------------------------------------------------------


def _write(path: Path, data: object) -> Path:
    with h5py.File(path, "w") as file:
        file["volume"] = data
    return path


def test_integers_are_divided_by_their_types_maximum(tmp_path: Path) -> None:
    for dtype, top in (("u1", 255), ("u2", 65535), ("i2", 32767)):
        data = np.zeros((2, 3, 4), dtype)
        data[1, 2, 3], data[0, 0, 0] = top, top // 2
        loaded = load_volume(_write(tmp_path / "v.h5", data))
        assert loaded.grid is None and loaded.values.dtype == np.float32
        assert loaded.values[1, 2, 3] == 1 and loaded.values[0, 0, 0] == pytest.approx((top // 2) / top, rel=1e-6), dtype
    data = np.random.default_rng(0).normal(size=(3, 4, 5))
    assert np.array_equal(load_volume(_write(tmp_path / "v.h5", data)).values, data.astype(np.float32))


def test_the_axes_alone_give_the_grid_if_they_exist_are_even_and_have_units(stored) -> None:
    path, axis = stored[0], "entry/reconstruction/y"
    on("entry/grid", removed)(path)
    found = load_volume(path).grid
    np.testing.assert_allclose((found.voxel_size_mm, found.offset_mm), (GRID.voxel_size_mm, GRID.offset_mm))
    content = path.read_bytes()
    on(axis, attribute("units", "cm"))(path)
    assert load_volume(path).grid.voxel_size_mm == pytest.approx((1.5, 12.5, 1.0))
    wrong = map(value, ([0.0, 1.0], [0, 1, 3], [4, 3, 2], [0, np.nan, 3]))
    for damage in (removed, attribute("units", "inch"), *wrong):
        path.write_bytes(content)
        on(axis, damage)(path)
        with pytest.raises(InputError, match=f"volume.h5:/{axis}"):
            load_volume(path)


def test_what_does_not_attenuate_cannot_be_scanned(tmp_path: Path) -> None:
    for level in (0.0, -0.5):
        path = _write(tmp_path / "v.h5", np.full((2, 3, 4), level, np.float32))
        with pytest.raises(InputError, match=r"v.h5: found values from .*; expected attenuation: 0 in air"):
            load_attenuation(path)
        assert load_volume(path).values.min() == level


@pytest.mark.parametrize(("unit", "factor"), [("1/mm", 1.0), ("1/µm", 1e3), ("cm^-1", 0.1)])
def test_a_file_that_states_its_unit_is_taken_at_its_word(tmp_path: Path, unit: str, factor: float) -> None:
    """In nano-CT attenuation is 100 to 250 per mm and more, and noise is as high. Without the unit this could be HU."""
    values = np.random.default_rng(0).normal(0, 60, (12, 12, 12)).astype(np.float32)
    values[:6] += 600.0
    path = tmp_path / "v.h5"
    write_volume(path, values / factor, Grid(values.shape, (1e-4,) * 3), {})
    with h5py.File(path, "r+") as file:
        file["entry/reconstruction/volume"].attrs["units"] = unit
    for asked in (None, 0.02):
        volume = attenuation_of("v.h5", load_volume(path, asked))
        np.testing.assert_allclose(volume.values, values, rtol=1e-6)
    scale = volume.hounsfield().scale
    assert scale is not None and scale.water_per_mm == pytest.approx(600, rel=0.05)
    with h5py.File(path, "r+") as file:
        del file["entry/reconstruction/volume"].attrs["units"]
        file["entry/reconstruction/volume"][...] = values
    for refused in (partial(attenuation_of, "v.h5", load_volume(path)), load_volume(path).hounsfield):
        with pytest.raises(InputError, match="as of Hounsfield units"):
            refused()


def test_hounsfield_units_are_refused_or_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    air_around = np.full((4, 4, 4), -1000.0, np.float32)
    air_around[1:3, 1:3, 1:3] = 40.0
    with pytest.raises(InputError, match="found values from -1000 to 40;.*Hounsfield"):
        load_attenuation(_write(tmp_path / "head.h5", air_around))
    mostly_bone = np.full((4, 4, 4), 900.0, np.float32)
    mostly_bone[0] = -1000.0
    path = _write(tmp_path / "bone.h5", mostly_bone)
    load_attenuation(path, warn=False)
    assert not caplog.records
    load_attenuation(path)
    assert "bone.h5: values from -1000 to 900, 37 % as much below 0 as above" in caplog.text
    caplog.clear()  # noise about nothing is no reason to warn
    volume = np.random.default_rng(0).normal(0, 0.03, (8, 8, 8))
    volume[2:6, 2:6, 2:6] += 1
    assert load_attenuation(_write(tmp_path / "v.h5", volume)).values.min() < 0 and not caplog.records
