"""Operators from Python: two routes to one number, transposes, gradients, scipy, arrays of the device, users' loops."""

import gc
import sys
from types import SimpleNamespace

import numpy as np
import pyopencl
import pyopencl.array
import pytest
from scipy.sparse.linalg import LinearOperator as ScipyOperator
from tolerances import FLOAT32

from phyradgs_cl import api
from phyradgs_cl.api import LinearOperator, MicroViews, Operator, ray_operator, splat_operator, voxelise
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import SplatProjector
from phyradgs_cl.operators.twins.splat import splat_frame
from phyradgs_cl.runtime import Runtime

pytestmark = pytest.mark.slow
VOXELS = 5e-3  # of the peak: linear between voxels of a quarter σ and less: 0.3 % measured
ADJOINT = 1e-4  # float32 sums in two orders


@pytest.fixture(params=["rays", "ray intensity", "splats", "splat intensity", "voxels", "densities"])
def operator_and_x(rt, scan, cloud, request) -> tuple[Operator, np.ndarray]:
    """Every kind of operator with a point of its domain."""
    volume = np.random.default_rng(0).random(scan.grid.shape).astype(np.float32)
    rows, kind = cloud.rows().astype(np.float32), request.param
    if "ray" in kind:
        rays = ray_operator(scan, api.PerRow(2), device=rt)
        return (rays.intensity if "intensity" in kind else rays), volume
    if kind == "voxels":
        return api.voxel_operator(scan.grid, cutoff_sigma=0, device=rt), rows
    splats = splat_operator(scan, MicroViews(2, 2), cutoff_sigma=0, device=rt)  # differentiable
    if kind == "densities":
        return splats.of_densities(cloud), rows[10]
    return (splats.intensity if "intensity" in kind else splats), rows


def test_the_transpose_is_that_of_the_derivative(operator_and_x) -> None:
    operator, x = operator_and_x
    rng = np.random.default_rng(1)
    direction, step = rng.normal(size=x.shape).astype(np.float32) * (np.abs(x) + 0.05), 2e-3
    y = operator(x)
    h = rng.random(y.shape).astype(np.float32)
    back = operator.derivative(x).T(h)
    assert y.dtype == back.dtype == np.float32 and back.shape == x.shape and y.shape == operator.range_shape
    if isinstance(operator, LinearOperator):
        assert operator.T.domain_shape == operator.range_shape and operator.T.range_shape == operator.domain_shape
        assert np.array_equal(operator.T(h), back)
    up, down = operator(x + step * direction), operator(x - step * direction)
    expected = float(((up.astype(float) - down) * h).sum()) / (2 * step)
    assert float((back.astype(float) * direction).sum()) == pytest.approx(expected, rel=2e-3)
    _, pull = operator.vjp(x)
    operator(2 * x)
    assert np.array_equal(pull(h), back), "vjp is of its own x, whatever comes between"


def test_arrays_of_the_device_stay_there(operator_and_x, monkeypatch) -> None:
    operator, x = operator_and_x
    y, pull = operator.vjp(x)
    there, h = operator.to_device(x), operator.to_device(y)
    operator(there)  # tables of the device's own go up once
    for name in ("upload", "write", "download"):
        monkeypatch.setattr(Runtime, name, lambda *_, name=name: pytest.fail(f"{name} within a call"))
    y_there, back_there = operator(there), operator.derivative(there).T(h)
    monkeypatch.undo()
    assert isinstance(y_there, pyopencl.array.Array) and isinstance(back_there, pyopencl.array.Array)
    assert np.allclose(y_there.get(), y, rtol=FLOAT32, atol=FLOAT32 * y.max())
    assert np.allclose(back_there.get(), pull(y), rtol=1e-4, atol=1e-4 * np.abs(pull(y)).max())


def test_frames_are_rows_of_the_whole(operator_and_x) -> None:
    operator, x = operator_and_x
    if len(operator.range_shape) != 3 or operator.range_shape == (12, 12, 12):
        with pytest.raises(InputError, match="frames"):
            operator.frames([0])
        return
    some = operator.frames([3, 1])
    assert np.array_equal(some(x), operator(x)[[3, 1]]) and some.range_shape[0] == 2
    h = np.random.default_rng(2).random(some.range_shape).astype(np.float32)
    whole = np.zeros(operator.range_shape, np.float32)
    whole[[3, 1]] = h
    expected = operator.derivative(x).T(whole)
    assert np.allclose(some.derivative(x).T(h), expected, rtol=ADJOINT, atol=ADJOINT * np.abs(expected).max())


@pytest.mark.parametrize("which", ["rows", "columns"])
def test_gaussians_and_their_voxels_make_the_same_frames(rt, cloud, which) -> None:
    """Of a panel as fine as the voxels: rays and splats are both at the pixels' centres."""
    how = {"exposure_deg": 30.0, "readout_axis": which, "time_samples": 1, "device": rt}
    scan = api.simulate("jaw", size=8, detector=128, views=2, **how)
    motion, grid = api.OwnTimes(sub_intervals=4), Grid.cube(120, 2.4)
    volume, rays = voxelise(cloud, grid, cutoff_sigma=0.0, device=rt), ray_operator(scan, motion, grid=grid, device=rt)
    splats = splat_operator(scan, motion, cutoff_sigma=0.0, device=rt)
    for by_rays, by_splats in ((rays(volume), splats(cloud)), (rays.intensity(volume), splats.intensity(cloud))):
        assert by_splats.shape == scan.projections.shape and np.abs(by_splats - by_rays).max() <= VOXELS * by_rays.max()


def test_splats_are_the_twin_in_millimetres(rt, scan, cloud) -> None:
    motion, shape = MicroViews(), scan.geometry.detector_shape
    frames = splat_operator(scan, motion, cutoff_sigma=0.0, device=rt).frames([4, 1])(cloud)
    expected = np.stack([splat_frame(cloud.rows(), motion.cells(scan, f), shape) for f in (4, 1)])
    assert np.abs(frames - expected).max() <= FLOAT32 * expected.max()


def test_a_gradient_renders_nothing_again(rt, scan, cloud, monkeypatch) -> None:
    calls: list[str] = []
    for name in ("draw", "prepare"):
        whole = getattr(SplatProjector, name)
        monkeypatch.setattr(SplatProjector, name, lambda *a, whole=whole, name=name: (calls.append(name), whole(*a))[1])
    splats = splat_operator(scan, device=rt)
    for operator, prepared in ((splats.frames([2]), 0), (splats.frames([0, 3]), 2), (splats.intensity.frames([1]), 0)):
        misfit, pull = operator.vjp(cloud)
        calls.clear()
        once = pull(misfit)
        assert calls == ["prepare"] * prepared
        assert np.array_equal(pull(misfit), once)  # whose sums overwrite the prepared values


@pytest.mark.parametrize("kind", ["rays", "densities"])
def test_linear_operators_keep_scipys_law(rt, scan, cloud, kind) -> None:
    matrix = ray_operator(scan, device=rt) if kind == "rays" else splat_operator(scan, device=rt).of_densities(cloud)
    rng = np.random.default_rng(2)
    x, y = rng.random(matrix.shape[1]), rng.random(matrix.shape[0])
    assert isinstance(matrix, ScipyOperator) and matrix.dtype == np.float32 and matrix.shape[0] == scan.projections.size
    forward, back = matrix @ x, matrix.T @ y
    assert forward.shape == (matrix.shape[0],) and back.shape == (matrix.shape[1],)
    assert forward.dtype == np.float32 and np.array_equal(back, matrix.H @ y)
    assert float(forward @ y) == pytest.approx(float(x @ back), rel=ADJOINT)
    assert np.allclose(matrix @ np.stack([x, 2 * x], -1), np.stack([forward, 2 * forward], -1), rtol=1e-5)
    assert np.allclose((matrix.T @ matrix) @ x, matrix.T @ forward, rtol=1e-5)


def test_arrays_of_others_come_by_dlpack_without_a_copy(rt, scan, monkeypatch) -> None:
    """And where PyTorch is missing, its installation is named."""
    operator = ray_operator(scan, device=rt)
    volume = np.random.default_rng(0).random(scan.grid.shape).astype(np.float32)
    foreign = SimpleNamespace(__dlpack__=volume.__dlpack__, __dlpack_device__=volume.__dlpack_device__)
    (expected, seen), entered = (operator(volume), []), np.from_dlpack
    monkeypatch.setattr(np, "from_dlpack", lambda values: seen.append(entered(values)) or seen[-1])
    assert np.array_equal(operator(foreign), expected) and len(seen) == 1 and np.shares_memory(seen[0], volume)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="pip install 'torch'"):
        api.as_torch(operator)


def test_arrays_of_the_device_may_be_parts_and_are_counted(rt, scan) -> None:
    operator = ray_operator(scan, device=rt)
    volumes = operator.to_device(np.random.default_rng(0).random((2, *scan.grid.shape)))
    assert np.array_equal(operator(volumes[1]).get(), operator(volumes.get()[1]))
    gc.collect()
    before, frames = rt.ledger.held_bytes, operator(volumes[0])
    assert rt.ledger.held_bytes == before + frames.nbytes
    del frames
    gc.collect()
    assert rt.ledger.held_bytes == before
