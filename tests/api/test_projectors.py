"""Operators from Python: two routes to one number, transposes, gradients, scipy, arrays of the device, users' loops."""

import gc
import importlib.util
import runpy
import sys
from pathlib import Path
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
    assert y.dtype == back.dtype == np.float32 and back.shape == x.shape
    assert y.shape == operator.range_shape
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
    y_there = operator(there)
    back_there = operator.derivative(there).T(h)
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
    scan = api.simulate("jaw", size=8, detector=128, views=3, **how)
    motion, grid = api.OwnTimes(sub_intervals=4), Grid.cube(120, 2.4)
    volume = voxelise(cloud, grid, cutoff_sigma=0.0, device=rt)
    rays = ray_operator(scan, motion, grid=grid, device=rt)
    splats = splat_operator(scan, motion, cutoff_sigma=0.0, device=rt)
    for by_rays, by_splats in ((rays(volume), splats(cloud)), (rays.intensity(volume), splats.intensity(cloud))):
        assert by_splats.shape == scan.projections.shape
        assert np.abs(by_splats - by_rays).max() <= VOXELS * by_rays.max()


def test_splats_are_the_twin_in_millimetres(rt, scan, cloud) -> None:
    motion = MicroViews()
    frames = splat_operator(scan, motion, cutoff_sigma=0.0, device=rt).frames([4, 1])(cloud)
    shape = scan.geometry.detector_shape
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
    splats = splat_operator(scan, device=rt)
    matrix = ray_operator(scan, device=rt) if kind == "rays" else splats.of_densities(cloud)
    rng = np.random.default_rng(2)
    x, y = rng.random(matrix.shape[1]), rng.random(matrix.shape[0])
    assert isinstance(matrix, ScipyOperator) and matrix.dtype == np.float32
    assert matrix.shape[0] == scan.projections.size
    forward, back = matrix @ x, matrix.T @ y
    assert forward.shape == (matrix.shape[0],) and back.shape == (matrix.shape[1],)
    assert forward.dtype == np.float32 and np.array_equal(back, matrix.H @ y)
    assert float(forward @ y) == pytest.approx(float(x @ back), rel=ADJOINT)
    pair = np.stack([x, 2 * x], -1)
    assert np.allclose(matrix @ pair, np.stack([forward, 2 * forward], -1), rtol=1e-5)
    assert np.allclose((matrix.T @ matrix) @ x, matrix.T @ forward, rtol=1e-5)


def test_arrays_of_others_come_by_dlpack_without_a_copy(rt, scan, monkeypatch) -> None:
    operator = ray_operator(scan, device=rt)
    volume = np.random.default_rng(0).random(scan.grid.shape).astype(np.float32)
    foreign = SimpleNamespace(__dlpack__=volume.__dlpack__, __dlpack_device__=volume.__dlpack_device__)
    expected, seen = operator(volume), []
    entered = np.from_dlpack

    def noted(values: object) -> np.ndarray:
        seen.append(entered(values))
        return seen[-1]

    monkeypatch.setattr(np, "from_dlpack", noted)
    assert np.array_equal(operator(foreign), expected)
    assert len(seen) == 1 and np.shares_memory(seen[0], volume)


def test_arrays_of_the_device_may_be_parts_and_are_counted(rt, scan) -> None:
    operator = ray_operator(scan, device=rt)
    volumes = operator.to_device(np.random.default_rng(0).random((2, *scan.grid.shape)))
    assert np.array_equal(operator(volumes[1]).get(), operator(volumes.get()[1]))
    gc.collect()
    before = rt.ledger.held_bytes
    frames = operator(volumes[0])
    assert rt.ledger.held_bytes == before + frames.nbytes
    del frames
    gc.collect()
    assert rt.ledger.held_bytes == before


def test_without_pytorch_its_installation_is_named(rt, scan, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="pip install 'torch'"):
        api.as_torch(ray_operator(scan, device=rt))


EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def bus(monkeypatch) -> list[int]:
    """Bytes that anybody copies between arrays of the host and the device, pyopencl's own included."""
    copied: list[int] = []
    whole = pyopencl.enqueue_copy

    def noted(queue: object, target: object, source: object, **options: object) -> object:
        copied.extend(array.nbytes for array in (target, source) if isinstance(array, np.ndarray))
        return whole(queue, target, source, **options)

    monkeypatch.setattr(pyopencl, "enqueue_copy", noted)
    return copied


@pytest.mark.parametrize("kind", ["rays", "ray intensity", "splats", "splat intensity"])
def test_a_loop_over_arrays_of_the_device_moves_scalars_alone(rt: Runtime, scan: api.Scan, cloud, bus, kind) -> None:
    of, detector = ray_operator if "ray" in kind else splat_operator, kind.partition(" ")[2]
    operator = getattr(of(scan, device=rt), detector) if detector else of(scan, device=rt)
    truth = scan.reference if "ray" in kind else cloud.rows()
    x, measured = operator.to_device(0.9 * truth), operator(operator.to_device(truth))
    y, pull = operator.vjp(x)
    step = 0.01 * float(np.abs(truth).max() / np.abs(pull(y - measured).get()).max())
    views = [(operator.frames([f]), measured[f : f + 1]) for f in range(scan.frames)]

    def one_pass() -> float:
        nonlocal x
        loss = 0.0
        for view, seen in views:
            y, pull = view.vjp(x)
            misfit = y - seen
            loss += float(pyopencl.array.dot(misfit, misfit).get())
            x -= step * pull(misfit)
        return loss

    first = one_pass()  # tables of the device's own go up once
    up, moved = rt.traffic.bytes_up, len(bus)
    assert one_pass() < first
    assert rt.traffic.bytes_up == up
    assert set(bus[moved:]) == {4} and len(bus) - moved <= 2 * len(views), "losses, and how long a list of splats is"


@pytest.mark.parametrize("example", ["own_sirt", "train_own"])
def test_an_example_comes_near_the_method(rt, scan, tmp_path, monkeypatch, capsys, example) -> None:
    if example == "train_own" and not importlib.util.find_spec("torch"):
        return
    monkeypatch.chdir(tmp_path)
    api.save_scan("scan.h5", scan)
    monkeypatch.setattr(sys, "argv", ["", "scan.h5", "30"])
    runpy.run_path(str(EXAMPLES / f"{example}.py"), run_name="__main__")
    volume = api.load_volume(f"{example}.h5").volume
    found = api.compare(volume, scan.reference)["psnr_db"]
    assert f"PSNR {found:.2f} dB" in capsys.readouterr().out
    method = {"own_sirt": "sirt", "train_own": "phyradgs"}[example]
    like = api.reconstruct(scan, method, iterations=30, device=rt).volume  # and sets negative voxels to 0
    assert found > api.compare(like, scan.reference)["psnr_db"] - 3
