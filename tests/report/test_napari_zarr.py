"""napari opens an exported OME-Zarr, without a window; where napari and its plugin are installed (conftest.py)."""

import numpy as np
from napari.components import ViewerModel
from npe2 import PluginManager

from phyradgs_cl.exporters import export_volume
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume


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
