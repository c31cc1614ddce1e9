"""Methods as a GPU runs them, one work-item per pixel in groups the size of a sub-group, give what vectors of lanes give.

Kernels alone, every one of them: tests/test_device_check.py."""

from functools import cache

import numpy as np
import pytest
from tolerances import LAUNCH_SHAPE

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.reconstructors import ObjectMotion, plan_run, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import SimulationOptions, VolumeSource, simulate

pytestmark = pytest.mark.slow

GEOMETRY, GRID = ConeGeometry(5.0, 7.5, (13, 18), (0.3, 0.23), (0.1, 0.2)), Grid((11, 12, 14), (0.18, 0.17, 0.14))
SPLATS = {
    "iterations": 3, "gaussians": 60, "tv_edge": 5, "parameter_terms_from": 0,
    "control": {"every": 0},  # whether one is split hangs on rounding where it stands at the threshold
}
RUNS = [
    ("phyradgs", {**SPLATS, "motion": "micro-views", "strips": 3, "sub_intervals": 2}, False),
    ("phyradgs", {**SPLATS, "motion": "exact"}, True), ("fdk", {"motion": "static"}, False),
    ("fdk", {"motion": "per-row"}, True), ("asd-pocs", {"iterations": 2, "motion": "static"}, False),
    ("fista-tv", {"iterations": 2, "motion": "static"}, False), ("changing", {"iterations": 2, "states": 2}, False),
    ("fista", {"iterations": 1, "motion": "per-row", "prior": "ridge"}, False),
    ("sirt", {"iterations": 2, "motion": "per-row"}, True),
]  # fmt: skip
gpu_like = cache(lambda: Runtime(lanes=1, pixel_items=True))
# An object that moves between two states during the scan.
FIELD = Deformation(
    0.1 * np.random.default_rng(0).normal(size=(2, 6, 6, 6, 3)), (-1.5,) * 3, 0.6, np.array([0.0, 16.0]), np.eye(2)
)


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    x = np.linspace(-1, 1, 14)
    ball = (x[None, None] ** 2 + x[None, 1:13, None] ** 2 + x[1:12, None, None] ** 2 < 0.6).astype(np.float32)
    options = SimulationOptions(Protocol(views=5, exposure_deg=20.0), "columns", detector_model="intensity", time_samples=3)
    return simulate(VolumeSource(rt, ball, GRID, GEOMETRY, "columns"), GEOMETRY, GRID, options)


@pytest.mark.parametrize(("name", "changes", "is_moving"), RUNS)
def test_methods(rt, scan, name, changes, is_moving) -> None:
    plan = plan_run(name, changes, object_motion=ObjectMotion(FIELD) if is_moving else None)
    found, expected = (reconstruct(scan, plan, of).volume for of in (gpu_like(), rt))
    assert np.linalg.norm(found - expected) <= LAUNCH_SHAPE * np.linalg.norm(expected)
