"""Measures how far two devices differ: operators and short runs are kept from one device and compared on another.

    python benchmarks/across_devices.py store FILE.npz [--device D]
    python benchmarks/across_devices.py compare FILE.npz [--device D] [--json FILE]

NumPy draws the inputs from fixed seeds, so both devices see the same bits. The largest differences are printed. For images
and volumes they are relative to the largest number, for gradients they are the norm of the difference over the norm. Of
place, scale, rotation and density the worst counts."""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Scan, Shutter
from phyradgs_cl.acquisition.cells import exact_cells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.api import simulate
from phyradgs_cl.fields import Activation, Grid
from phyradgs_cl.objective import ImageLoss, TotalVariation, TvDescent, TvProx
from phyradgs_cl.operators import (
    DeviceCells,
    RayOperator,
    SplatProjector,
    backproject,
    backproject_lines,
    voxelise,
)
from phyradgs_cl.operators.splats.voxelise import Voxeliser
from phyradgs_cl.optim import DeviceAdam
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows, pitch_of, unpad_rows

SHAPE = (61, 70)
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (3.9 / 61, 4.1 / 70), (0.1, 0.2))
GRID = Grid((31, 34, 37), (2.1 / 31, 2.2 / 34, 2.3 / 37), (0.02, 0.0, -0.03))
MOTIONS: dict[str, Callable[..., TimeCells]] = {
    "at rest": static_cells,
    "micro-views": lambda *where: micro_view_cells(*where, 6, 3),
    "per line": lambda *where: per_line_cells(*where, 3),
    "moving": lambda *where: exact_cells(*where, 4),
}
RUNS = {
    "fdk": {},
    "sirt": {"iterations": 20, "motion": "per-row"},
    "cgls": {"iterations": 20, "noise_stop": 0.0},
    "os-sart": {"iterations": 5},
    "fista-tv": {"iterations": 20},
    "asd-pocs": {"iterations": 5},
    "phyradgs": {"iterations": 60, "gaussians": 200, "control": {"start_iteration": 1000}},
}
Results = dict[str, np.ndarray]


def cells_of(motion: str, frame: int = 0) -> TimeCells:
    orbit, shutter = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 0.6)), Shutter(0.5, 0.4, "rows", 1)
    return MOTIONS[motion](orbit, shutter, frame, 1.9 * frame, SHAPE[0])


def cloud(count: int, aspect: float, seed: int) -> np.ndarray:
    """Returns rows (11, G) of Gaussians. The smallest axes are half a pixel to four, the longest up to ``aspect`` times
    that."""
    rng = np.random.default_rng(seed)
    pixel = GEOMETRY.pixel_size_mm[0] / GEOMETRY.magnification
    quaternion = rng.normal(size=(4, count))
    smallest = pixel * np.exp(rng.uniform(np.log(0.5), np.log(4.0 if aspect < 100 else 0.6), count))
    parts = [
        rng.uniform(-0.6, 0.6, (3, count)),
        rng.permuted(
            np.stack([smallest, smallest * aspect ** rng.uniform(size=count), smallest * aspect]), axis=0
        ),
        quaternion / np.linalg.norm(quaternion, axis=0),
        rng.uniform(0.5, 2.0, (1, count)),
    ]
    return np.concatenate(parts).astype(np.float32).astype(np.float64)


def splats(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    h = np.random.default_rng(1).normal(size=SHAPE).astype(np.float32)
    for motion in ("at rest", "micro-views", "moving"):
        cells = DeviceCells.upload(rt, cells_of(motion))
        for kind, aspect in (("compact", 5.0), ("needles", 1000.0)):
            rows = cloud(40 if kind == "compact" else 4, aspect, 2)
            whole = SplatProjector(rt, *SHAPE, cutoff_sigma=0.0)
            yield f"splats {motion}, {kind}", whole.project(rows, cells)
            if kind == "compact":
                yield f"splats {motion}, gradient", whole.project_adjoint(rows, cells, h)
                yield f"splats {motion}, cut off as in runs", SplatProjector(rt, *SHAPE).project(rows, cells)


def voxels(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    by = np.random.default_rng(3).normal(size=GRID.shape).astype(np.float32)
    rows, needles = cloud(40, 5.0, 4), cloud(4, 1000.0, 4)
    yield "voxels, compact", voxelise(rt, rows, GRID, cutoff_sigma=0.0)
    yield "voxels, needles", voxelise(rt, needles, GRID, cutoff_sigma=0.0)
    yield "voxels, gradient", Voxeliser(rt, GRID.shape, cutoff_sigma=0.0).voxelise_adjoint(rows, GRID, by)


def rays(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    rng = np.random.default_rng(5)
    for motion in ("at rest", "micro-views", "per line"):
        operator = RayOperator(rt, GRID, SHAPE, [cells_of(motion, frame) for frame in range(3)])
        yield f"rays forward, {motion}", operator.forward(rng.uniform(0, 1, GRID.shape).astype(np.float32))
        yield f"rays back, {motion}", operator.adjoint(rng.uniform(0, 1, (3, *SHAPE)).astype(np.float32))


def backprojections(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    rng, angles = np.random.default_rng(6), np.array([0.0, 1.3, 2.9, 4.4])
    frames, weight = rng.uniform(-1, 1, (4, *SHAPE)).astype(np.float32), rng.uniform(0.5, 1, 4)
    yield "backprojection of FDK", backproject(rt, frames, GEOMETRY.pose(angles), weight, GRID)
    lines = np.stack([GEOMETRY.pose(a + np.linspace(-0.1, 0.1, SHAPE[0])) for a in angles])
    yield "backprojection of FDK, per line", backproject_lines(rt, frames, lines, weight, GRID)


def terms(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    rng = np.random.default_rng(7)
    rendered, measured = rng.uniform(0, 1, (2, *SHAPE)).astype(np.float32)
    loss, ones = ImageLoss(rt, *SHAPE, pitch_of(SHAPE[1]), 0.2), np.ones(SHAPE, np.float32)
    arrays = [rt.upload(pad_rows(image)) for image in (rendered, measured, ones)]
    yield "image terms, gradient", unpad_rows(rt.download(loss.evaluate(*arrays, float(ones.size))), SHAPE)
    yield "image terms, value", np.array([loss.value()])
    volume = rng.normal(size=GRID.shape).astype(np.float32)
    tv = TotalVariation(rt, GRID.shape, pitch_of(GRID.shape[2]))
    yield (
        "total variation, gradient",
        unpad_rows(rt.download(tv.evaluate(rt.upload(pad_rows(volume)))), GRID.shape),
    )
    yield "total variation, value", np.array([tv.value()])
    yield "proximal map of TV", TvProx(rt, GRID.shape)(volume, 0.3, 12, nonnegative=True)
    yield "descent of TV", TvDescent(rt, GRID.shape)(volume, 0.05, 5)


def adam(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    """Yields how far six steps went from numbers near 1."""
    rng, start = np.random.default_rng(8), np.ones((11, 64), np.float32)
    raw, moments, optimiser = rt.upload(start), rt.zeros((2, 11, 64)), DeviceAdam(rt, Activation(0.01, 0.5))
    for step in range(1, 7):
        gradients = rt.upload(rng.normal(size=(13, 64)).astype(np.float32))
        optimiser.step(raw, gradients, moments, 64, np.full(11, 1e-2), step)
    yield "Adam, six steps", rt.download(raw) - start


def a_scan(rt: Runtime) -> Scan:
    """Returns a scan of closed-form frames, made without a device."""
    return simulate(
        "shepp-logan", size=24, detector=32, views=12, exposure_deg=10.0, time_samples=2, device=rt
    )


def runs(rt: Runtime) -> Iterator[tuple[str, np.ndarray]]:
    scan = replace(a_scan(rt), reference=None)
    yield "frames of the scan, made without a device", scan.projections
    for method, changes in RUNS.items():
        options = method_options(method, None, changes)
        yield (
            f"run of {method}, {changes.get('iterations', 1)}",
            reconstruct(scan, RunPlan(method, options, seed=0), rt).volume,
        )


def results(rt: Runtime) -> Results:
    parts = (splats, voxels, rays, backprojections, terms, adam, runs)
    return {name: np.asarray(values) for part in parts for name, values in part(rt)}


def difference(name: str, one: np.ndarray, other: np.ndarray) -> float:
    """Returns the difference over the largest number. For gradients of Gaussians (11, G), each row is over its own norm."""
    gap = one.astype(np.float64) - other
    if name.endswith("gradient") and one.ndim == 2 and len(one) == 11:
        norms = [
            np.linalg.norm(gap[rows]) / np.linalg.norm(one[rows])
            for rows in ([0, 1, 2], [3, 4, 5], [6, 7, 8, 9], [10])
        ]
        return float(max(norms))
    return float(np.abs(gap).max() / np.abs(one).max())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("act", choices=("store", "compare"))
    parser.add_argument("file", type=Path, help="what the other device found")
    parser.add_argument("--device", default=None, help="as for phyradgs")
    parser.add_argument("--lanes", type=int, default=None, help="another vector width than the device's own")
    parser.add_argument("--json", type=Path, default=None, help="file for the differences")
    asked = parser.parse_args()
    rt = Runtime(asked.device, lanes=asked.lanes)
    here = f"{rt.device.name}, {rt.device.version}, vectors of {rt.lanes}"
    found = results(rt)
    if asked.act == "store":
        np.savez_compressed(asked.file, device=np.array(here), **found)
        return
    with np.load(asked.file) as stored:
        there = str(stored["device"])
        apart = {name: difference(name, stored[name], values) for name, values in found.items()}
    print(f"{there}\n{here}")
    for name, value in apart.items():
        print(f"{value:10.1e}  {name}")
    if asked.json is not None:
        asked.json.write_text(json.dumps({"devices": [there, here], "differences": apart}, indent=1) + "\n")


if __name__ == "__main__":
    main()
