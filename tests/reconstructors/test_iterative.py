"""The iterative methods on small systems: their own twins, their limits, their laws."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.sparse.linalg import lsqr
from tolerances import CONVERGED, FLOAT32, ITERATIVE_TWIN, KRYLOV

from phyradgs_cl.acquisition import ConeGeometry, Scan
from phyradgs_cl.api import simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics import psnr
from phyradgs_cl.objective import TvDescent, TvProx
from phyradgs_cl.objective.tv import differences, tv_gradient, tv_prox
from phyradgs_cl.reconstructors import plan_run, reconstruct
from phyradgs_cl.reconstructors.voxels.asd_pocs import AsdPocs, AsdPocsOptions
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.fista_tv import FistaTv, FistaTvOptions
from phyradgs_cl.reconstructors.voxels.sart import OS_SART, Sart, SartOptions, SirtOptions
from phyradgs_cl.reconstructors.voxels.system import System, spread_order
from phyradgs_cl.runtime.algebra import norm

pytestmark = pytest.mark.slow

ITERATIVE = ("sart", "os-sart", "sirt", "cgls", "asd-pocs", "fista", "fista-tv")
VOLUME, FRAMES = (3, 4, 4), (6, 4, 5)


class MatrixOperator:
    """A linear operator with an explicit float64 matrix (rays, voxels)."""

    def __init__(self, matrix: np.ndarray, volume_shape: tuple[int, ...], frame: tuple[int, int]) -> None:
        self.matrix, self.volume_shape = matrix, volume_shape
        self.frames_shape = (matrix.shape[0] // (frame[0] * frame[1]), *frame)

    def forward(self, volume: np.ndarray, out: None = None) -> np.ndarray:
        return (self.matrix @ volume.ravel()).reshape(self.frames_shape)

    def adjoint(self, frames: np.ndarray, out: None = None) -> np.ndarray:
        return (self.matrix.T @ frames.ravel()).reshape(self.volume_shape)

    def subset(self, frames: Sequence[int]) -> "MatrixOperator":
        rows = self.matrix.reshape(self.frames_shape[0], -1, self.matrix.shape[1])[list(frames)]
        return MatrixOperator(rows.reshape(-1, rows.shape[-1]), self.volume_shape, self.frames_shape[1:])


def dense_system(noise: float = 0.0, seed: int = 0) -> tuple[System, np.ndarray, np.ndarray]:
    """A sparse-ish non-negative system of full rank, its matrix and its true volume."""
    rng, rays, voxels = np.random.default_rng(seed), int(np.prod(FRAMES)), int(np.prod(VOLUME))
    matrix = rng.uniform(0, 1, (rays, voxels)) * (rng.uniform(size=(rays, voxels)) < 0.3)
    truth, operator = rng.uniform(0, 1, VOLUME), MatrixOperator(matrix, VOLUME, FRAMES[1:])
    measured = operator.forward(truth) + noise * rng.normal(size=FRAMES)
    return System(operator, measured), matrix, truth


def weights_of(matrix: np.ndarray) -> list[np.ndarray]:
    sums = matrix.sum(1), matrix.sum(0)
    return [np.divide(1, total, out=np.zeros_like(total), where=total > 0) for total in sums]


def stepped(algorithm, times: int):
    """The algorithm after so many steps."""
    for _ in range(times):
        algorithm.step()
    return algorithm


def sart_pass(x: np.ndarray, system: System, groups: list[list[int]], relaxation: float) -> np.ndarray:
    """Float64 twin of one pass, by the definition."""
    for group in groups:
        subset = system.subset(group)
        matrix = subset.operator.matrix
        rows, columns = weights_of(matrix)
        x = x + relaxation * columns * (matrix.T @ (rows * (subset.measured.ravel() - matrix @ x)))
        x = np.maximum(x, 0)
    return x


@pytest.mark.parametrize("options", [
    SartOptions(relaxation=0.8), replace(OS_SART, frames_per_subset=4), SirtOptions(relaxation=1.5),
])  # fmt: skip
def test_sart_and_sirt_are_their_definition(options) -> None:
    """SIRT: all frames in one subset."""
    system, _, _ = dense_system(noise=0.1)
    algorithm = Sart(system, options)
    order, size = spread_order(FRAMES[0]), options.frames_per_subset
    groups = [order[i : i + size] for i in range(0, len(order), size)]
    x, relaxation = np.zeros(int(np.prod(VOLUME))), options.relaxation
    for _ in range(4):
        algorithm.step()
        x = sart_pass(x, system, groups, relaxation)
        relaxation *= options.relaxation_reduction
    np.testing.assert_allclose(algorithm.volume.ravel(), x, rtol=0, atol=ITERATIVE_TWIN)


def test_fista_minimises_squares_weighed_by_light(rt) -> None:
    system, matrix, _ = dense_system(noise=1.0)
    system = system.transmission_weighted()
    algorithm = stepped(FistaTv(system, FistaTvOptions(tv_weight=0.0), TvProx(rt, VOLUME)), 500)
    root = np.sqrt(system.transmission.ravel())
    expected, _ = nnls(root[:, None] * matrix, root * system.measured.ravel())
    plain, _ = nnls(matrix, system.measured.ravel())
    assert norm(algorithm.volume.ravel() - expected) < 0.1 * norm(plain - expected)


def test_asd_pocs_follows_the_published_steps(rt) -> None:
    """TIGRE's loop in float64: a pass, its length, TV steps of a fixed length and their reduction. It ends when
    data and TV pull against each other."""
    system, matrix, _ = dense_system(noise=0.2)
    options = AsdPocsOptions(tv_share=0.01, tv_steps=5, tv_ratio=0.2, relaxation_reduction=0.9)
    epsilon = 0.1
    algorithm = AsdPocs(system, options, TvDescent(rt, VOLUME), epsilon)
    groups = [[f] for f in spread_order(FRAMES[0])]
    x, step, relaxation, reductions = np.zeros(matrix.shape[1]), None, 1.0, 0
    for _ in range(4):
        algorithm.step()
        before, x = x, sart_pass(x, system, groups, relaxation)
        moved = np.linalg.norm(x - before)
        residual = np.linalg.norm(system.measured.ravel() - matrix @ x)
        step = options.tv_share * moved if step is None else step
        start = x
        for _ in range(options.tv_steps):
            gradient = tv_gradient(x.reshape(VOLUME)).ravel()
            x = x - step * gradient / np.linalg.norm(gradient)
        if np.linalg.norm(x - start) > options.tv_ratio * moved and residual > epsilon:
            step, reductions = step * options.tv_reduction, reductions + 1
        relaxation *= options.relaxation_reduction
    assert 0 < reductions < 5
    assert algorithm.tv_step == pytest.approx(step, rel=1e-4)
    np.testing.assert_allclose(algorithm.volume.ravel(), x, rtol=0, atol=ITERATIVE_TWIN)
    algorithm = AsdPocs(system, AsdPocsOptions(tv_share=0.002, tv_steps=3), TvDescent(rt, VOLUME), epsilon=1e9)
    assert any(stepped(algorithm, 1).finished for _ in range(200))


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_cgls_reaches_lsqr(noise) -> None:
    system, matrix, _ = dense_system(noise)
    algorithm = stepped(Cgls(system), 2 * matrix.shape[1])
    expected = lsqr(matrix, system.measured.ravel(), atol=1e-12, btol=1e-12, iter_lim=1000)[0]
    assert norm(algorithm.volume.ravel() - expected) <= KRYLOV * norm(expected)
    algorithm = Cgls(replace(system, measured=np.zeros(FRAMES)))
    assert algorithm.step() == 0 and algorithm.finished == "exact solution" and not algorithm.volume.any()


def test_fista_reaches_the_minimum_of_its_objective(rt) -> None:
    system, matrix, _ = dense_system(noise=0.5)
    options = FistaTvOptions(tv_weight=0.003, tv_iterations=20)
    algorithm = stepped(FistaTv(system, options, TvProx(rt, VOLUME)), 100)
    weight = options.tv_weight * np.abs(matrix.T @ system.measured.ravel()).max()
    assert algorithm.tv_weight == pytest.approx(weight, rel=FLOAT32)

    def total_variation(x: np.ndarray) -> float:
        return float(np.linalg.norm(differences(x, (1.0, 1.0, 1.0)), axis=0).sum())

    def objective(x: np.ndarray) -> float:
        rest = system.measured.ravel() - matrix @ x.ravel()
        return 0.5 * float(rest @ rest) + weight * total_variation(x)

    # plain proximal gradients in float64, with the exact norm and long inner solutions
    curvature, x = np.linalg.norm(matrix, 2) ** 2, np.zeros(VOLUME)
    for _ in range(150):
        gradient = (matrix.T @ (matrix @ x.ravel() - system.measured.ravel())).reshape(VOLUME)
        x = tv_prox(x - gradient / curvature, weight / curvature, 30, nonnegative=True)
    assert total_variation(x) > 0
    assert objective(algorithm.volume) == pytest.approx(objective(x), rel=CONVERGED)
    assert objective(x) < 0.9 * objective(np.full(VOLUME, x.mean()))


def test_frames_next_to_each_other_in_a_pass_are_far_apart() -> None:
    for count in (1, 2, 3, 4, 6, 25, 50, 90):
        order = spread_order(count)
        assert sorted(order) == list(range(count))
        if count >= 25:
            steps = np.abs(np.diff(order))
            assert np.minimum(steps, count - steps).min() > count / 4


@pytest.fixture(scope="module")
def fly_scan(rt) -> Scan:
    """A small noisy fly-scan whose motion matters: 12 frames of 30° over a whole turn."""
    noise = {"noise": "beer", "dose": 1e5, "peak": 3.0}
    return simulate("jaw", size=16, detector=24, views=12, exposure_deg=30.0, **noise, device=rt)


def run(rt, scan: Scan, method: str, **changes: object):
    return reconstruct(scan, plan_run(method, {"iterations": 8, **changes}), rt)


@pytest.mark.parametrize("method", ITERATIVE)
def test_record_and_facts_and_an_interrupted_run_goes_on_with_the_same_bits(rt, fly_scan, method) -> None:
    changes: dict[str, object] = {"iterations": 6, "motion": "micro-views", "strips": 2, "sub_intervals": 2}
    changes["detector_model"] = "intensity"
    changes |= {"noise_stop": 0} if method == "cgls" else {}
    plan, seen = plan_run(method, changes, seed=3), []

    def stop(progress) -> None:
        if progress.iteration == 3:
            raise KeyboardInterrupt

    whole = reconstruct(fly_scan, plan, rt, report=seen.append)
    assert whole.volume.shape == fly_scan.grid.shape and whole.state is None
    assert [line["iteration"] for line in whole.record] == [1, 2, 3, 4, 5, 6]
    assert [p.loss for p in seen] == [line["residual"] for line in whole.record]
    assert all(line["residual"] > 0 and line["change"] > 0 for line in whole.record)
    assert (whole.facts["method"], whole.facts["stopped_by"]) == (method, "iterations")
    part = reconstruct(fly_scan, plan, rt, report=stop)
    assert (part.facts["interrupted_at"], part.facts["stopped_by"]) == (3, "interrupt")
    rest = reconstruct(fly_scan, plan, rt, resume=part.state)
    np.testing.assert_array_equal(rest.volume, whole.volume)
    assert [line["iteration"] for line in rest.record] == [1, 2, 3, 4, 5, 6]
    assert rest.record[:3] == part.record
    assert rest.facts["seconds"] > part.facts["seconds"]
    with pytest.raises(InputError, match="checkpoint"):
        reconstruct(fly_scan, plan, rt, resume={"iteration": np.array(3)})


@pytest.mark.parametrize("method", ["cgls", "sart"])
def test_runs_end_before_they_fit_the_noise(rt, fly_scan, method) -> None:
    peak, noise = float(fly_scan.reference.max()), np.random.default_rng(0).standard_normal(fly_scan.projections.shape)
    scan = replace(fly_scan, projections=fly_scan.projections + 0.15 * noise.astype(np.float32))
    usual = {"motion": "per-row", "iterations": 60}
    stopped, whole = (run(rt, scan, method, **usual, noise_stop=factor) for factor in (1.1, 0.0))
    assert stopped.facts["stopped_by"] == "residual as small as the noise"
    residuals, last = [line["residual"] for line in whole.record], stopped.facts["iterations"] - 1
    assert len(residuals) == 60 and residuals[last] < min(residuals[:last])
    assert psnr(stopped.volume, fly_scan.reference, peak) > psnr(whole.volume, fly_scan.reference, peak) + 1
    ended = run(rt, fly_scan, method, iterations=60, tolerance=0.1)
    assert ended.facts["stopped_by"] == "tolerance" and ended.record[-1]["change"] < 0.1 <= ended.record[-2]["change"]


@pytest.mark.parametrize("method", ITERATIVE)
def test_masked_pixels_do_not_count(rt, fly_scan, masked, method) -> None:
    mask = np.zeros(fly_scan.projections.shape[1:], np.uint8)
    mask[5:9, 11] = 1
    mask[17] = 1
    one, two = (run(rt, spoilt, method, iterations=3) for spoilt in masked(fly_scan, mask))
    np.testing.assert_array_equal(one.volume, two.volume)


@pytest.mark.parametrize("method", ITERATIVE)
def test_units_do_not_matter(rt, fly_scan, method) -> None:
    """Lengths × 8 and attenuation ÷ 8 give the same picture; so do counts × 2 in the volume × 2."""
    geometry = ConeGeometry(40.0, 56.0, (24, 24), (32 / 24, 32 / 24))
    trajectory = replace(fly_scan.trajectory, geometry=geometry)
    larger = replace(fly_scan, geometry=geometry, trajectory=trajectory, grid=fly_scan.grid.scaled(8.0))
    doubled = replace(fly_scan, projections=2 * fly_scan.projections)
    volume, of_larger, of_doubled = (run(rt, scan, method, iterations=3).volume for scan in (fly_scan, larger, doubled))
    scale = np.abs(volume).max()
    assert np.abs(8 * of_larger - volume).max() <= 1e-3 * scale
    assert np.abs(of_doubled / 2 - volume).max() <= 1e-3 * scale
