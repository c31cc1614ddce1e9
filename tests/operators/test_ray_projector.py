"""Joseph's projector and its adjoint: float64 twin, ⟨Ax, y⟩ = ⟨x, Aᵀy⟩, splats of the same field, closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import (
    ADJOINT,
    DISCRETISATION_ELLIPSOID,
    DISCRETISATION_GAUSSIANS,
    DISCRETISATION_ORDER,
    DISCRETISATION_SHEPP_LOGAN,
    FLOAT32,
    FLOAT64,
    RAYS,
    RAYS_BACK,
)

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter, pixel_centres
from phyradgs_cl.acquisition.cells import TimeCells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayProjector, voxelise
from phyradgs_cl.operators.twins.rays import joseph_adjoint, joseph_image, ray_frame
from phyradgs_cl.operators.twins.splat import splat_image
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom, rotation_about_z, shepp_logan

GRID = Grid((9, 14, 11), (0.21, 0.13, 0.16), (0.1, -0.05, 0.2))
SHAPE = (13, 18)
AXES = pytest.mark.parametrize("axis", ["rows", "columns"])


def noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)


def project(
    rt, volume: np.ndarray, grid: Grid, table: TimeCells, shape: tuple[int, int], model: str = "log"
) -> np.ndarray:
    projector = RayProjector(rt, grid, shape, table.axis)
    return projector.forward(projector.upload_volume(volume), table, model)


@pytest.mark.parametrize("shape", [(13, 18), (17, 5), (1, 1), (1, 20), (31, 27)])
@pytest.mark.parametrize("angle", [0.0, 0.77, 2.1, 4.0])
def test_static_projection_is_josephs(any_rt, one_cell, make_geometry, shape, angle) -> None:
    volume, pose = noise(GRID.shape, 51), make_geometry(*shape, offset=(0.1, -0.1)).pose(angle)
    image = project(any_rt, volume, GRID, one_cell(pose, shape[0]), shape)
    expected = joseph_image(volume, GRID, pose, shape)
    np.testing.assert_allclose(image, expected, rtol=0, atol=RAYS * max(expected.max(), 1))


def test_a_ray_along_z_takes_planes_of_z(rt, one_cell) -> None:
    """A source above the volume: the third of the kernel's three main axes."""
    pose = np.array([0.1, 0.2, 6.0, -1.2, -1.0, -3.0, 0.2, 0, 0, 0, 0.2, 0])
    volume = noise(GRID.shape, 52)
    image = project(rt, volume, GRID, one_cell(pose, 11), (11, 12))
    expected = joseph_image(volume, GRID, pose, (11, 12))
    assert expected.max() > 0.3
    np.testing.assert_allclose(image, expected, rtol=0, atol=RAYS * expected.max())


def tables(axis: str, geometry: ConeGeometry, shape: tuple[int, int]) -> dict[str, TimeCells]:
    orbit = CircularOrbit(geometry, ConstantSpeed(0.4, 0.7))
    shutter = Shutter(0.5, 0.4, axis, -1)
    where = (orbit, shutter, 0, 0.1, shutter.lines(shape))
    return {
        "static": static_cells(*where),
        "micro-views": micro_view_cells(*where, 5, 2),
        "per line": per_line_cells(*where, 3),
    }


@AXES
@pytest.mark.parametrize("motion", ["micro-views", "per line"])
def test_merged_frame_is_the_weighted_sum_of_static_ones(rt, make_geometry, axis, motion) -> None:
    table, volume = tables(axis, make_geometry(*SHAPE), SHAPE)[motion], noise(GRID.shape, 53)
    expected = ray_frame(volume, GRID, table, SHAPE)
    np.testing.assert_allclose(
        project(rt, volume, GRID, table, SHAPE), expected, rtol=0, atol=RAYS * expected.max()
    )
    intensity = project(rt, volume, GRID, table, SHAPE, "intensity")
    transmitted = ray_frame(volume, GRID, table, SHAPE, "intensity")
    np.testing.assert_allclose(intensity, transmitted, rtol=0, atol=RAYS * expected.max())
    assert np.abs(intensity - expected).max() > 10 * RAYS * expected.max()


@AXES
@pytest.mark.parametrize("motion", ["static", "micro-views", "per line"])
@pytest.mark.parametrize("shape", [(13, 18), (17, 5), (1, 1)])
def test_adjoint(rt, make_geometry, axis, motion, shape) -> None:
    table = tables(axis, make_geometry(*shape, offset=(0.1, 0.3)), shape)[motion]
    check_adjoint(rt, GRID, table, shape)


def test_adjoint_in_every_build(any_rt, make_geometry) -> None:
    check_adjoint(any_rt, GRID, tables("columns", make_geometry(*SHAPE), SHAPE)["micro-views"], SHAPE)


def check_adjoint(rt, grid: Grid, table: TimeCells, shape: tuple[int, int]) -> None:
    x, y = noise(grid.shape, 54), noise(shape, 55)
    ax = project(rt, x, grid, table, shape)
    aty = RayProjector(rt, grid, shape, table.axis).backproject(y, table)
    forward = float((ax.astype(np.float64) * y).sum())
    backward = float((x.astype(np.float64) * aty).sum())
    assert forward > 0 and np.all(np.isfinite(aty))
    assert abs(forward - backward) <= ADJOINT * forward


@pytest.mark.parametrize("shape", [(13, 18), (1, 20), (31, 27)])
@pytest.mark.parametrize("angle", [0.0, 0.77, 2.1])
def test_backprojection_is_josephs(any_rt, one_cell, make_geometry, shape, angle) -> None:
    pose, frame = make_geometry(*shape, offset=(0.1, -0.1)).pose(angle), noise(shape, 60)
    volume = RayProjector(any_rt, GRID, shape).backproject(frame, one_cell(pose, shape[0]))
    expected = joseph_adjoint(frame, GRID, pose)
    np.testing.assert_allclose(volume, expected, rtol=0, atol=RAYS_BACK * expected.max())


def test_twins_are_adjoint(make_geometry) -> None:
    x, y, pose = noise(GRID.shape, 61), noise(SHAPE, 62), make_geometry(*SHAPE).pose(0.7)
    forward = (joseph_image(x, GRID, pose, SHAPE) * y).sum()
    assert abs((joseph_adjoint(y, GRID, pose) * x).sum() - forward) <= FLOAT64 * forward


def test_adjoint_adds_where_it_is_told(rt, make_geometry) -> None:
    projector = RayProjector(rt, GRID, SHAPE)
    table = tables("rows", make_geometry(*SHAPE), SHAPE)["static"]
    y = noise(SHAPE, 56)
    volume = projector.upload_volume(np.zeros(GRID.shape))
    projector.adjoint(y, table, volume)
    projector.adjoint(y, table, volume, add=True)
    twice = rt.download(volume)
    projector.adjoint(2 * y, table, volume)
    np.testing.assert_allclose(twice, rt.download(volume), rtol=FLOAT32)
    assert twice.max() > 0


@pytest.mark.parametrize("distance", [0.4, 0.9])
def test_source_inside_the_volume(rt, one_cell, distance) -> None:
    """Planes behind the source do not count, neither forward nor back."""
    pose = ConeGeometry(distance, distance + 1.5, SHAPE, (0.2, 0.2)).pose(0.3)
    grid = Grid.cube(12, 2.0)
    table = one_cell(pose, SHAPE[0])
    volume = noise(grid.shape, 57)
    image, expected = project(rt, volume, grid, table, SHAPE), joseph_image(volume, grid, pose, SHAPE)
    assert np.all(np.isfinite(image))
    np.testing.assert_allclose(image, expected, rtol=0, atol=RAYS * expected.max())
    check_adjoint(rt, grid, table, SHAPE)


def test_voxelised_gaussians_project_like_splats(rt, one_cell, make_cloud, make_geometry) -> None:
    """Two routes to one number: the splat's closed form, and voxels with Joseph's sums; twice finer is better."""
    rows = make_cloud(6, 58, spread=0.4, scale=(0.12, 0.25))
    pose = make_geometry(24, 26).pose(0.6)
    splats = splat_image(rows, pose, (24, 26))
    errors = []
    for count in (24, 48):
        grid = Grid.cube(count, 4.0)  # holds the tails: the splat integrates over the whole line
        volume = voxelise(rt, rows, grid, cutoff_sigma=0.0)
        image = project(rt, volume, grid, one_cell(pose, 24), (24, 26))
        errors.append(np.abs(image - splats).max() / splats.max())
    assert errors[1] <= DISCRETISATION_GAUSSIANS
    assert errors[1] <= errors[0] / DISCRETISATION_ORDER


ONE_ELLIPSOID = EllipsoidPhantom(
    (Ellipsoid((0.1, -0.2, 0.1), (0.7, 0.4, 0.5), 1.3, rotation_about_z(0.5)),), "one"
)


@pytest.mark.parametrize(
    ("phantom", "tolerance"),
    [(ONE_ELLIPSOID, DISCRETISATION_ELLIPSOID), (shepp_logan(1.0), DISCRETISATION_SHEPP_LOGAN)],
    ids=["ellipsoid", "shepp-logan"],
)
def test_phantoms_project_like_their_closed_form(rt, one_cell, make_geometry, phantom, tolerance) -> None:
    """Edges are blurred over a voxel, so that the error falls with its size."""
    pose = make_geometry(32, 32).pose(0.9)
    exact = phantom.line_integrals(pose[:3], pixel_centres(pose, (32, 32)))
    errors = []
    for count in (24, 48):
        grid = Grid.cube(count, 2.0)
        image = project(rt, phantom.voxelise(grid, 4), grid, one_cell(pose, 32), (32, 32))
        errors.append(np.linalg.norm(image - exact) / np.linalg.norm(exact))
    assert errors[1] <= tolerance
    assert errors[1] <= 0.65 * errors[0]


def test_cells_of_another_panel_are_refused(rt) -> None:
    """They would be read past their ends."""
    grid, shape = Grid.cube(4, 2.0), (3, 9)
    orbit = CircularOrbit(ConeGeometry(5.0, 7.5, shape, (1.0, 0.5)), ConstantSpeed(0.1, 0.2))
    projector = RayProjector(rt, grid, shape, "rows")
    volume = projector.upload_volume(np.ones(grid.shape, np.float32))
    for shutter in (Shutter(0.5, 0.1, "columns", 1),):
        table = per_line_cells(orbit, shutter, 0, 0.0, shutter.lines(shape), 2)
        with pytest.raises(InputError, match="9 lines along columns"):
            projector.forward(volume, table)
        with pytest.raises(InputError, match="time cells"):
            projector.adjoint(np.ones(shape, np.float32), table, volume)
