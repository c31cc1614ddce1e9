"""Numbers at the edge of what may be asked: results are finite, or an error of ours says which number is not."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.cells import static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.gaussians import DENSITY, MEAN, SCALE
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, RayOperator, SplatProjector, voxelise
from phyradgs_cl.optim import DeviceAdam
from phyradgs_cl.reconstructors import METHODS, RunPlan, method_options, reconstruct
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime.layout import pad_rows
from phyradgs_cl.workflow.files import load_scan

pytestmark = pytest.mark.slow
SHAPE = (6, 7)
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (0.6, 0.6))
GRID = Grid.cube(8, 2.0)


def one_cell(geometry: ConeGeometry, angle_rad: float = 0.3) -> TimeCells:
    orbit = CircularOrbit(geometry, ConstantSpeed(angle_rad, 0.0))
    return static_cells(orbit, Shutter(0.1), 0, 0.0, geometry.detector_shape[0])


def expect_finite(rt, rows: np.ndarray, cells: TimeCells, **options: object) -> None:
    """The frame (6, 7) and the gradient (13, G) of its sum."""
    projector = SplatProjector(rt, *SHAPE, **options)
    on_device, gaussians = DeviceCells.upload(rt, cells), DeviceGaussians.upload(rt, rows)
    frame = projector.project(rows, on_device)
    projector.forward(gaussians, on_device)
    gradients, ones = rt.zeros((13, gaussians.stride)), rt.upload(pad_rows(np.ones(SHAPE, np.float32)))
    projector.backward(gaussians, on_device, ones, gradients)
    assert np.isfinite(frame).all() and np.isfinite(rt.download(gradients)[:, : gaussians.count]).all()


@pytest.mark.parametrize("affine", [False, True], ids=["exact", "affine"])
def test_gaussians_at_the_bounds_of_their_parameters(rt, make_cloud, affine) -> None:
    """Raw parameters as large as float32 lets an optimiser drive them: the activation, on the device too, keeps bounds."""
    activation, on_device = SplatOptions().activation(GRID), rt.zeros((11, 64))
    raw = np.random.default_rng(0).choice([-1e4, -50.0, 0.0, 50.0, 1e4], (11, 64)).astype(np.float32)
    raw[MEAN] = np.random.default_rng(1).uniform(-1, 1, (3, 64))
    rows = activation.apply(raw.astype(np.float64))
    DeviceAdam(rt, activation).activate(rt.upload(raw), on_device, 64, 64)
    for found in (rows, rt.download(on_device)):
        assert np.isfinite(found).all() and found[SCALE].min() > 0 and found[DENSITY].min() >= 0
    expect_finite(rt, rows, one_cell(GEOMETRY), affine=affine)
    assert np.isfinite(voxelise(rt, rows, GRID)).all()


@pytest.mark.parametrize("affine", [False, True], ids=["exact", "affine"])
def test_gaussians_at_the_source_behind_it_and_in_its_plane(rt, make_cloud, affine) -> None:
    cells = one_cell(GEOMETRY)
    source, to_detector = cells.pose[0, :3], -cells.pose[0, :3] / np.linalg.norm(cells.pose[0, :3])
    across, rows = np.cross(to_detector, [0.0, 0.0, 1.0]), make_cloud(12, 5)
    for index, place in enumerate((0.0, 1e-7, -1e-7, 1e-3, -1e-3, -0.5, 0.05)):
        rows[MEAN, index] = source + place * to_detector
    for index, place in enumerate((1e-3, 0.1, 1.0, -3.0, 100.0), start=7):
        rows[MEAN, index] = source + place * across
    for cutoff_sigma in (0.0, 3.0):
        expect_finite(rt, rows, cells, affine=affine, cutoff_sigma=cutoff_sigma)


@pytest.mark.parametrize("distance", [1e-3, 0.5, 1.0])
def test_a_source_inside_the_volume(rt, make_cloud, distance) -> None:
    cells = one_cell(ConeGeometry(distance, distance + 3.0, SHAPE, (0.6, 0.6)))
    operator = RayOperator(rt, GRID, SHAPE, [cells])
    assert np.isfinite(operator.forward(np.ones(GRID.shape, np.float32))).all()
    assert np.isfinite(operator.adjoint(np.ones(operator.frames_shape, np.float32))).all()
    expect_finite(rt, make_cloud(20, 6), cells)


@pytest.mark.parametrize("turn", [0.0, np.pi / 4])
@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (4, 4)])
def test_rays_through_vertices_and_along_faces(rt, turn, shape) -> None:
    """The central ray of odd detectors runs in planes of voxels' faces or through corners; a voxel counts once."""
    geometry = ConeGeometry(1e6, 1e6 + 2.0, shape, (0.5, 0.5))  # all but parallel
    operator = RayOperator(rt, Grid.cube(4, 2.0), shape, [one_cell(geometry, turn)])
    frame = operator.forward(np.ones((4, 4, 4), np.float32))
    assert np.isfinite(frame).all() and frame.max() <= 2 * np.sqrt(2) * 1.01
    if shape == (1, 1):
        assert frame.item() == pytest.approx(2 / max(abs(np.cos(turn)), abs(np.sin(turn))), rel=0.26)
    assert np.isfinite(operator.adjoint(np.ones((1, *shape), np.float32))).all()


@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("naf", "sax-nerf")])
def test_any_finite_scan(rt, scan, method) -> None:
    """Whatever numbers are measured: a finite volume, or an error that names what is not."""
    loaded = load_scan(scan)
    index = np.arange(loaded.projections.size).reshape(loaded.projections.shape)
    if method == "fbp":
        panel = ParallelGeometry(loaded.geometry.detector_shape, loaded.geometry.pixel_size_mm)
        loaded = replace(loaded, geometry=panel, trajectory=CircularOrbit(panel, loaded.trajectory.kinematics))
    changes = {} if method in ("fdk", "fbp") else {"iterations": 2}
    if method in ("phyradgs", "r2"):
        changes = {"iterations": 4, "gaussians": 20}
    options = method_options(method, None, changes)
    for values, frames in {
        "zero": 0 * index, "huge": 0 * index + 1e6, "negative": 0 * index - 1,
        "one pixel": np.where(index == 70, 50.0, 0.0), "alternating": np.where(index % 2, 1e5, -1e5),
    }.items():  # fmt: skip
        measured = replace(loaded, projections=frames.astype(np.float32))
        with np.errstate(all="ignore"):
            try:
                assert np.isfinite(reconstruct(measured, RunPlan(method, options, seed=0), rt).volume).all(), values
            except NumericalError as error:
                assert values in ("huge", "alternating") and error.found
