"""Both launch shapes give the same frames: bands of lines (CPUs) and a work-item a pixel (GPUs)."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, make_protocol
from phyradgs_cl.acquisition.cells import micro_view_cells
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceCells, SplatProjector, Voxeliser
from phyradgs_cl.operators.twins.splat import splat_frame, voxel_field
from phyradgs_cl.runtime import Runtime

DETECTOR = (37, 45)


@pytest.fixture(scope="module")
def pixel_rt():
    return Runtime(lanes=1, pixel_items=True)


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(5)
    cloud = np.zeros((11, 23))
    cloud[:3] = rng.uniform(-0.6, 0.6, (3, 23))
    cloud[3:6] = rng.uniform(0.02, 0.2, (3, 23))
    cloud[6:10] = rng.normal(size=(4, 23))
    cloud[6:10] /= np.linalg.norm(cloud[6:10], axis=0)
    cloud[10] = rng.uniform(0.2, 1, 23)
    return cloud


@pytest.fixture(scope="module")
def table():
    protocol = make_protocol("rapid")
    orbit = protocol.orbit(ConeGeometry(5, 7, DETECTOR, (0.1, 0.09), (0.1, -0.2)))
    return micro_view_cells(
        orbit, protocol.shutter(), 2, float(protocol.frame_start_s()[2]), DETECTOR[0], 4, 3
    )


@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("cutoff_sigma", [0.0, 3.7])
def test_splats_by_pixel(pixel_rt, rows, table, affine, cutoff_sigma):
    projector = SplatProjector(pixel_rt, *DETECTOR, affine=affine, cutoff_sigma=cutoff_sigma)
    frame = projector.project(rows, DeviceCells.upload(pixel_rt, table))
    expected = splat_frame(rows, table, DETECTOR, cutoff_sigma, affine)
    assert np.abs(frame - expected).max() <= 1e-5 * expected.max()


def test_gradients_by_group(pixel_rt, rows, table):
    by_image = np.random.default_rng(6).normal(size=DETECTOR)
    gradients = []
    for rt in (pixel_rt, Runtime()):
        projector = SplatProjector(rt, *DETECTOR)
        gradients.append(projector.project_adjoint(rows, DeviceCells.upload(rt, table), by_image))
    for mine, other in zip(*gradients, strict=True):
        assert np.abs(mine - other).max() <= 1e-4 * np.abs(other).max()


def test_voxels_by_item(pixel_rt, rows):
    grid = Grid((9, 18, 21), (0.2, 0.1, 0.09))
    volume = Voxeliser(pixel_rt, grid.shape, cutoff_sigma=3.7).voxelise(rows, grid)
    expected = voxel_field(rows, *grid.axes_mm(), 3.7)
    assert np.abs(volume - expected).max() <= 1e-5 * expected.max()


def test_vectors_and_pixel_items_exclude_each_other():
    with pytest.raises(DeviceError, match="lanes"):
        Runtime(lanes=4, pixel_items=True)
