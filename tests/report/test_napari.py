"""napari itself opens volumes by the manifest, and an OME-Zarr by its plugin, where both are installed (conftest.py)."""

from pathlib import Path

import napari
import numpy as np
import pytest
from napari.components import ViewerModel
from npe2 import PluginManager, PluginManifest

import phyradgs_cl
from phyradgs_cl.exporters import export_volume
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume

MANIFEST = Path(phyradgs_cl.__file__).with_name("napari.yaml")


@pytest.fixture
def viewer() -> ViewerModel:
    """A viewer without a window, in which the plugin is installed."""
    manifest, manager = PluginManifest.from_file(MANIFEST), PluginManager.instance()
    if manifest.name not in {known.name for known in manager.iter_manifests()}:
        manager.register(manifest)
    return ViewerModel()


def test_napari_opens_a_volume_in_millimetres(viewer, tmp_path) -> None:
    grid = Grid((4, 5, 6), (2.0, 1.0, 0.5), (3.0, 0.0, -1.0))
    values = np.arange(120, dtype=np.float32).reshape(grid.shape)
    write_volume(tmp_path / "v.h5", values, grid, {})
    (layer,) = viewer.open(str(tmp_path / "v.h5"), plugin="phyradgs-cl")
    np.testing.assert_array_equal(layer.data, values)
    np.testing.assert_allclose(layer.scale, grid.voxel_size_mm)
    np.testing.assert_allclose(layer.translate, grid.first_centre_mm)
    assert [str(unit) for unit in layer.units] == ["millimeter"] * 3 and napari.__version__


def test_napari_opens_an_exported_ome_zarr_with_its_levels(tmp_path) -> None:
    """The plugin napari-ome-zarr leaves out where the first voxel is."""
    grid = Grid((4, 5, 140), (2.0, 1.0, 0.5), (3.0, 0.0, -1.0))
    values = np.arange(2800, dtype=np.float32).reshape(grid.shape)
    write_volume(tmp_path / "v.h5", values, grid, {})
    path = export_volume(tmp_path / "v.h5", "zarr")
    PluginManager.instance().discover()
    (layer,) = ViewerModel().open(str(path), plugin="napari-ome-zarr")
    assert [level.shape for level in layer.data] == [(4, 5, 140), (2, 2, 70), (1, 1, 35)]
    np.testing.assert_array_equal(np.asarray(layer.data[0]), values)
    np.testing.assert_allclose(layer.scale, grid.voxel_size_mm)
    assert [str(unit) for unit in layer.units] == ["millimeter"] * 3
