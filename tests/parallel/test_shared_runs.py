"""Sums over ranks are exact, and runs on ranks, which are threads here, have the bits and the gradient of one."""

from dataclasses import replace

import numpy as np
import pytest
from parallel.shared_runs import CONTROL, OPTIONS, small_scan, started
from tolerances import RANK_GRADIENT, RANK_VOLUME

from phyradgs_cl.acquisition import Exact, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.parallel import Communicator, exact_sum
from phyradgs_cl.reconstructors import Progress, RunPlan, loop, method_options, reconstruct
from phyradgs_cl.runtime import Runtime

pytestmark = pytest.mark.slow
DIVIDED = {
    "four frames per step": OPTIONS, "exact in time": replace(OPTIONS, motion=Exact()),
    "intensities": replace(OPTIONS, detector_model="intensity"),
}  # fmt: skip


@pytest.fixture(scope="module")
def scan() -> Scan:
    return small_scan()


@pytest.fixture(scope="module")
def on_ranks(ranks_of, scan):
    """(size, method, options, more of a reconstruction) → the result of every rank. A rank keeps its Runtime."""
    runtimes = [Runtime() for _ in range(4)]

    def run(size: int, method: str, options=None, seed: int = 0, **more):
        plan = RunPlan(method, options or method_options(method), seed=seed)

        def on(ranks):
            (rt := runtimes[ranks.rank]).ranks = ranks
            return reconstruct(scan, plan, rt, **more)

        return ranks_of(size, on)

    return run


@pytest.mark.parametrize("name", DIVIDED)
def test_same_bits_on_any_number_of_ranks(rt, on_ranks, scan, name) -> None:
    options = DIVIDED[name]
    one = reconstruct(scan, RunPlan("phyradgs", options, seed=1), rt)
    assert one.gaussians.count != one.facts["gaussians_first"]  # density control has acted
    for size in (2, 4) if options is OPTIONS else (3,):
        found = on_ranks(size, "phyradgs", options, seed=1)
        np.testing.assert_array_equal(found[0].volume, one.volume)
        for result in found:
            np.testing.assert_array_equal(result.gaussians.rows(), one.gaussians.rows())
            assert [r["loss"] for r in result.record] == [r["loss"] for r in one.record]


def test_a_batch_s_gradient_is_the_sum_of_its_frames(rt, scan) -> None:
    """Sub-volumes and parameter terms included: each frame brings its own."""
    run = started(scan, replace(OPTIONS, parameter_terms_from=0), rt)
    batch, download = run.next_batch(), run.rt.download
    run.adam.activate(run.cloud.raw, run.cloud.gaussians.rows, run.cloud.count, run.cloud.gaussians.stride)
    run.frame_step.differentiate(run.cloud, batch)
    found, statistics = download(run.cloud.gradients)[:11], run.cloud.read_statistics()
    total, single = np.zeros_like(found, np.float64), run.rt.zeros(run.cloud.statistics.shape)
    for frame, corner in zip(batch.frames, batch.corners, strict=True):
        run.frame_step.gradient(run.cloud, frame, corner, batch.late, single)
        total += download(run.cloud.gradients)[:11]
    assert np.linalg.norm(found - total) <= RANK_GRADIENT * np.linalg.norm(total)
    np.testing.assert_allclose(statistics, download(single)[:, : run.cloud.count], rtol=RANK_GRADIENT)


@pytest.mark.parametrize("method", ["sart", "os-sart", "sirt", "cgls", "asd-pocs", "fista-tv"])
def test_classical_methods_come_to_the_same_volume(rt, on_ranks, scan, method) -> None:
    model = "log" if method == "cgls" else "intensity"
    options = method_options(method, None, {"iterations": 3, "motion": "per-row", "detector_model": model})
    one = reconstruct(scan, RunPlan(method, options), rt).volume
    first: dict[int, np.ndarray] = {}
    for size in (3, 2, 3) if method == "sirt" else (3,):  # and once more
        volumes = [found.volume for found in on_ranks(size, method, options)]
        assert np.linalg.norm(volumes[0] - one) <= RANK_VOLUME * np.linalg.norm(one)
        for volume in volumes:
            np.testing.assert_array_equal(volume, first.setdefault(size, volumes[0]))


def test_a_stopped_run_goes_on_with_another_number_of_ranks(rt, on_ranks, scan) -> None:
    options = replace(OPTIONS, iterations=64, control=replace(CONTROL, max_gaussians=400))
    whole = reconstruct(scan, RunPlan("phyradgs", options, seed=1), rt)

    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    first = on_ranks(3, "phyradgs", options, seed=1, report=stop)
    assert {result.facts["interrupted_at"] for result in first} == {52}
    for size in (1, 4):
        found = on_ranks(size, "phyradgs", options, seed=1, resume=first[0].state)
        np.testing.assert_array_equal(found[0].volume, whole.volume)
        assert [r["iteration"] for r in found[-1].record] == [r["iteration"] for r in whole.record]


def test_rank_0_reports_alone_and_can_make_what_it_is_asked_for(on_ranks, scan, monkeypatch) -> None:
    """By number on several ranks, whatever the clock says: they would have to agree on what is slow."""
    seen = []

    def report(progress: Progress) -> None:
        volume, grid = progress.volume()
        seen.append((progress.iteration, volume.shape == grid.shape, progress.state()["raw"].shape[0]))

    monkeypatch.setattr(loop, "SILENT_S", 0.0)
    options = replace(OPTIONS, control=replace(CONTROL, max_gaussians=400))
    for size, batch, expected in ((1, 1, [1, 2, 3, 4]), (2, 2, [50, 56]), (3, 4, [52, 56])):
        seen.clear()
        on_ranks(size, "phyradgs", replace(options, iterations=expected[-1], batch=batch), report=report)
        assert seen == [(iteration, True, 11) for iteration in expected]


def test_what_ranks_cannot_share_is_refused(on_ranks) -> None:
    for size, method, options, said in (
        (1, "phyradgs", replace(OPTIONS, batch=7), "6 frames"),
        (3, "phyradgs", replace(OPTIONS, batch=2), "2 for 3 ranks; expected a frame for every rank"),
        (2, "fdk", None, "2 ranks; expected one"),
    ):
        with pytest.raises(InputError, match=said):
            on_ranks(size, method, options)


def parts(count: int = 12, rows: int = 13, columns: int = 501) -> list[np.ndarray]:
    """Numbers over many orders of magnitude, rows of very different size."""
    rng = np.random.default_rng(3)
    size = 10.0 ** rng.uniform(-12, 4, (rows, 1))
    shape = (count, rows, columns)
    return list((size * rng.normal(size=shape) * 10.0 ** rng.uniform(-9, 0, shape)).astype(np.float32))


def test_it_is_the_sum_to_a_float_of_the_row_s_largest_on_any_number_of_ranks_in_any_order(ranks_of) -> None:
    given = parts()
    found = exact_sum(Communicator(), given, given[0].shape, len(given))
    expected = np.sum(np.asarray(given, np.float64), axis=0)
    largest = np.abs(given).max(axis=(0, 2))
    last_place = np.spacing(np.abs(expected).astype(np.float32))
    assert np.all(np.abs(found - expected) <= last_place + 1e-10 * largest[:, None])
    many = [np.full((1, 2), np.float32(2.0**100))] * 64  # the largest floats do not overflow
    np.testing.assert_array_equal(exact_sum(Communicator(), many, (1, 2), 64), np.float32(2.0**106))

    def work(ranks) -> np.ndarray:
        return exact_sum(ranks, given[ranks.rank :: ranks.size][::-1], given[0].shape, len(given))

    for size in (1, 2, 3, 4, 5):
        for same in ranks_of(size, work):
            np.testing.assert_array_equal(same, found)


def test_a_rank_may_have_nothing_and_what_is_not_finite_breaks_its_row_on_every_rank(ranks_of) -> None:
    def work(ranks, bad: float) -> np.ndarray:
        values = np.ones((2, 3), np.float32)
        values[1, ranks.rank] = bad if ranks.rank == 1 else 1
        return exact_sum(ranks, [values], (2, 3), 2)

    for found in ranks_of(2, lambda ranks: exact_sum(ranks, [np.zeros((2, 3), np.float32)] * ranks.rank, (2, 3), 1)):
        np.testing.assert_array_equal(found, 0)
    for bad in (np.nan, np.inf, -np.inf):
        for found in ranks_of(2, lambda ranks, bad=bad: work(ranks, bad)):
            assert np.all(found[0] == 2) and np.all(np.isnan(found[1]))
