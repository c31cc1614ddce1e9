"""OME-Zarr: levels and places as its own models see them, other programs' folders, and what is refused."""

import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zarr

from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import export_volume
from phyradgs_cl.exporters.writers import write_zarr
from phyradgs_cl.fields import Grid, Hounsfield
from phyradgs_cl.importers import load_volume
from phyradgs_cl.io import Volume, sha256_of
from phyradgs_cl.io.attenuation import attenuation_of

pytestmark = pytest.mark.slow


def write_image(*given, **named) -> None:
    from ome_zarr import writer  # takes seconds, in every process that collects tests

    writer.write_image(*given, **named)


def test_every_level_has_the_means_and_places_of_the_one_before(tmp_path) -> None:
    """Three levels, with odd counts and unequal sides; in every direction longer than a chunk."""
    from ome_zarr_models import open_ome_zarr

    grid = Grid((131, 70, 300), (2.0, 1.5, 0.25), (10.0, -4.0, 3.0))
    large = Volume(np.random.default_rng(5).uniform(0, 0.03, grid.shape).astype(np.float32), grid)
    write_zarr(tmp_path / "v.ome.zarr", large, None)
    image = open_ome_zarr(zarr.open_group(str(tmp_path / "v.ome.zarr"), mode="r"))
    assert image.ome_attributes.version == "0.5"
    levels = [image.attributes.ome.multiscales[0].datasets[n] for n in range(4)]
    arrays = [zarr.open_array(str(tmp_path / "v.ome.zarr" / level.path), mode="r") for level in levels]
    assert [array.shape for array in arrays] == [(131, 70, 300), (65, 35, 150), (32, 17, 75), (16, 8, 37)]
    assert arrays[0].chunks == (64, 64, 64)
    np.testing.assert_array_equal(arrays[0][...], large.values)
    halves = large.values[:130].reshape(65, 2, 35, 2, 150, 2).mean((1, 3, 5))
    np.testing.assert_allclose(arrays[1][...], halves, atol=1e-8)
    for n, level in enumerate(levels):
        scale, translation = level.coordinateTransformations
        assert scale.scale == pytest.approx(np.array((2.0, 1.5, 0.25)) * 2**n)
        assert (np.array(translation.translation) - np.array(scale.scale) / 2) == pytest.approx(grid.box_mm[:, 0])
    np.testing.assert_array_equal((again := load_volume(tmp_path / "v.ome.zarr")).values, large.values)
    assert again.grid.is_close(grid)


def test_no_second_copy_of_the_volume_is_made(tmp_path) -> None:
    scale, values = Hounsfield(0.02, 0.001), np.zeros((2048, 48, 48), np.float32)
    write_zarr(tmp_path / "warm.zarr", Volume(values[:64], Grid((64, 48, 48), (1.0, 1.0, 1.0))), scale)
    tracemalloc.start()
    write_zarr(tmp_path / "v.zarr", Volume(values, Grid(values.shape, (1.0, 1.0, 1.0))), scale)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 0.4 * values.nbytes, peak_bytes


def test_other_programs_versions_units_axes_and_types(tmp_path, caplog) -> None:
    """A folder without units has no scale."""
    from ome_zarr.format import FormatV04

    counts = np.random.default_rng(1).integers(-1000, 3000, (1, 1, 6, 5, 4)).astype(np.int16)
    sides, units = {"t": 1.0, "c": 1.0, "z": 500.0, "y": 250.0, "x": 125.0}, {axis: "micrometer" for axis in "zyx"}
    write_image(counts, str(tmp_path / "v4.zarr"), axes="tczyx", scale=sides, axes_units=units, fmt=FormatV04())
    with pytest.raises(InputError, match="as of Hounsfield"):
        attenuation_of("v4", load_volume(tmp_path / "v4.zarr"))
    loaded = load_volume(tmp_path / "v4.zarr", mu_water_per_mm=0.02)
    np.testing.assert_allclose(loaded.values, 0.02 * (1 + counts[0, 0] / 1000), atol=1e-7)
    assert loaded.grid.voxel_size_mm == pytest.approx((0.5, 0.25, 0.125))
    write_image(counts[0, 0].T.astype(np.float16), str(tmp_path / "xyz.zarr"), axes="zyx", axes_units=units)
    group = zarr.open_group(str(tmp_path / "xyz.zarr"), mode="a")
    facts = group.attrs["ome"]
    for axis, name in zip(facts["multiscales"][0]["axes"], "xyz", strict=True):
        axis["name"] = name
    group.attrs["ome"] = facts
    np.testing.assert_array_equal(load_volume(tmp_path / "xyz.zarr").values, counts[0, 0].astype(np.float16))
    write_image(np.ones((4, 5, 6), np.float32), str(tmp_path / "bare.zarr"), axes="zyx")
    assert load_volume(tmp_path / "bare.zarr").grid is None and "no sizes in a unit of length" in caplog.text


def test_what_is_lost_or_no_volume_is_said(volume_file, stored, tmp_path, caplog) -> None:
    path = export_volume(volume_file, "zarr")
    assert path.name == "volume.ome.zarr" and len(sha256_of(path)) == 64
    lost = shutil.copytree(path, tmp_path / "lost.zarr")
    (lost / "s0" / "c" / "0" / "0" / "0").unlink()
    assert sha256_of(lost) != sha256_of(path)
    assert not load_volume(lost).values.any() and "1 chunks are missing" in caplog.text
    (shutil.copytree(path, tmp_path / "damaged.zarr") / "s0" / "c" / "0" / "0" / "0").write_bytes(b"nothing")
    (tmp_path / "empty.zarr").mkdir()
    write_image(np.ones((2, 4, 5, 6), np.float32), str(tmp_path / "times.zarr"), axes="tzyx")
    write_image(np.ones((4, 5), np.float32), str(tmp_path / "flat.zarr"), axes="yx")
    for name in ("empty", "flat", "none", "damaged", "times"):
        words = "axes t, z, y, x of" if name == "times" else ""
        with pytest.raises(InputError, match=f"{name}.zarr: found .*{words}.*; expected an OME-Zarr with real numbers"):
            load_volume(Path(tmp_path / f"{name}.zarr"))
