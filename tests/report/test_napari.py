"""napari itself opens volumes and scans by the manifest, without a window; where napari is installed (conftest.py)."""

from pathlib import Path

import napari
import numpy as np
import pytest
from napari.components import ViewerModel
from npe2 import PluginManager, PluginManifest

import phyradgs_cl
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume

MANIFEST = Path(phyradgs_cl.__file__).with_name("napari.yaml")


@pytest.fixture
def viewer() -> ViewerModel:
    """A viewer without a window, in which the plugin is installed."""
    manifest = PluginManifest.from_file(MANIFEST)
    manager = PluginManager.instance()
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
