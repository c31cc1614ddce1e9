"""Scans of a detector that adds photons: the iterative methods model it, and gain from it."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, MicroViews, OwnTimes, PerRow, Protocol, Scan, Static
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import psnr
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors import plan_run, reconstruct
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime.algebra import norm
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

pytestmark = pytest.mark.slow

ITERATIONS = {"os-sart": 8, "sirt": 25, "cgls": 8, "asd-pocs": 4, "fista": 4, "phyradgs exact": 500}
VOXELS = [method for method in ITERATIONS if "phyradgs" not in method]
GEOMETRY = ConeGeometry(5.0, 7.0, (24, 24), (4 / 24, 4 / 24))
GRID = Grid.cube(16, 2.0)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """An opaque object on a fast gantry, where the two models are far apart."""
    phantom = shepp_logan(1.0)
    options = SimulationOptions(Protocol(views=12, exposure_deg=24.0), detector_model="intensity", peak=8.0)
    source = AnalyticSource(phantom, GEOMETRY)
    return simulate(source, GEOMETRY, GRID, options, reference=phantom.voxelise(GRID, 4))


def run(rt, scan: Scan, method: str, model: str | None = None, **more):
    """A method on voxels, or the splats with their motion in the name."""
    name, _, motion = method.partition(" ")
    changes = {"motion": motion, "gaussians": 400} if motion else {"motion": "per-row", "sub_intervals": 3}
    changes |= {"iterations": ITERATIONS[method], **({} if model is None else {"detector_model": model}), **more}
    return reconstruct(scan, plan_run(name, changes), rt)


@pytest.mark.parametrize("method", ITERATIONS)
def test_modelled_intensity_beats_line_integrals(rt, scan, method) -> None:
    by_log, by_intensity = (run(rt, scan, method, model) for model in ("log", "intensity"))
    log_db, db = (psnr(one.volume, scan.reference, float(scan.reference.max())) for one in (by_log, by_intensity))
    assert db > log_db + (0.1 if method in VOXELS else 0.2), (db, log_db)
    if method in VOXELS:
        assert by_intensity.record[-1]["residual"] < by_log.record[-1]["residual"]
    assert (by_log.facts["detector_model"], by_intensity.facts["detector_model"]) == ("log", "intensity")


@pytest.mark.parametrize("method", ["sirt", "phyradgs exact"])
def test_the_scan_says_which_model_unless_it_is_told(rt, scan, method) -> None:
    for recorded in ("log", "intensity"):
        said = replace(scan, detector_model=recorded)
        by_itself, told = (run(rt, said, method, model, iterations=2) for model in (None, recorded))
        np.testing.assert_array_equal(by_itself.volume, told.volume)
        assert by_itself.facts["detector_model"] == recorded


def test_of_one_pose_a_line_both_models_are_the_mean(rt, scan) -> None:
    """Splats on a gantry at rest have one value to average too."""
    for motion in (Static(), OwnTimes(sub_intervals=1)):
        assert System.of_scan(rt, scan, motion, "scan").intensity is None
    assert System.of_scan(rt, scan, MicroViews(2, 2), "scan").intensity is not None
    assert System.of_scan(rt, scan, MicroViews(2, 2), "log").intensity is None
    usual = {"motion": "static", "iterations": 3}
    by_log, by_intensity = (run(rt, scan, "phyradgs exact", model, **usual) for model in ("log", "intensity"))
    np.testing.assert_array_equal(by_log.volume, by_intensity.volume)
    assert by_intensity.facts["detector_model"] == "log"


def test_what_comes_back_is_the_gradient_of_the_misfit(rt, scan) -> None:
    """−Jᵀ(p − I(x)) is the derivative of half the squared residual, along random directions."""
    system = System.of_scan(rt, scan, PerRow(sub_intervals=3), "scan")
    rng, step = np.random.default_rng(3), np.float32(1e-2)
    x, d = (rng.uniform(low, high, GRID.shape).astype(np.float32) for low, high in ((0, 2), (-1, 1)))
    ahead, behind = (0.5 * norm(system.residual(x + s * step * d)) ** 2 for s in (1, -1))
    gradient = system.back(system.residual(x))
    found, expected = -float(np.vdot(gradient.astype(float), d)), (ahead - behind) / (2 * float(step))
    assert found == pytest.approx(expected, rel=2e-3)
    by_derivative = float(np.vdot(system.derivative(d).astype(float), -system.residual(x)))
    assert by_derivative == pytest.approx(found, rel=1e-4)
