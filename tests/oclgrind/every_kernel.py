"""Runs every kernel, small and odd, on Oclgrind: `make test-oclgrind`. Not a test that pytest collects.

    python tests/oclgrind/every_kernel.py               all cases, a process each
    python tests/oclgrind/every_kernel.py BUILD CASE    one case; prints the kernels that it launched

Oclgrind interprets kernels and reports accesses outside of buffers, data races and reads of memory that nobody wrote. Its
log has to stay empty, and every kernel of cl/ has to have run. Each case has its own process, because Oclgrind 21.10
takes memory at an address that was freed for unwritten. Its min and max of a vector and a scalar are wrong beyond the first
lane, so that builds with vectors cannot be run on it. Its check for unwritten memory knows neither float3 nor the compiler's
"freeze", so that it is left out where kernels have them; bounds and races are checked in all.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import (
    CircularOrbit,
    ConeGeometry,
    ConstantSpeed,
    ParallelGeometry,
    Protocol,
    Scan,
    Shutter,
)
from phyradgs_cl.acquisition.cells import common_time_cells, exact_cells, micro_view_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.device_probes import PAIRS, carried, pair_error
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.operators import (
    DeviceCells,
    RayOperator,
    SplatProjection,
    SplatProjector,
    VoxelOperator,
    backproject,
    voxelise,
)
from phyradgs_cl.reconstructors import METHODS, ObjectMotion, plan_run, reconstruct
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.opencl import cl, kernel_source
from phyradgs_cl.simulation import SimulationOptions, VolumeSource, simulate

KERNELS = Path(__file__).resolve().parents[2] / "cl"
SHAPE, GRID = (5, 7), Grid((5, 6, 7), (0.3, 0.28, 0.25), (0.1, 0.0, -0.1))
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (3.9 / 5, 4.1 / 7), (0.1, 0.2))
ORBIT, COLUMNS = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 0.6)), Shutter(0.5, 0.4, "columns", -1)
SPLATTING = ("phyradgs", "r2")
NEURAL = ("naf", "sax-nerf")  # PyTorch, no kernel of ours
FREEZES = ("a GPU's", "a GPU's without float64")  # builds, and cases, in which unwritten memory cannot be looked for
NOT_INLINED = ("splat_prepare",)
# "moving": the last frame of move_rows counts as unwritten, though memory full of NaN comes back without one.
VECTORS_OR_FREEZES = ("moving", "asd-pocs", "fista", "phyradgs", "r2", "nothing", "operators")
BUILDS = {
    "lanes 1": {"lanes": 1}, "a GPU's": {"lanes": 1, "pixel_items": True},
    "float pairs": {"lanes": 1, "fp64": False},
    "a GPU's without float64": {"lanes": 1, "pixel_items": True, "fp64": False},
}


def filled_by_copy(self: Runtime, array: DeviceArray, value: float) -> None:
    """Oclgrind does not note that filled memory has been written; copied memory it does."""
    self.write(array, np.full(array.size, value, array.dtype))


def copied_by_host(
    self: Runtime, source: DeviceArray, target: DeviceArray, *,
    nbytes: int | None = None, source_offset: int = 0, target_offset: int = 0,
) -> None:
    """Nor memory that was copied on the device: the host takes it there."""
    count = source.nbytes if nbytes is None else nbytes
    values = self.download(target)
    taken = self.download(source).reshape(-1).view(np.uint8)[source_offset : source_offset + count]
    values.reshape(-1).view(np.uint8)[target_offset : target_offset + count] = taken
    self.write(target, values)


build = Runtime._build


def built_for_oclgrind(self: Runtime, program: str, options: tuple[str, ...]) -> "cl.Program":
    """Of these programs Oclgrind refuses the marks (llvm.experimental.noalias.scope.decl) that inlining leaves in loops."""
    if program not in NOT_INLINED:
        return build(self, program, options)
    source = kernel_source(program).replace("__attribute__((always_inline))", "")
    return cl.Program(self.context, source).build(options=[*options, "-cl-opt-disable"])


def cloud(count: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    quaternion = rng.normal(size=(4, count))
    parts = [
        rng.uniform(-0.6, 0.6, (3, count)), rng.uniform(0.05, 0.3, (3, count)),
        quaternion / np.linalg.norm(quaternion, axis=0), rng.uniform(0.5, 1.0, (1, count)),
    ]
    rows = np.concatenate(parts)
    rows[:3, :1] = [[40.0], [0.0], [0.0]]  # one behind the source
    return rows


OPTIONS = {"exact": {}, "affine, whole": {"affine": True, "cutoff_sigma": 0.0}, "intensity": {"intensity_unit": 2.0}}
MODELS: dict[str, Callable[..., TimeCells]] = {
    "still": static_cells, "micro-views": lambda *where: micro_view_cells(*where, 2, 2),
    "moving": lambda *where: exact_cells(*where, 2),
}


def splats(rt: Runtime, model: str, options: str) -> None:
    table = MODELS[model](ORBIT, COLUMNS, 0, 0.0, SHAPE[1])
    projector = SplatProjector(rt, SHAPE[1], SHAPE[0], **OPTIONS[options])  # type: ignore[arg-type]
    projector.project_adjoint(cloud(3), DeviceCells.upload(rt, table), np.ones(SHAPE[::-1], np.float32))


def operators(rt: Runtime) -> None:
    """Splats from and to plain arrays, as the Python API has them."""
    frames = SplatProjection(rt, SHAPE, [micro_view_cells(ORBIT, COLUMNS, f, 0.0, SHAPE[1], 2, 2) for f in (0, 1)], 0.7)
    point = frames.rows.enter(rt.upload(cloud(3), np.float32))
    frames.back(point, frames.forward(point))
    ones = frames.rows.with_densities(point, rt.upload(np.ones(3, np.float32)))
    frames.rows.densities(frames.back(point, frames.forward(ones)))
    voxels = VoxelOperator(rt, GRID)
    point = voxels.rows.enter(rt.upload(cloud(3), np.float32))
    voxels.back(point, voxels.forward(point))


def nothing(rt: Runtime) -> None:
    cells = DeviceCells.upload(rt, exact_cells(ORBIT, Shutter(0.5, 0.4, "rows", 1), 0, 0.0, SHAPE[0], 2))
    SplatProjector(rt, *SHAPE).project(np.zeros((11, 0)), cells)
    voxelise(rt, cloud(3), GRID)
    rt.launch(rt.kernel("rates", "multiply_add"), 4, np.int32(3), np.float32(0.5), rt.zeros(4))
    assert pair_error(rt) <= PAIRS and carried(rt)[0]


def upright(rt: Runtime, beam: str) -> None:
    """Detector columns of many rows, as CPUs project and backproject them: parallel to the axis, and leaning a little."""
    tall = (18, 3)
    cone, rays = ConeGeometry(5.0, 7.5, tall, (3.9 / 18, 4.1 / 3)), ParallelGeometry(tall, (2.6 / 18, 2.7 / 3))
    orbit = CircularOrbit(cone if beam == "cone" else rays, ConstantSpeed(0.3, 0.5))
    start_s, is_parallel = np.array([0.2, 1.7]), beam == "parallel"
    tables = [common_time_cells(orbit, Shutter(0.8, 0.6), f, start_s, tall[0], 2) for f in (0, 1)]
    leaning = [replace(table, pose=table.pose.copy()) for table in tables]
    for table in leaning:
        table.pose[:, 9:12] += 0.02 * table.pose[:, 6:9]
    frames = np.ones((2, *tall), np.float32)
    for some in (tables, leaning):
        operator = RayOperator(rt, GRID, tall, some)
        operator.adjoint(operator.forward(np.ones(GRID.shape, np.float32)))
        backproject(rt, frames, np.stack([table.pose[0] for table in some]), np.ones(2), GRID, is_parallel=is_parallel)


def tiny_scan(rt: Runtime, model: str, geometry: ConeGeometry | ParallelGeometry) -> Scan:
    volume = np.random.default_rng(0).uniform(0, 1, GRID.shape).astype(np.float32)
    axis = "rows" if model == "log" else "columns"
    source = VolumeSource(rt, volume, GRID, geometry, axis)
    protocol = Protocol(views=3, exposure_deg=20.0)
    options = SimulationOptions(protocol, axis, detector_model=model, time_samples=2)
    return simulate(source, geometry, GRID, options)


def method(rt: Runtime, name: str, motion: str, *, is_moving: bool = False, **more: object) -> None:
    """A method on a scan of three frames, in the intensity model where it follows the motion; or of an object that moves,
    every frame between two states."""
    geometry = ParallelGeometry(SHAPE, (2.6 / 5, 2.7 / 7)) if name == "fbp" else GEOMETRY
    scan = tiny_scan(rt, "log" if motion == "static" or is_moving else "intensity", geometry)
    control_mm = 0.1 * np.random.default_rng(0).normal(size=(2, 5, 5, 5, 3))
    moved = ObjectMotion(Deformation(control_mm, (-1.2,) * 3, 0.6, np.array([0.0, 14.0]), np.eye(2)))
    changes: dict[str, object] = {"motion": motion}
    if name in SPLATTING:
        control = {"every": 2, "start_iteration": 0, "threshold": 1e-9}
        changes |= {"gaussians": 6, "tv_edge": 4, "parameter_terms_from": 0, "iterations": 3, "control": control}
    elif name not in ("fdk", "fbp"):
        changes |= {"iterations": 1, **({"sub_intervals": 2} if motion == "per-row" else {})}
    reconstruct(scan, plan_run(name, {**changes, **more}, object_motion=moved if is_moving else None), rt)


def cases() -> dict[str, Callable[[Runtime], None]]:
    found: dict[str, Callable[[Runtime], None]] = {"nothing": nothing, "operators": operators}
    found |= {f"upright {beam}": partial(upright, beam=beam) for beam in ("cone", "parallel")}
    for model in MODELS:
        for options in OPTIONS:
            found[f"splats {model} {options}"] = partial(splats, model=model, options=options)
    for name in [name for name in METHODS if name not in NEURAL]:
        for motion in ("static", "exact" if name in SPLATTING else "per-row"):
            found[f"{name} {motion}"] = partial(method, name=name, motion=motion)
    for name, motion in (("fdk", "static"), ("fdk", "per-row"), ("sirt", "per-row"), ("phyradgs", "exact")):
        found[f"moving {name} {motion}"] = partial(method, name=name, motion=motion, is_moving=True)
    found["fista ridge"] = partial(method, name="fista", motion="static", prior="ridge", iterations=6)  # after five maps
    return found


def kernel_names() -> set[str]:
    sources = (path.read_text(encoding="utf-8") for path in KERNELS.glob("*.cl"))
    return {name for text in sources for name in re.findall(r"__kernel\s+void\s+(\w+)", text)}


def run_one(build: str, case: str) -> int:
    """One case in this process; the names of its kernels on stdout."""
    launched: set[str] = set()
    launch = Runtime.launch

    def noted(self: Runtime, kernel: object, *args: object, **options: object) -> None:
        launched.add(kernel.function_name)  # type: ignore[attr-defined]
        launch(self, kernel, *args, **options)  # type: ignore[arg-type]

    Runtime.launch, Runtime.fill = noted, filled_by_copy  # type: ignore[method-assign,assignment]
    Runtime.copy, Runtime._build = copied_by_host, built_for_oclgrind  # type: ignore[method-assign]
    cases()[case](Runtime("oclgrind", **BUILDS[build]))  # type: ignore[arg-type]
    print(" ".join(sorted(launched)))
    return 0


def checked(build: str, case: str, log: Path) -> tuple[set[str], str]:
    """Runs a case in its own process; returns its kernels, and Oclgrind's reports ("" if none)."""
    log.unlink(missing_ok=True)
    unwritten = build not in FREEZES and not case.startswith(VECTORS_OR_FREEZES)
    checks = {"OCLGRIND_DATA_RACES": "1", **({"OCLGRIND_UNINITIALIZED": "1"} if unwritten else {})}
    done = subprocess.run(
        [sys.executable, __file__, build, case], env={**os.environ, **checks, "OCLGRIND_LOG": str(log)},
        capture_output=True, text=True, timeout=600,
    )
    reports = log.read_text(encoding="utf-8") if log.exists() else ""
    if done.returncode:
        reports += f"ended with {done.returncode}: {done.stderr[-1500:]}"
    return set(done.stdout.split()), reports


def main() -> int:
    if len(sys.argv) == 3:
        return run_one(*sys.argv[1:])
    launched: set[str] = set()
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for build in BUILDS:
            for case in cases():
                kernels, reports = checked(build, case, Path(folder) / "log")
                launched |= kernels
                if reports:
                    bad += 1
                    print(f"{build}, {case}:\n{reports[:3000]}", flush=True)
            print(f"{build}: {len(cases())} cases", flush=True)
    missing = kernel_names() - launched
    if missing:
        print(f"not run: {', '.join(sorted(missing))}")
    print(f"{len(launched)} kernels, {bad} cases with reports")
    return int(bool(missing or bad))


if __name__ == "__main__":
    sys.exit(main())
