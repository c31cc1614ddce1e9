"""Tests and times the program on a GPU in at most ten minutes (`make gpu`): tests, trust, the same bits twice, and speed.

    python benchmarks/gpu.py [--device gpu] [--quick] [--json FILE] [--table FILE]

There is one results file and one table, both with the device's name. A part that fails is noted and does not end the others.
A CPU runs in a GPU's launch shape, so that everything can be tried anywhere (with --quick: smaller)."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from measuring import Facts, finish, foot_scan, parser_of, splat_run, where

from phyradgs_cl.acquisition import ConeGeometry, Exact, Scan, make_protocol
from phyradgs_cl.device_check import check_device
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import DEVICE_VARIABLE, Runtime, choose_device
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

ROOT = Path(__file__).resolve().parents[1]
TESTS = ("tests/operators", "tests/objective", "tests/optim", "tests/runtime", "tests/reconstructors/test_gpu_shape.py")
TESTS_S, RUN_S = 200, 30  # longest time of the tests, and of each long run
# The goals for a GPU in time.
GOALS = {"iteration_ms": "≤ 4", "run_s": "≤ 20", "fista_tv_s": "≤ 10", "fdk_gups": "≥ 100"}


def tests(device: str, quick: bool) -> Facts:
    """Runs the kernel tests on the device. Returns the last line that pytest prints."""
    chosen = TESTS[2:3] if quick else TESTS
    shared = ["-n", "auto"] if find_spec("xdist") else []  # most of a test's time is its twin's, on the host
    command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", *shared, *chosen]
    environment = {**os.environ, DEVICE_VARIABLE: device}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TESTS_S)
    lines = done.stdout.strip().splitlines() or [done.stderr[-300:]]
    failed = [line.partition(" - ")[0] for line in lines if line.startswith(("FAILED", "ERROR"))]
    return {"tests": lines[-1], "tests_failed": failed}


def trust(device: str, shape: dict[str, object]) -> Facts:
    verdict = check_device(device, **shape)  # type: ignore[arg-type]
    return {"trusted": not verdict.failures, "verdict": str(verdict)}


def same_bits(rt: Runtime, quick: bool) -> Facts:
    """Returns whether two runs of every kind of method give the same bits."""
    scan, count = foot_scan(rt, 12 if quick else 64), 200 if quick else 5000
    different = []
    runs: dict[str, dict[str, object]] = {
        "phyradgs": {"gaussians": count, "iterations": count // 50},
        "fista-tv": {"iterations": 3, "motion": "per-row"}, "fdk": {},
    }  # fmt: skip
    for method, changes in runs.items():
        options = method_options(method, None, changes)
        first, second = (reconstruct(scan, RunPlan(method, options), rt).volume for _ in range(2))
        if not np.array_equal(first, second):
            different.append(method)
    return {"same_bits": not different, "different": different}


def splats(rt: Runtime, quick: bool) -> Facts:
    """Measures exact motion with 512² pixels and 50,000 Gaussians: ms of an iteration, kernels' shares, s of 3,000."""
    pixels, count = (32, 300) if quick else (512, 50_000)
    run = splat_run(rt, foot_scan(rt, pixels // 2), SplatOptions(motion=Exact(), gaussians=count))
    for _ in range(5):
        run.step()
    rt.kernel_uses()
    steps, started, before = 3 if quick else 20, time.perf_counter(), rt.traffic.blocking
    for _ in range(steps):
        run.step()
    waits = rt.traffic.blocking - before
    rt.finish()
    iteration_s = (time.perf_counter() - started) / steps
    kernels_ms = {name: round(1e3 * use.seconds / steps, 4) for name, use in rt.kernel_uses().items()}
    started, done = time.perf_counter(), 0
    while done < 3000 and time.perf_counter() - started < (0.1 if quick else RUN_S):
        for _ in range(10):
            run.step()
        rt.finish()
        done += 10
    run_s = (time.perf_counter() - started) * 3000 / done
    return {
        "pixels": pixels, "gaussians": count, "iteration_ms": round(1e3 * iteration_s, 3), "kernels_ms": kernels_ms,
        "waits_per_iteration": waits / steps, "run_s": round(run_s, 2), "run_iterations": done,
    }  # fmt: skip


def jaw(rt: Runtime, voxels: int, pixels: int) -> Scan:
    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4 / pixels, 4 / pixels))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(voxels, 2.0), voxels, "rows", 0)
    protocol = make_protocol("rapid", views=25, exposure_deg=14.4)
    return simulate(scene.source, geometry, scene.grid, SimulationOptions(protocol=protocol, time_samples=2))


def fista_tv(rt: Runtime, quick: bool) -> Facts:
    """Measures FISTA-TV with a pose per row, 256³ from 25 × 512²: seconds of 100 iterations, from as many as time allows."""
    scan = jaw(rt, *((24, 32) if quick else (256, 512)))
    marks: list[float] = []

    def run(iterations: int) -> float:
        marks.clear()
        options = method_options("fista-tv", None, {"motion": "per-row", "iterations": iterations})
        started = time.perf_counter()
        reconstruct(scan, RunPlan("fista-tv", options), rt, report=lambda progress: marks.append(time.perf_counter()))
        return time.perf_counter() - started

    run(2)  # this builds kernels
    each_s = marks[1] - marks[0]
    iterations = int(np.clip((1 if quick else RUN_S) / max(each_s, 1e-9), 2, 100))
    whole_s = run(iterations)
    each_s = (marks[-1] - marks[0]) / (iterations - 1)
    return {"fista_tv_s": round(whole_s + (100 - iterations) * each_s, 2), "fista_tv_iterations": iterations}


def fdk(rt: Runtime, quick: bool) -> Facts:
    """Measures FDK's backprojection from device to device: 512³ from 360 × 512², in 10⁹ voxel updates per second."""
    voxels, views, pixels = (48, 16, 64) if quick else (512, 360, 512)
    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4 / pixels, 4 / pixels))
    pose, weight = geometry.pose(np.linspace(0, 2 * np.pi, views, endpoint=False)), np.ones(views)
    frames = rt.upload(np.random.default_rng(0).uniform(0, 1, (views, pixels, pixels)), np.float32)
    seconds = []
    for _ in range(3):
        rt.finish()
        started = time.perf_counter()
        backproject(rt, frames, pose, weight, Grid.cube(voxels, 2.0))
        rt.finish()
        seconds.append(time.perf_counter() - started)
    return {"fdk_gups": round(voxels**3 * views / min(seconds[1:]) / 1e9, 3), "fdk_voxels": voxels, "fdk_views": views}


def table(facts: Facts) -> str:
    """Returns the results as a Markdown table."""
    rows = [
        ("kernels against float64", facts.get("verdict"), "all agree"),
        ("kernel tests", facts.get("tests"), "all pass"),
        ("the same bits twice", "yes" if facts.get("same_bits") else "no", "yes"),
        (f"iteration, {facts.get('pixels')}², {facts.get('gaussians')} Gaussians, exact: ms", facts.get("iteration_ms"),
         GOALS["iteration_ms"]),
        (f"3,000 iterations (of which run: {facts.get('run_iterations')}): s", facts.get("run_s"), GOALS["run_s"]),
        (f"FISTA-TV per-row, 100 iterations (of which run: {facts.get('fista_tv_iterations')}): s", facts.get("fista_tv_s"),
         GOALS["fista_tv_s"]),
        (f"FDK, {facts.get('fdk_voxels')}³ from {facts.get('fdk_views')} views: GUPS", facts.get("fdk_gups"),
         GOALS["fdk_gups"]),
    ]  # fmt: skip
    size = " (small, to see that it runs)" if facts["quick"] else ""
    head = f"| {facts['device']}{size} | found | goal |\n|---|---|---|\n"
    return head + "".join(f"| {what} | {found} | {goal} |\n" for what, found, goal in rows)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--table", type=Path, default=None, help="file for the table")
    asked = parser.parse_args()
    device, _ = choose_device(asked.device)
    wish = str(device.index)
    shape: dict[str, object] = {} if device.kind == "gpu" else {"lanes": 1, "pixel_items": True}
    rt = Runtime(wish, profile=True, **shape)  # type: ignore[arg-type]
    facts: Facts = where(rt) | {"quick": asked.quick}
    parts: dict[str, Callable[[], Facts]] = {
        "trust": partial(trust, wish, shape), "tests": partial(tests, wish, asked.quick),
        "same bits": partial(same_bits, rt, asked.quick), "splats": partial(splats, rt, asked.quick),
        "fista-tv": partial(fista_tv, rt, asked.quick), "fdk": partial(fdk, rt, asked.quick),
    }  # fmt: skip
    errors: dict[str, str] = {}
    for name, part in parts.items():
        started = time.perf_counter()
        try:
            facts |= part()
        except Exception as error:  # a driver may raise anything; the other parts should still run
            errors[name] = f"{type(error).__name__}: {error}"
        print(f"{name}: {time.perf_counter() - started:.0f} s {errors.get(name, '')}", file=sys.stderr, flush=True)
    facts["errors"] = errors
    finish(facts, asked.json)
    text = table(facts)
    print(text)
    if asked.table is not None:
        asked.table.write_text(text, encoding="utf-8")
    right = facts.get("trusted") and facts.get("same_bits") and not facts.get("tests_failed")
    return 0 if right and not errors else 1


if __name__ == "__main__":
    sys.exit(main())
