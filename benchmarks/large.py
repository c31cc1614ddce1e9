"""Compares large problems in bricks with the whole, in results, time and memory, past 2^31 voxels if the device holds them.

    python benchmarks/large.py [--quick] [--voxels 256] [--detector 512] [--views 4] [--gaussians 50000] [--memory 64MiB]
                               [--device D] [--json FILE]

It runs the ray-driven operators, FDK's backprojection and the voxeliser twice: first with all of the device's memory, then
with ``--memory`` for its bricks. Differences are the largest, over the largest value; 0 means equal bits. On a device with
buffers of more than 8 GiB, ``--voxels 1300`` has more than 2^31 voxels as a whole. 64-bit indices are then compared with
32-bit ones."""

import time
from collections.abc import Callable

import numpy as np
from measuring import Facts, finish, parser_of, random_cloud, where

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import static_cells
from phyradgs_cl.estimate import peak_host_bytes
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator, backproject, voxelise
from phyradgs_cl.runtime import Runtime, bytes_of


def calls(rt: Runtime, voxels: int, detector: int, views: int, gaussians: int) -> dict[str, Callable[[], np.ndarray]]:
    grid = Grid.cube(voxels, 2.0)
    geometry = ConeGeometry(5.0, 7.0, (detector, detector), (4.0 / detector,) * 2)
    orbit = CircularOrbit(geometry, ConstantSpeed(0.2, 2 * np.pi / views))
    tables = [static_cells(orbit, Shutter(0.0), f, float(f), detector) for f in range(views)]
    pose = np.concatenate([table.pose for table in tables])
    z, y, x = np.meshgrid(*[np.linspace(0, 1, voxels, dtype=np.float32)] * 3, indexing="ij", sparse=True)
    volume = np.sin(40 * x) * np.cos(30 * y) + z  # every brick differs
    frames = np.random.default_rng(0).uniform(0, 1, (views, detector, detector)).astype(np.float32)
    rows = random_cloud(gaussians, (0.01, 0.03), np.random.default_rng(0))
    return {
        "ray-driven forward": lambda: RayOperator(rt, grid, (detector,) * 2, tables).forward(volume),
        "ray-driven adjoint": lambda: RayOperator(rt, grid, (detector,) * 2, tables).adjoint(frames),
        "FDK backprojection": lambda: backproject(rt, frames, pose, np.ones(views), grid),
        "voxeliser": lambda: voxelise(rt, rows, grid),
    }


def measured(rt: Runtime, call: Callable[[], np.ndarray]) -> tuple[np.ndarray, Facts]:
    rt.reset_peak()
    started = time.perf_counter()
    values = call()
    seconds = time.perf_counter() - started
    return values, {"seconds": round(seconds, 3), "device_bytes": rt.peak_bytes}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--voxels", type=int, default=256, help="a side")
    parser.add_argument("--detector", type=int, default=512, help="pixels per side")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--memory", default="64MiB")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.voxels, arguments.detector, arguments.gaussians, arguments.memory = 64, 64, 1000, "1MiB"
    rt = Runtime(arguments.device)
    everything, limit = rt.ledger.limit_bytes, bytes_of(arguments.memory, "--memory")
    facts: Facts = where(rt) | {
        **{name: getattr(arguments, name) for name in ("voxels", "detector", "views", "gaussians")},
        "memory_bytes": limit,
        "largest_buffer_bytes": rt.device.largest_allocation_bytes,
    }
    runs: dict[str, Facts] = {}
    work = calls(rt, arguments.voxels, arguments.detector, arguments.views, arguments.gaussians)
    for name, call in work.items():
        call()  # this builds kernels
        whole, of_whole = measured(rt, call)
        rt.ledger.limit_bytes = limit
        bricks, of_bricks = measured(rt, call)
        rt.ledger.limit_bytes = everything
        difference = float(np.abs(bricks - whole).max() / np.abs(whole).max())
        runs[name] = {"whole": of_whole, "bricks": of_bricks, "relative_difference": difference}
    facts["runs"], facts["peak_host_bytes"] = runs, peak_host_bytes()
    finish(facts, arguments.json)


if __name__ == "__main__":
    main()
