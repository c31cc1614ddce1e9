"""Runs on several ranks, which are threads here: the same bits as on one, and the same gradient as undivided."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tolerances import DOMAIN_GRADIENT, DOMAIN_JUMP, DOMAIN_JUMPS, DOMAIN_VOLUME, RANK_GRADIENT, RANK_VOLUME

from phyradgs_cl.acquisition import ConeGeometry, Motion, Protocol, Scan
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.fields import Grid
from phyradgs_cl.optim import DensityControl
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import Progress, method_options, reconstruct, splat_run
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.splat_options import SplatOptions
from phyradgs_cl.reconstructors.splat_run import SplatRun
from phyradgs_cl.reconstructors.splat_start import first_population, internal_scale
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

# without jumps, across which a last digit makes a difference
SMOOTH = {"l1_weight": 0.0, "poisson_weight": 1.0, "tv_weight": 0.0}
CONTROL = DensityControl(every=6, start_iteration=5, threshold=1e-6)
OPTIONS = SplatOptions(
    motion=Motion("micro-views", 4, 2), iterations=21, gaussians=300, tv_edge=8, control=CONTROL
)
DIVIDED = {
    "four frames a step": replace(OPTIONS, batch=4),
    "more ranks than frames": replace(OPTIONS, batch=1, parts=4),
    "lines and frames": replace(OPTIONS, batch=2, parts=2),
    "exact in time": replace(OPTIONS, batch=1, parts=4, motion=Motion("exact")),
    "intensities": replace(OPTIONS, batch=1, parts=4, detector_model="intensity"),
    "domain": replace(OPTIONS, split="domain", parts=4),
    "domain, two frames a step": replace(OPTIONS, split="domain", parts=4, batch=2),
    "domain, intensities": replace(OPTIONS, split="domain", parts=4, detector_model="intensity"),
    "domain, pixels with an area": replace(OPTIONS, split="domain", parts=4, pixel_footprint=True),
    "domain, few may be added": replace(
        OPTIONS, split="domain", parts=4, control=replace(CONTROL, max_gaussians=320)
    ),
}


@pytest.fixture(scope="module")
def scan() -> Scan:
    geometry = ConeGeometry(5, 7.5, (24, 24), (3.9 / 24, 3.9 / 24))
    source = AnalyticSource(shepp_logan(1.0), geometry)
    protocol = Protocol(views=6, exposure_deg=20.0)
    return simulate(source, geometry, Grid.cube(16, 2.0), SimulationOptions(protocol))


def started(scan: Scan, options: SplatOptions, rt: Runtime) -> SplatRun:
    fdk = static_fdk(rt, scan)
    scale = internal_scale(fdk, scan.grid)
    rng = np.random.default_rng(1)
    grid = scan.grid.scaled(1 / scale.length_mm)
    population = first_population(fdk / scale.density_per_mm, grid, options, rng)
    return SplatRun(rt, scan, options, scale, population, rng)


def gradient(scan: Scan, options: SplatOptions, rt: Runtime) -> np.ndarray:
    """dL/draw (11, G) of the first step, of all Gaussians."""
    run = started(scan, options, rt)
    run.step()
    own = [rt.download(cloud.gradients)[:11, : cloud.count] for cloud in run.clouds]
    return run.division.whole(np.concatenate(own, axis=1))


@pytest.mark.parametrize("name", DIVIDED)
def test_same_bits_on_1_to_4_ranks(ranks_of, scan, name) -> None:
    options = DIVIDED[name]
    one = reconstruct(scan, "phyradgs", Runtime(), options, seed=1)
    assert one.gaussians.count != one.facts["gaussians_first"]  # density control has acted
    for size in (2, 3, 4):
        found = ranks_of(
            size, lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, seed=1)
        )
        np.testing.assert_array_equal(found[0].volume, one.volume)
        for result in found:
            np.testing.assert_array_equal(result.gaussians.rows(), one.gaussians.rows())
            assert [r["loss"] for r in result.record] == [r["loss"] for r in one.record]


@pytest.mark.parametrize("size", [2, 3, 4])
@pytest.mark.parametrize("split", ["frames", "domain"])
@pytest.mark.parametrize("motion", [Motion("static"), Motion("micro-views", 4, 2), Motion("exact")])
def test_gradients_of_ranks_add_up_to_the_undivided_one(rt, ranks_of, scan, size, split, motion) -> None:
    """One frame of which each rank has some lines, or draws some Gaussians."""
    options = replace(OPTIONS, motion=motion, batch=1, **SMOOTH)
    expected = gradient(scan, options, rt)
    divided = replace(options, split=split)
    tolerance = RANK_GRADIENT if split == "frames" else DOMAIN_GRADIENT
    for found in ranks_of(size, lambda ranks: gradient(scan, divided, Runtime(ranks=ranks))):
        assert np.linalg.norm(found - expected) <= tolerance * np.linalg.norm(expected)


def test_a_batch_s_gradient_is_the_sum_of_its_frames(scan) -> None:
    """Sub-volumes and parameter terms included: each frame brings its own."""
    batched = replace(OPTIONS, batch=3)
    run = started(scan, batched, Runtime())
    batch = run._next_batch()
    for cloud in run.clouds:
        cloud.activate(run.objective.adam)
    run.division.differentiate(run, batch)
    found = run.rt.download(run.clouds[0].gradients)[:11]
    statistics = run.clouds[0].read_statistics()
    single = started(scan, replace(OPTIONS, batch=1), run.rt)
    single.clouds[0].activate(single.objective.adam)
    total = np.zeros_like(found, np.float64)
    for frame, corner in zip(batch.frames, batch.corners, strict=True):
        single.division.differentiate(single, type(batch)([frame], [corner], batch.late))
        total += run.rt.download(single.clouds[0].gradients)[:11]
    assert np.linalg.norm(found - total) <= RANK_GRADIENT * np.linalg.norm(total)
    np.testing.assert_allclose(statistics, single.clouds[0].read_statistics(), rtol=RANK_GRADIENT)


@pytest.mark.parametrize("method", ["sart", "os-sart", "sirt", "cgls", "asd-pocs", "fista-tv"])
@pytest.mark.parametrize("model", ["log", "intensity"])
def test_classical_methods_come_to_the_same_volume(ranks_of, scan, method, model) -> None:
    changes = {"iterations": 6, "motion": "per-row", "detector_model": model}
    options = method_options(method, None, changes)
    one = reconstruct(scan, method, Runtime(), options).volume
    for size in (2, 3, 4):
        volumes = ranks_of(
            size, lambda ranks: reconstruct(scan, method, Runtime(ranks=ranks), options).volume
        )
        again = ranks_of(size, lambda ranks: reconstruct(scan, method, Runtime(ranks=ranks), options).volume)
        assert np.linalg.norm(volumes[0] - one) <= RANK_VOLUME * np.linalg.norm(one)
        for volume in (*volumes, *again):
            np.testing.assert_array_equal(volume, volumes[0])


MEMORY_BYTES = 3_000_000  # the whole takes 8.7 MB on one device
LARGE = replace(
    OPTIONS, split="domain", parts=4, motion=Motion("micro-views", 8, 5), gaussians=400, tv_edge=8
)


def test_a_domain_too_large_for_one_device(ranks_of, scan) -> None:
    """Under a limit that one rank breaks, four come to the bits of a device without a limit, at borders as elsewhere."""
    whole = replace(LARGE, parts=1)
    with pytest.raises(PhyradgsError, match="memory"):
        reconstruct(scan, "phyradgs", Runtime(memory=MEMORY_BYTES), whole, seed=1)
    expected = reconstruct(scan, "phyradgs", Runtime(), LARGE, seed=1)

    def work(ranks) -> tuple[np.ndarray, int]:
        rt = Runtime(memory=MEMORY_BYTES, ranks=ranks)
        return reconstruct(scan, "phyradgs", rt, LARGE, seed=1).volume, rt.peak_bytes

    found = ranks_of(4, work)
    assert max(peak for _, peak in found) <= MEMORY_BYTES
    np.testing.assert_array_equal(found[0][0], expected.volume)
    assert [volume.shape[0] for volume, _ in found] == [16, 0, 0, 0]


def test_a_domain_too_large_for_one_device_is_the_undivided_one(ranks_of, scan) -> None:
    """Every slice, those at the borders of the parts among them; density control takes part."""
    options = replace(LARGE, iterations=60, control=replace(CONTROL, max_gaussians=1000))
    undivided = replace(options, split="frames", batch=1, parts=1)
    with pytest.raises(PhyradgsError, match="memory"):
        reconstruct(scan, "phyradgs", Runtime(memory=MEMORY_BYTES), undivided, seed=1)
    alone = Runtime()
    expected = reconstruct(scan, "phyradgs", alone, undivided, seed=1)
    assert alone.peak_bytes > 2 * MEMORY_BYTES

    def work(ranks) -> np.ndarray:
        return reconstruct(
            scan, "phyradgs", Runtime(memory=MEMORY_BYTES, ranks=ranks), options, seed=1
        ).volume

    assert_undivided(ranks_of(4, work)[0], expected.volume)


def assert_undivided(volume: np.ndarray, expected: np.ndarray) -> None:
    """Every voxel, but for those at whose place a Gaussian ends: see tolerances.py."""
    assert volume.shape == expected.shape
    error = np.abs(volume - expected) / expected.max()
    assert error.max() <= DOMAIN_JUMP
    assert np.mean(error > DOMAIN_VOLUME) <= DOMAIN_JUMPS


@pytest.mark.parametrize("motion", [Motion("static"), Motion("micro-views", 4, 2), Motion("exact")])
def test_round_gaussians_do_not_turn_by_rounding(scan, motion) -> None:
    """Two runs that round in different ways stay together: Adam would make whole steps of the rounding."""
    few = replace(CONTROL, max_gaussians=420)
    divided = replace(OPTIONS, motion=motion, split="domain", parts=4, iterations=60, control=few)
    whole = reconstruct(
        scan, "phyradgs", Runtime(), replace(divided, split="frames", batch=1, parts=1), seed=1
    )
    found = reconstruct(scan, "phyradgs", Runtime(), divided, seed=1)
    assert_undivided(found.volume, whole.volume)


@pytest.mark.parametrize("split", ["frames", "domain"])
def test_a_stopped_run_goes_on_with_another_number_of_ranks(ranks_of, scan, split) -> None:
    few = replace(CONTROL, max_gaussians=400)
    options = replace(OPTIONS, iterations=120, batch=2, parts=4, split=split, control=few)
    whole = reconstruct(scan, "phyradgs", Runtime(), options, seed=1)

    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    def stopped(ranks):
        return reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, seed=1, report=stop)

    first = ranks_of(3, stopped)
    assert {result.facts["interrupted_at"] for result in first} == {50}
    state = first[0].state
    for size in (1, 2, 4):
        found = ranks_of(
            size,
            lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, seed=1, resume=state),
        )
        np.testing.assert_array_equal(found[0].volume, whole.volume)
        assert [r["iteration"] for r in found[-1].record] == list(range(6, 121, 6))


def test_rank_0_reports_and_all_make_what_it_asks_for(ranks_of, scan) -> None:
    seen = []

    def report(progress: Progress) -> None:
        volume, grid = progress.volume()
        seen.append((progress.iteration, volume.shape == grid.shape, progress.state()["raw"].shape))

    options = replace(OPTIONS, split="domain", iterations=100, control=replace(CONTROL, max_gaussians=400))
    ranks_of(3, lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, report=report))
    assert [iteration for iteration, *_ in seen] == [50, 100]
    assert all(is_whole for _, is_whole, _ in seen)


def test_a_batch_larger_than_the_scan_is_refused(rt, scan) -> None:
    with pytest.raises(InputError, match="6 frames"):
        reconstruct(scan, "phyradgs", rt, replace(OPTIONS, batch=7))


@pytest.mark.parametrize("split", ["frames", "domain"])
def test_more_ranks_than_parts_are_refused(ranks_of, scan, split) -> None:
    options = replace(OPTIONS, batch=1, parts=2, split=split)
    with pytest.raises(InputError, match="a part for every rank"):
        ranks_of(3, lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options))


def test_methods_that_do_not_share_say_so(ranks_of, scan) -> None:
    with pytest.raises(InputError, match="2 ranks; expected one"):
        ranks_of(2, lambda ranks: reconstruct(scan, "fdk", Runtime(ranks=ranks)))


def test_slow_iterations_are_reported_one_by_one(ranks_of, scan, monkeypatch) -> None:
    """Ranks would have to agree on what is slow: there it goes by number, whatever the clock says."""
    monkeypatch.setattr(splat_run, "_SILENT_S", 0.0)
    alone: list[int] = []
    options = replace(OPTIONS, iterations=60, batch=1, control=replace(CONTROL, max_gaussians=400))
    reconstruct(
        scan, "phyradgs", Runtime(), options, report=lambda progress: alone.append(progress.iteration)
    )
    assert alone == list(range(1, 61))
    shared: list[int] = []
    ranks_of(
        2,
        lambda ranks: reconstruct(
            scan, "phyradgs", Runtime(ranks=ranks), options, report=lambda p: shared.append(p.iteration)
        ),
    )
    assert shared == [50, 60]
