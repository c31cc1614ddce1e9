"""Volumes from files: two layouts, axes and units."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.volume import Grid
from phyradgs_cl.importers import load_attenuation, load_volume

pytestmark = pytest.mark.slow


def _write(path: Path, data: object, name: str = "volume") -> Path:
    with h5py.File(path, "w") as file:
        file[name] = data
    return path


def _write_result(path: Path, grid: Grid, **replace: object) -> Path:
    axes = dict(zip("zyx", grid.axes_mm(), strict=True)) | replace
    with h5py.File(path, "w") as file:
        group = file.create_group("entry/reconstruction")
        group["volume"] = np.arange(np.prod(grid.shape), dtype=np.float32).reshape(grid.shape) - 5
        for name, values in axes.items():
            if values is not None:
                group[name] = np.asarray(values, dtype=np.float32)
                group[name].attrs["units"] = "mm"
    return path


def test_integers_are_divided_by_their_types_maximum(tmp_path: Path) -> None:
    for dtype, top in (("u1", 255), ("u2", 65535), ("i2", 32767)):
        data = np.zeros((2, 3, 4), dtype)
        data[1, 2, 3], data[0, 0, 0] = top, top // 2
        loaded = load_volume(_write(tmp_path / "v.h5", data))
        volume = loaded.values
        assert loaded.grid is None and volume.dtype == np.float32
        assert volume[1, 2, 3] == 1 and volume[0, 0, 0] == pytest.approx((top // 2) / top, rel=1e-6), dtype
    data = np.random.default_rng(0).normal(size=(3, 4, 5))
    assert np.array_equal(load_volume(_write(tmp_path / "v.h5", data)).values, data.astype(np.float32))


def test_a_result_file_comes_with_its_grid(tmp_path: Path) -> None:
    grid = Grid((4, 5, 6), (0.5, 0.25, 0.2), (3.0, -1.0, 0.5))
    loaded = load_volume(_write_result(tmp_path / "r.h5", grid))
    volume, found = loaded.values, loaded.grid
    assert volume.shape == (4, 5, 6) and volume.min() == -5
    assert found is not None and found.shape == grid.shape
    assert np.allclose(found.voxel_size_mm, grid.voxel_size_mm, rtol=1e-5)
    assert np.allclose(found.offset_mm, grid.offset_mm, atol=1e-5)


def test_axes_must_exist_and_be_even(tmp_path: Path) -> None:
    for axis in (None, [0.0, 1.0], [0, 1, 2, 3, 5], [4, 3, 2, 1, 0], [0, 1, np.nan, 3, 4]):
        path = _write_result(tmp_path / "r.h5", Grid((4, 5, 6), (1.0, 1.0, 1.0)), y=axis)
        with pytest.raises(InputError, match=r"r.h5:/entry/reconstruction/y"):
            load_volume(path)


def test_axes_have_units(tmp_path: Path) -> None:
    path = _write_result(tmp_path / "r.h5", Grid((4, 5, 6), (1.0, 1.0, 1.0)))
    with h5py.File(path, "r+") as file:
        file["/entry/reconstruction/x"].attrs["units"] = "cm"
    assert load_volume(path).grid.voxel_size_mm == pytest.approx((1.0, 1.0, 10.0))
    with h5py.File(path, "r+") as file:
        file["/entry/reconstruction/x"].attrs["units"] = "inch"
    with pytest.raises(InputError, match="'inch'"):
        load_volume(path)


def test_what_does_not_attenuate_cannot_be_scanned(tmp_path: Path) -> None:
    for level in (0.0, -0.5):
        path = _write(tmp_path / "v.h5", np.full((2, 3, 4), level, np.float32))
        with pytest.raises(InputError, match=r"v.h5: found values from .*; expected attenuation: 0 in air"):
            load_attenuation(path)
        assert load_volume(path).values.min() == level


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
    assert load_attenuation(_write(tmp_path / "v.h5", volume)).values.min() < 0
    assert not caplog.records
