"""Projectors from Python: two routes to one number, transposes, gradients, scipy."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.sparse.linalg import lsqr
from tolerances import FINITE_DIFFERENCE_STEP, FLOAT32, GRADIENT

from phyradgs_cl.api import (
    Gaussians,
    MicroViews,
    PerRow,
    Projector,
    as_linear_operator,
    as_torch,
    ray_operator,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import voxelise
from phyradgs_cl.operators.twins.splat import splat_frame

VOXELS = 5e-3  # of the peak: linear between voxels of a quarter σ and less: 0.3 % measured
ADJOINT = 1e-4  # float32 sums in two orders


@pytest.mark.parametrize("which", ["rows", "columns"])
def test_gaussians_and_their_voxels_make_the_same_frames(rt, scan, columns_scan, cloud, which) -> None:
    scan = scan if which == "rows" else columns_scan
    motion, grid = PerRow(sub_intervals=4), Grid.cube(120, 2.4)
    volume = voxelise(rt, cloud.rows(), grid, cutoff_sigma=0.0)
    by_rays = ray_operator(scan, motion, grid=grid, device=rt).forward(volume)
    by_splats = Projector(scan, motion, cutoff_sigma=0.0, device=rt)(cloud)
    assert by_splats.shape == scan.projections.shape
    assert np.abs(by_splats - by_rays).max() <= VOXELS * by_rays.max()


def test_a_projector_is_the_twin_in_millimetres(rt, scan, cloud) -> None:
    projector = Projector(scan, frames=[4, 1], cutoff_sigma=0.0, device=rt)
    frames, motion = projector(cloud), MicroViews()
    expected = np.stack(
        [splat_frame(cloud.rows(), motion.cells(scan, f), scan.geometry.detector_shape) for f in (4, 1)]
    )
    assert np.abs(frames - expected).max() <= FLOAT32 * expected.max()


@pytest.mark.parametrize("which", ["rows", "columns"])
def test_gradients_are_those_of_the_twin(rt, scan, columns_scan, cloud, finite_differences, which) -> None:
    scan = scan if which == "rows" else columns_scan
    shape, frame = scan.geometry.detector_shape, 2
    h = np.random.default_rng(1).normal(size=(1, *shape)).astype(np.float32)
    rows, cells = cloud.rows()[:, :2], MicroViews().cells(scan, frame)
    longer = rows.copy()
    longer[6:10] *= 3.0  # lengths of quaternions mean nothing
    found = Projector(scan, frames=[frame], cutoff_sigma=0.0, device=rt).rows_gradient(longer, h)

    def loss(r: np.ndarray) -> float:
        unit = r.copy()
        unit[6:10] /= np.linalg.norm(unit[6:10], axis=0)
        return float((h[0] * splat_frame(unit, cells, shape)).sum())

    expected = finite_differences(loss, longer, FINITE_DIFFERENCE_STEP)
    for part in (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 11)):
        error = np.linalg.norm(found[part] - expected[part])
        assert error <= GRADIENT * np.linalg.norm(expected[part]), part


@pytest.mark.parametrize("kind", ["rays", "densities"])
def test_linear_operators_keep_scipy_law(rt, scan, cloud, kind) -> None:
    operator = (
        ray_operator(scan, device=rt) if kind == "rays" else Projector(scan, device=rt).of_densities(cloud)
    )
    matrix = as_linear_operator(operator)
    rng = np.random.default_rng(2)
    x, y = rng.random(matrix.shape[1]), rng.random(matrix.shape[0])
    assert matrix.dtype == np.float32 and matrix.shape[0] == scan.projections.size
    forward, back = matrix @ x, matrix.T @ y
    assert forward.shape == (matrix.shape[0],) and back.shape == (matrix.shape[1],)
    assert forward.dtype == np.float32
    assert float(forward @ y) == pytest.approx(float(x @ back), rel=ADJOINT)
    pair = np.stack([x, 2 * x], -1)
    assert np.allclose(matrix @ pair, np.stack([forward, 2 * forward], -1), rtol=1e-5)


def test_scipy_solves_for_densities(rt, scan, cloud) -> None:
    projector = Projector(scan, device=rt)
    frames = projector(cloud)
    solved = lsqr(as_linear_operator(projector.of_densities(cloud)), frames.ravel(), iter_lim=30)[0]
    assert np.allclose(solved, cloud.density, rtol=1e-3)


def test_what_does_not_fit_is_named(rt, scan, cloud, monkeypatch) -> None:
    with pytest.raises(InputError, match="still cells"):
        ray_operator(scan, "exact", device=rt)
    with pytest.raises(InputError, match="expected a RayOperator"):
        as_linear_operator(Projector(scan, device=rt))
    with pytest.raises(InputError, match=r"rows.*\(11, any\)"):
        Projector(scan, device=rt).project_rows(np.zeros((10, 3)))
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="pip install torch"):
        as_torch(ray_operator(scan, device=rt))


def test_an_empty_cloud_makes_empty_frames(rt, scan) -> None:
    nothing = Gaussians(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0))
    assert not Projector(scan, device=rt)(nothing).any()
