"""FISTA with priors over subsets, voxels and splats together, and first volumes."""

from dataclasses import replace

import numpy as np
import pytest
from memory_limits import room_for
from tolerances import RAYS

from phyradgs_cl.acquisition import ParallelGeometry, PerRow, Scan
from phyradgs_cl.api import simulate, static_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import psnr
from phyradgs_cl.reconstructors import METHODS, InitialVolume, plan_run, reconstruct
from phyradgs_cl.reconstructors.voxels import priors
from phyradgs_cl.reconstructors.voxels.fista import Fista, FistaOptions, fista
from phyradgs_cl.reconstructors.voxels.priors import FrameError, OwnPrior, Prior, PriorWeight, kind_of
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import DeviceSpace

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    return simulate("jaw", size=24, detector=32, views=20, exposure_deg=18.0, noise="tigre", device=rt)


@pytest.fixture(scope="module")
def system(rt, scan) -> System:
    return System.of_scan(rt, scan, PerRow())


def run(rt, scan: Scan, method: str, initial: InitialVolume | None = None, **changes: object):
    return reconstruct(scan, plan_run(method, {"iterations": 12, **changes}, initial=initial), rt)


def quality(scan: Scan, volume: np.ndarray) -> float:
    return psnr(volume, scan.reference, float(scan.reference.max()))


def maps(prior: Prior, rt, shape: tuple[int, int, int], count: int = 1) -> list[np.ndarray]:
    """What a prior makes of one volume at each of so many calls."""
    volume, space = np.random.default_rng(0).uniform(size=shape).astype(np.float32), DeviceSpace(rt)
    return [space.numpy(prior(space, space.array(volume), 0.01, nonnegative=True)) for _ in range(count)]


def test_each_prior_is_better_than_none_and_subsets_are_quicker(rt, scan) -> None:
    names = ("none", "tv", "dct", "ridge")
    runs = (run(rt, scan, "fista", motion="per-row", iterations=8, prior=prior) for prior in names)
    without, *found = (quality(scan, one.volume) for one in runs)
    assert min(found) > without + 0.5, (found, without)
    few, whole = (run(rt, scan, "fista", iterations=3, subsets=count).record[-1]["residual"] for count in (4, 1))
    assert few < 0.8 * whole


def test_subsets_that_pull_apart_at_once_or_slowly_are_joined(rt, scan, system) -> None:
    """One frame a subset, with momentum, diverges; joined it ends near the whole scan's residual. The others' residual grows
    by less than a fifth from pass to pass: if none were joined, or those of a jump alone, the last would be more than twice
    the least."""
    prior = kind_of("tv").make(priors.PriorInputs(rt, scan.grid, 5))
    algorithm = Fista(system, prior, PriorWeight(system, FrameError(0.01), 0.42), subsets=1000, nonnegative=True)
    assert len(algorithm.subsets) == scan.frames
    residuals = [algorithm.step() for _ in range(12)]
    assert 1 <= len(algorithm.subsets) <= scan.frames // 2
    assert residuals[-1] < residuals[0]
    slow = simulate("jaw", device=rt, size=24, detector=36, views=90, exposure_deg=4.0, peak=3.0, noise="tigre")
    residuals = [line["residual"] for line in run(rt, slow, "fista", motion="per-row", iterations=20, subsets=22).record]
    assert residuals[-1] < 1.5 * min(residuals)


def test_pogm_is_as_published_needs_fewer_passes_and_resumes(scan, system) -> None:
    """Without a prior, five steps are those of Kim and Fessler (2018), written out with NumPy; w₀ = z₀ = x₀ = 0."""

    def method(optimised: int) -> Fista:
        weight = PriorWeight(system, FrameError(0.01), 0.0)
        return Fista(system, Prior(), weight, subsets=1, nonnegative=False, optimised=optimised)

    fista, pogm, resumed = method(0), method(12), method(12)
    x = w = z = np.zeros(scan.grid.shape)
    theta = gamma = 1.0
    for _ in range(5):
        pogm.step()
        theta_new = (1 + np.sqrt(1 + 4 * theta**2)) / 2
        w_new = x + system.adjoint(system.measured - system.forward(x.astype(np.float32))).astype(float) / pogm.curvature
        z_new = w_new + (theta - 1) / theta_new * (w_new - w) + theta / theta_new * (w_new - x)
        z = z_new + (theta - 1) / (gamma * theta_new) * (z - x)
        gamma, theta, w, x = (2 * theta + theta_new - 1) / theta_new, theta_new, w_new, z
    np.testing.assert_allclose(pogm.volume, x, atol=1e-4 * np.abs(x).max())
    resumed.restore(pogm.state())
    for one in (pogm, resumed):
        last = [one.step() for _ in range(7)][-1]
    np.testing.assert_array_equal(pogm.volume, resumed.volume)
    assert last < 0.95 * [fista.step() for _ in range(12)][-1]


def test_a_prior_image_helps_where_it_is_right_and_costs_little_where_it_is_wrong(rt, scan) -> None:
    """The truth but for a part that has changed since, from a third of the views; then an object that is another."""
    few = replace(scan, projections=scan.projections[::3], frame_start_s=scan.frame_start_s[::3])
    changed = scan.reference.copy()
    changed[8:14, 4:10, 8:14] = 0
    usual = {"motion": "per-row", "iterations": 8}
    plain = quality(few, run(rt, few, "fista", prior="tv", **usual).volume)
    images = InitialVolume(changed, few.grid), InitialVolume(scan.reference[:, ::-1].copy(), few.grid)
    pairs = zip(images, (0.5, 0.3), strict=True)
    runs = (run(rt, few, "fista", image, prior="piccs", prior_share=share, **usual) for image, share in pairs)
    right, wrong = (quality(few, one.volume) for one in runs)
    assert right > max(plain, quality(few, changed)) + 1 and wrong > plain - 1


def test_the_ridge_step_follows_the_noise_in_the_weight_and_no_edges(scan, system) -> None:
    sigmas: list[float] = []

    def ridge(volume: np.ndarray, *, sigma: float, **_: object) -> np.ndarray:
        sigmas.append(sigma)
        return volume

    ridge.shape = scan.grid.shape
    errors = FrameError(0.01), FrameError(0.01, 0.02), FrameError(0.03)
    weights = [PriorWeight(system, error, 0.42) for error in errors]
    for weight in weights:
        algorithm = Fista(system, priors.ThenRidge(Prior(), ridge, 17.0), weight, subsets=1, nonnegative=True)
        for _ in range(4):  # maps before a step
            algorithm.step()
    assert weights[1].noise_share(weights[1].at(algorithm.volume)) < 0.9
    assert sigmas[1] == pytest.approx(sigmas[0], rel=1e-6) and sigmas[2] == pytest.approx(3 * sigmas[0], rel=1e-6)


@pytest.mark.parametrize(("subsets", "shares"), [(5, [3, 2]), (6, [3, 3]), (1, [1])])
def test_a_map_of_a_prior_of_ones_own_stands_for_several_steps_in_sparing_passes(system, subsets, shares) -> None:
    """A pass has the weight of all of its steps, and ends with a map. The next pass has all maps."""
    seen: list[float] = []

    def half(volume: np.ndarray, noise: float) -> np.ndarray:
        seen.append(noise)
        return volume / 2

    weight = PriorWeight(system, FrameError(0.01), 0.42)
    usual = {"subsets": subsets, "nonnegative": True, "sparing": 1}
    algorithm, plain = (Fista(system, prior, weight, **usual) for prior in (OwnPrior(half), Prior()))
    least = weight.at(algorithm.volume) / algorithm.curvature
    algorithm.step()
    np.testing.assert_allclose(seen, [share * least for share in shares], rtol=1e-6)
    if subsets == 1:
        plain.step()
        np.testing.assert_allclose(algorithm.volume, plain.volume / 2, rtol=1e-6)
    algorithm.step()
    assert len(seen) == len(shares) + subsets


@pytest.mark.parametrize("method", [name for name, one in METHODS.items() if one.takes_initial])
def test_a_first_volume_is_where_the_run_starts(rt, scan, method) -> None:
    """From the truth a few iterations are nearer to it than from nothing, on another grid too; FDK starts from none."""
    few, gain_db = (40, 0.1) if method in ("phyradgs", "r2") else (2, 1)
    starts = None, InitialVolume(scan.reference, scan.grid)
    begun, from_truth = (quality(scan, run(rt, scan, method, start, iterations=few).volume) for start in starts)
    assert from_truth > begun + gain_db


@pytest.mark.parametrize(("at", "prior"), [(1, "dct"), (5, "ridge"), (2, "tv")])
def test_fista_goes_on_with_the_same_bits_from_either_grid(rt, scan, at, prior) -> None:
    plan = plan_run("fista", {"iterations": 7, "subvoxels": 2, "prior": prior})

    def stop(progress) -> None:
        assert progress.iterations == 7
        if progress.iteration >= at:
            raise KeyboardInterrupt

    whole, part = reconstruct(scan, plan, rt), reconstruct(scan, plan, rt, report=stop)
    assert part.facts["interrupted_at"] == at and part.volume.shape == scan.grid.shape
    rest = reconstruct(scan, plan, rt, resume=part.state)
    np.testing.assert_array_equal(rest.volume, whole.volume)
    assert [line["iteration"] for line in rest.record] == [line["iteration"] for line in whole.record] == list(range(1, 8))


@pytest.mark.parametrize(("gains", "at"), [(True, 1), (True, 5), (False, 1), (False, 5)])
def test_a_resumed_run_keeps_its_stages_on_a_device_with_another_room(rt, scan, gains, at, monkeypatch) -> None:
    plan, name = plan_run("fista", {"iterations": 7}), "phyradgs_cl.reconstructors.voxels.fista._gains_from_subvoxels"

    def stop(progress) -> None:
        if progress.iteration >= at:
            raise KeyboardInterrupt

    monkeypatch.setattr(name, lambda run, parts: gains)
    whole, part = reconstruct(scan, plan, rt), reconstruct(scan, plan, rt, report=stop)
    monkeypatch.setattr(name, lambda run, parts: not gains)
    assert list(whole.facts["stages"]) != list(reconstruct(scan, plan, rt).facts["stages"])
    np.testing.assert_array_equal(reconstruct(scan, plan, rt, resume=part.state).volume, whole.volume)


def test_a_ridge_step_follows_every_fourth_map_unless_a_volume_is_too_thin_and_resumes_between_them(rt, scan) -> None:
    first, resumed, other = (kind_of("ridge").make(priors.PriorInputs(rt, scan.grid, 5)) for _ in range(3))
    pairs = zip(*(maps(prior, rt, scan.grid.shape, 4) for prior in (first, other.before)), strict=True)
    assert [np.array_equal(*pair) for pair in pairs] == [True] * 3 + [False]
    maps(first, rt, scan.grid.shape, 2)
    resumed.restore(first.state())
    np.testing.assert_array_equal(*(maps(prior, rt, scan.grid.shape, 3) for prior in (first, resumed)))
    inputs = priors.PriorInputs(rt, Grid((4, 12, 12), (0.1, 0.1, 0.1)), 5)
    np.testing.assert_array_equal(*(maps(kind_of(name).make(inputs), rt, (4, 12, 12), 4) for name in ("dct", "ridge")))
    share = priors.subvoxel_share
    assert share("ridge", (4, 12, 12)) == share("dct", (12, 12, 12)) < share("ridge", (5, 12, 12))


def test_ridge_follows_the_maps_of_dct_on_a_fly_scan_and_less_total_variation_at_rest(rt, scan) -> None:
    inputs = priors.PriorInputs(rt, scan.grid, 5)
    three = kind_of("dct").make(inputs), kind_of("ridge").make(replace(inputs, is_fly=True)), kind_of("ridge").make(inputs)
    dct, fly, still = (maps(prior, rt, scan.grid.shape)[0] for prior in three)
    np.testing.assert_array_equal(dct, fly)
    assert still.std() > 1.001 * dct.std(), (still.std(), dct.std())
    noises = [kind_of("ridge").make(replace(inputs, noise=noise)) for noise in (0.001, 0.01, 0.1)]
    stds = [maps(prior, rt, scan.grid.shape)[0].std() for prior in noises]
    assert stds[0] > stds[1] > stds[2] > dct.std(), (stds, dct.std())
    scans = scan, replace(scan, is_fly=False)
    turned, at_rest = (run(rt, scan, "fista", motion="static", iterations=4, prior="ridge").volume for scan in scans)
    assert not np.array_equal(turned, at_rest)


def test_a_prior_is_found_by_its_name(rt, scan, tmp_path, monkeypatch) -> None:
    own = "nothing = lambda volume, noise: 0 * volume\nless = lambda volume, noise: volume[1:]\n"
    (tmp_path / "own_priors.py").write_text(own)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert not run(rt, scan, "fista", prior="own_priors:nothing", iterations=2).volume.any()
    with pytest.raises(InputError, match="--prior: found own_priors:nobody"):
        run(rt, scan, "fista", prior="own_priors:nobody", iterations=2)
    with pytest.raises(InputError, match="--prior own_priors:<lambda>: found shape"):
        run(rt, scan, "fista", prior="own_priors:less", iterations=2)


@pytest.mark.parametrize(("volumes", "prior"), [(14.4, "dct"), (11.5, "dct"), (17.4, "ridge")])
def test_operators_leave_the_device_s_memory_to_the_prior(rt, volumes, prior) -> None:
    """13 volumes are a slab of 1024² × 40 voxels in 2 GiB: the prior's arrays, with bricks beside them."""
    panel, grid = ParallelGeometry((40, 64), 1.0), Grid((40, 64, 64), (1.0, 1.0, 1.0))
    frames = np.random.default_rng(0).uniform(0, 1, (16, *panel.detector_shape)).astype(np.float32)
    scan = static_scan(frames, panel, np.arange(16) * 180 / 16, grid=grid)
    options = FistaOptions(iterations=1, subvoxels=1, prior=prior)
    expected = fista(scan, options, rt).volume
    with room_for(rt, int(volumes * 4 * 40 * 64 * 64)):
        assert np.abs(fista(scan, options, rt).volume - expected).max() <= RAYS * expected.max()
