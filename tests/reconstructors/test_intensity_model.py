"""Scans of a detector that adds photons: the iterative methods model it, and gain from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, MicroViews, PerRow, Protocol, Scan, Static
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import psnr
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import method_options, reconstruct
from phyradgs_cl.reconstructors.result import Progress
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime.algebra import norm
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

ITERATIONS = {"sart": 6, "os-sart": 8, "sirt": 25, "cgls": 8, "asd-pocs": 6, "fista-tv": 25}
GEOMETRY = ConeGeometry(5.0, 7.0, (24, 24), (4 / 24, 4 / 24))
GRID = Grid.cube(16, 2.0)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """An opaque object on a fast gantry, where the two models are far apart."""
    phantom = shepp_logan(1.0)
    options = SimulationOptions(
        protocol=Protocol(views=12, exposure_deg=24.0), detector_model="intensity", peak=8.0
    )
    source = AnalyticSource(phantom, GEOMETRY)
    return simulate(source, GEOMETRY, GRID, options, reference=phantom.voxelise(GRID, 4))


def run(rt, scan: Scan, method: str, model: str | None, **more):
    changes = {"motion": "per-row", "sub_intervals": 3, "iterations": ITERATIONS[method], **more}
    if model is not None:
        changes["detector_model"] = model
    return reconstruct(scan, method, rt, method_options(method, None, changes))


@pytest.mark.parametrize("method", ITERATIONS)
def test_modelled_intensity_beats_line_integrals(rt, scan, method) -> None:
    peak = float(scan.reference.max())
    by_log, by_intensity = (run(rt, scan, method, model) for model in ("log", "intensity"))
    gain_db = psnr(by_intensity.volume, scan.reference, peak) - psnr(by_log.volume, scan.reference, peak)
    assert gain_db > 0.1, f"{gain_db:.2f} dB"
    assert by_intensity.record[-1]["residual"] < by_log.record[-1]["residual"]
    assert (by_log.facts["detector_model"], by_intensity.facts["detector_model"]) == ("log", "intensity")


@pytest.mark.parametrize("method", ITERATIONS)
def test_the_scan_says_which_model_unless_it_is_told(rt, scan, method) -> None:
    few = {"iterations": 2}
    for recorded in ("log", "intensity"):
        said = replace(scan, detector_model=recorded)
        by_itself, told = (run(rt, said, method, model, **few) for model in (None, recorded))
        np.testing.assert_array_equal(by_itself.volume, told.volume)


def test_of_one_pose_a_line_both_models_are_the_mean(rt, scan) -> None:
    for motion in (Static(), PerRow(sub_intervals=1)):
        assert System.of_scan(rt, scan, motion, "scan").intensity is None
    assert System.of_scan(rt, scan, MicroViews(2, 2), "scan").intensity is not None
    assert System.of_scan(rt, scan, MicroViews(2, 2), "log").intensity is None


def test_what_comes_back_is_the_gradient_of_the_misfit(rt, scan) -> None:
    """−Jᵀ(p − I(x)) is the derivative of half the squared residual, along random directions."""
    system = System.of_scan(rt, scan, PerRow(sub_intervals=3), "scan")
    rng = np.random.default_rng(3)
    x = rng.uniform(0, 2, GRID.shape).astype(np.float32)
    d = rng.uniform(-1, 1, GRID.shape).astype(np.float32)
    step = np.float32(1e-2)
    ahead, behind = (0.5 * norm(system.residual(x + s * step * d)) ** 2 for s in (1, -1))
    gradient = system.back(system.residual(x))
    found, expected = -float(np.vdot(gradient.astype(float), d)), (ahead - behind) / (2 * float(step))
    assert found == pytest.approx(expected, rel=2e-3)
    assert float(np.vdot(system.derivative(d).astype(float), -system.residual(x))) == pytest.approx(
        found, rel=1e-4
    )


def test_masked_pixels_do_not_count(rt, scan) -> None:
    mask = np.zeros(GEOMETRY.detector_shape, np.uint8)
    mask[5:9, 11] = 1
    volumes = []
    for garbage in (0.0, 50.0):
        frames = scan.projections.copy()
        frames[:, mask != 0] = garbage
        spoilt = replace(scan, projections=frames, pixel_mask=mask)
        volumes.append(run(rt, spoilt, "sart", "intensity", iterations=2).volume)
    np.testing.assert_array_equal(*volumes)


@pytest.mark.parametrize("method", ITERATIONS)
def test_an_interrupted_run_goes_on_with_the_same_bits(rt, scan, method) -> None:
    options = method_options(
        method, None, {"motion": "micro-views", "strips": 2, "sub_intervals": 2, "iterations": 4}
    )
    whole = reconstruct(scan, method, rt, options)

    def stop(progress: Progress) -> None:
        if progress.iteration == 2:
            raise KeyboardInterrupt

    part = reconstruct(scan, method, rt, options, report=stop)
    assert part.facts["stopped_by"] == "interrupt"
    rest = reconstruct(scan, method, rt, options, resume=part.state)
    np.testing.assert_array_equal(rest.volume, whole.volume)


def test_unknown_models_are_named() -> None:
    with pytest.raises(InputError, match="detector_model"):
        method_options("sart", None, {"detector_model": "linear"})


def splats(rt, scan: Scan, motion: str, model: str | None = None, iterations: int = 500):
    changes = {"motion": motion, "iterations": iterations, "gaussians": 400}
    if model is not None:
        changes["detector_model"] = model
    return reconstruct(scan, "phyradgs", rt, method_options("phyradgs", None, changes))


@pytest.mark.parametrize("motion", ["exact", "micro-views"])
def test_splats_that_model_intensity_beat_line_integrals(rt, scan, motion) -> None:
    peak = float(scan.reference.max())
    by_log, by_intensity = (splats(rt, scan, motion, model) for model in ("log", "intensity"))
    gain_db = psnr(by_intensity.volume, scan.reference, peak) - psnr(by_log.volume, scan.reference, peak)
    assert gain_db > 0.2, f"{gain_db:.2f} dB"
    assert (by_log.facts["detector_model"], by_intensity.facts["detector_model"]) == ("log", "intensity")


def test_splats_do_as_the_scan_says(rt, scan) -> None:
    for recorded in ("log", "intensity"):
        said = replace(scan, detector_model=recorded)
        by_itself, told = (splats(rt, said, "exact", model, 3) for model in (None, recorded))
        np.testing.assert_array_equal(by_itself.volume, told.volume)
        assert by_itself.facts["detector_model"] == recorded


def test_splats_on_a_gantry_at_rest_have_one_value_to_average(rt, scan) -> None:
    by_log, by_intensity = (splats(rt, scan, "static", model, 3) for model in ("log", "intensity"))
    np.testing.assert_array_equal(by_log.volume, by_intensity.volume)
    assert by_intensity.facts["detector_model"] == "log"
