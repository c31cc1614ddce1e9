"""A volume that no flip or exchange of axes leaves as it is, with Gaussians, in a file of ours."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.io import read_volume, write_volume

collect_ignore = [] if find_spec("ome_zarr") else ["test_ome_zarr.py"]  # which needs Python 3.11
GRID = Grid((5, 6, 7), (2.0, 1.5, 1.25), (10.0, -4.0, 3.0))


def marked() -> np.ndarray:
    """(z, y, x) float32 in 1/mm: every voxel its own number, one voxel far above all, in no symmetric place."""
    values = np.random.default_rng(5).uniform(0, 0.03, GRID.shape).astype(np.float32)
    values[4, 1, 2] = 0.09
    return values


@pytest.fixture
def volume_file(tmp_path) -> Path:
    rng = np.random.default_rng(6)
    quaternion = rng.normal(size=(9, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    parts = rng.normal(size=(9, 3)), rng.uniform(0.5, 2, (9, 3)), quaternion, rng.uniform(0.01, 0.02, 9)
    cloud = Gaussians(*(part.astype(np.float32) for part in parts))
    write_volume(tmp_path / "volume.h5", marked(), GRID, {"method": "phyradgs"}, cloud)
    return tmp_path / "volume.h5"


@pytest.fixture
def stored(volume_file):
    return read_volume(volume_file)
