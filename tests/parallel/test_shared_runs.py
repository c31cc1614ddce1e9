"""Runs on several ranks, which are threads here: the same bits as on one, and the same gradient as undivided."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tolerances import RANK_GRADIENT, RANK_VOLUME

from phyradgs_cl.acquisition import ConeGeometry, Exact, MicroViews, Protocol, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.optim import DensityControl
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import Progress, loop, method_options, reconstruct
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.run import SplatRun
from phyradgs_cl.reconstructors.splats.start import first_population, internal_scale
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

CONTROL = DensityControl(every=6, start_iteration=5, threshold=1e-6)
OPTIONS = SplatOptions(
    motion=MicroViews(4, 2), iterations=21, gaussians=300, tv_edge=8, batch=4, control=CONTROL
)
DIVIDED = {
    "four frames per step": OPTIONS,
    "exact in time": replace(OPTIONS, motion=Exact()),
    "intensities": replace(OPTIONS, detector_model="intensity"),
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
    return rt.download(run.cloud.gradients)[:11, : run.cloud.count]


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


def test_a_batch_s_gradient_is_the_sum_of_its_frames(scan) -> None:
    """Sub-volumes and parameter terms included: each frame brings its own."""
    run = started(scan, replace(OPTIONS, parameter_terms_from=0), Runtime())
    batch, download = run.next_batch(), run.rt.download
    run.cloud.activate(run.adam)
    run.sharing.differentiate(run.frame_step, run.cloud, batch)
    found, statistics = download(run.cloud.gradients)[:11], run.cloud.read_statistics()
    total, single = np.zeros_like(found, np.float64), run.rt.zeros(run.cloud.statistics.shape)
    for frame, corner in zip(batch.frames, batch.corners, strict=True):
        run.frame_step.gradient(run.cloud, frame, corner, batch.late, single)
        total += download(run.cloud.gradients)[:11]
    assert np.linalg.norm(found - total) <= RANK_GRADIENT * np.linalg.norm(total)
    np.testing.assert_allclose(statistics, download(single)[:, : run.cloud.count], rtol=RANK_GRADIENT)


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


def test_a_stopped_run_goes_on_with_another_number_of_ranks(ranks_of, scan) -> None:
    few = replace(CONTROL, max_gaussians=400)
    options = replace(OPTIONS, iterations=120, control=few)
    whole = reconstruct(scan, "phyradgs", Runtime(), options, seed=1)

    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    def stopped(ranks):
        return reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, seed=1, report=stop)

    first = ranks_of(3, stopped)
    assert {result.facts["interrupted_at"] for result in first} == {52}
    state = first[0].state
    for size in (1, 2, 4):
        found = ranks_of(
            size,
            lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, seed=1, resume=state),
        )
        np.testing.assert_array_equal(found[0].volume, whole.volume)
        assert [r["iteration"] for r in found[-1].record] == [r["iteration"] for r in whole.record]


def test_rank_0_reports_alone_and_can_make_what_it_is_asked_for(ranks_of, scan) -> None:
    seen = []

    def report(progress: Progress) -> None:
        volume, grid = progress.volume()
        seen.append((progress.iteration, volume.shape == grid.shape, progress.state()["raw"].shape[0]))

    options = replace(OPTIONS, iterations=100, control=replace(CONTROL, max_gaussians=400))
    ranks_of(3, lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options, report=report))
    assert seen == [(52, True, 11), (100, True, 11)]


def test_a_batch_larger_than_the_scan_is_refused(rt, scan) -> None:
    with pytest.raises(InputError, match="6 frames"):
        reconstruct(scan, "phyradgs", rt, replace(OPTIONS, batch=7))


def test_more_ranks_than_frames_per_step_are_refused(ranks_of, scan) -> None:
    options = replace(OPTIONS, batch=2)
    with pytest.raises(InputError, match="2 for 3 ranks; expected a frame for every rank"):
        ranks_of(3, lambda ranks: reconstruct(scan, "phyradgs", Runtime(ranks=ranks), options))


def test_methods_that_do_not_share_say_so(ranks_of, scan) -> None:
    with pytest.raises(InputError, match="2 ranks; expected one"):
        ranks_of(2, lambda ranks: reconstruct(scan, "fdk", Runtime(ranks=ranks)))


def test_slow_iterations_are_reported_one_by_one(ranks_of, scan, monkeypatch) -> None:
    """Ranks would have to agree on what is slow: there it goes by number, whatever the clock says."""
    monkeypatch.setattr(loop, "SILENT_S", 0.0)
    alone: list[int] = []
    options = replace(OPTIONS, iterations=60, batch=1, control=replace(CONTROL, max_gaussians=400))
    reconstruct(scan, "phyradgs", Runtime(), options, report=lambda p: alone.append(p.iteration))
    assert alone == list(range(1, 61))
    shared: list[int] = []
    options = replace(options, batch=2)
    ranks_of(
        2,
        lambda ranks: reconstruct(
            scan, "phyradgs", Runtime(ranks=ranks), options, report=lambda p: shared.append(p.iteration)
        ),
    )
    assert shared == [50, 60]
