"""Joseph's projector and its adjoint: float64 twin, ⟨Ax, y⟩ = ⟨x, Aᵀy⟩, splats of the same field, closed forms."""

import numpy as np
import pytest
from ray_tables import SHAPE, noise
from tolerances import (
    DISCRETISATION_ELLIPSOID,
    DISCRETISATION_GAUSSIANS,
    DISCRETISATION_ORDER,
    DISCRETISATION_SHEPP_LOGAN,
    FLOAT64,
)

from phyradgs_cl.acquisition import pixel_centres
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator, voxelise
from phyradgs_cl.operators.twins.rays import joseph_adjoint, joseph_image
from phyradgs_cl.operators.twins.splat import splat_image
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom, rotation_about_z, shepp_logan

GRID = Grid((9, 14, 11), (0.21, 0.13, 0.16), (0.1, -0.05, 0.2))


def project(rt, volume: np.ndarray, grid: Grid, table: TimeCells, shape: tuple[int, int]) -> np.ndarray:
    return RayOperator(rt, grid, shape, [table]).forward(volume)[0]


def test_twins_are_adjoint(make_geometry) -> None:
    x, y, pose = noise(GRID.shape, 61), noise(SHAPE, 62), make_geometry(*SHAPE).pose(0.7)
    forward = (joseph_image(x, GRID, pose, SHAPE) * y).sum()
    assert abs((joseph_adjoint(y, GRID, pose) * x).sum() - forward) <= FLOAT64 * forward


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
