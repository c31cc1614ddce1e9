"""Methods as a GPU runs them, one work-item per pixel in groups the size of a sub-group, give what vectors of lanes give."""

import re
from pathlib import Path

import numpy as np
import pytest
from kernel_kit import CPU_ONLY, note_launches
from tolerances import LAUNCH_SHAPE

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.reconstructors import ObjectMotion, RunPlan, plan_run, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import SimulationOptions, VolumeSource, simulate

pytestmark = pytest.mark.slow

KERNELS = Path(__file__).resolve().parents[2] / "cl"
USERS_ARRAYS = {"rows_enter", "rows_leave", "row_copy"}  # no method has them; tests/test_device_check.py does, in this shape
GEOMETRY = ConeGeometry(5.0, 7.5, (13, 18), (0.3, 0.23), (0.1, 0.2))
GRID = Grid((11, 12, 14), (0.18, 0.17, 0.14))
SPLATS = {
    "iterations": 3, "gaussians": 60, "tv_edge": 5, "parameter_terms_from": 0,
    "control": {"every": 0},  # whether one is split hangs on rounding where it stands at the threshold
}
RUNS = [
    ("phyradgs", {**SPLATS, "motion": "exact"}),
    ("phyradgs", {**SPLATS, "motion": "micro-views", "strips": 3, "sub_intervals": 2}),
    ("r2", {**SPLATS, "motion": "static"}), ("fdk", {"motion": "static"}), ("fdk", {"motion": "per-row"}),
    ("asd-pocs", {"iterations": 2, "motion": "static"}), ("fista-tv", {"iterations": 2, "motion": "static"}),
    ("fista-tv", {"iterations": 1, "motion": "per-row"}),
    ("fista", {"iterations": 1, "motion": "per-row", "prior": "ridge"}),
    ("fista", {"iterations": 4, "motion": "static", "prior": "dct"}),
    ("changing", {"iterations": 2, "states": 2}),
    ("sirt", {"iterations": 2, "motion": "per-row", "moving": True}),
    ("phyradgs", {**SPLATS, "motion": "exact", "moving": True}), ("fdk", {"motion": "static", "moving": True}),
    ("fdk", {"motion": "per-row", "moving": True}),
]  # fmt: skip
# An object that moves between two states during the scan.
FIELD = Deformation(
    0.1 * np.random.default_rng(0).normal(size=(2, 6, 6, 6, 3)), (-1.5,) * 3, 0.6, np.array([0.0, 16.0]), np.eye(2)
)


def plan(name: str, changes: dict[str, object]) -> RunPlan:
    method = {key: value for key, value in changes.items() if key != "moving"}
    return plan_run(name, method, object_motion=ObjectMotion(FIELD) if "moving" in changes else None)


@pytest.fixture(scope="module")
def gpu_shaped(scan) -> tuple[list[np.ndarray], set[str]]:
    """The volumes of ``RUNS``, and the kernels that made them."""
    rt = Runtime(lanes=1, pixel_items=True, profile=True)
    with pytest.MonkeyPatch.context() as patch:
        launched = note_launches(patch)
        assert rt.best_rates().flops_per_s > 0  # launches multiply_add by itself
        volumes = [reconstruct(scan, plan(name, changes), rt).volume for name, changes in RUNS]
    return volumes, set(launched)


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    x = np.linspace(-1, 1, 14)
    ball = (x[None, None] ** 2 + x[None, 1:13, None] ** 2 + x[1:12, None, None] ** 2 < 0.6).astype(np.float32)
    protocol = Protocol(views=5, exposure_deg=20.0)
    options = SimulationOptions(protocol, "columns", detector_model="intensity", time_samples=3)
    return simulate(VolumeSource(rt, ball, GRID, GEOMETRY, "columns"), GEOMETRY, GRID, options)


def test_methods(rt, gpu_shaped, scan) -> None:
    for (name, changes), found in zip(RUNS, gpu_shaped[0], strict=True):
        expected = reconstruct(scan, plan(name, changes), rt).volume
        error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        assert error <= LAUNCH_SHAPE, (name, changes["motion"])


def test_every_kernel_runs_in_this_shape(gpu_shaped) -> None:
    """A kernel that is added has to be among those of ``RUNS``, or to be named as one for CPUs alone."""
    sources = (path.read_text(encoding="utf-8") for path in KERNELS.glob("*.cl"))
    known = {kernel for text in sources for kernel in re.findall(r"__kernel\s+void\s+(\w+)", text)}
    elsewhere = {"spread_subrays", "subray_means", "multiply_add", "probe_numbers", "probe_pairs"}  # with tests of their own
    assert known - gpu_shaped[1] - elsewhere == CPU_ONLY | USERS_ARRAYS
