"""Processor time of the voxel methods beside another checkout's, and what crosses the bus in an iteration.

    python benchmarks/resident.py OTHER [--pairs N] [--json docs/results/resident.json] [--quick] [--device D]

OTHER is the folder of another checkout. A fly-scan of the jaw, 25 frames of 256² on 128³ voxels, each line at its own times,
is made once; then both checkouts reconstruct it in turns, each run in a process of its own. Figures are processor seconds of
an iteration over all threads (the first one, which builds kernels, and the set-up excepted), the least of all pairs, and the
median of the ratios pair by pair, which a busy machine spoils less than seconds.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve()
ITERATIONS = {"fista-tv": 2, "asd-pocs": 1, "sirt": 2}  # after the first


def run(method: str, scan_file: str, iterations: int, device: str | None) -> dict[str, float]:
    """Processor seconds and bytes over the bus per iteration of one run, by whichever package is imported."""
    from phyradgs_cl.api import load_scan
    from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
    from phyradgs_cl.runtime import Runtime

    rt = Runtime(device)
    marks: list[tuple[float, float]] = []

    def report(progress: object) -> None:
        traffic = getattr(rt, "traffic", None)
        marks.append((time.process_time(), traffic.bytes_up + traffic.bytes_down if traffic else float("nan")))

    options = method_options(method, None, {"motion": "per-row", "iterations": iterations + 1})
    started = time.process_time()
    reconstruct(load_scan(scan_file), RunPlan(method, options), rt, report=report)
    (first_s, first_bytes), (last_s, last_bytes) = marks[0], marks[-1]
    return {
        "iteration_s": (last_s - first_s) / iterations,
        "whole_s": time.process_time() - started,
        "iteration_bytes": (last_bytes - first_bytes) / iterations,
    }


def in_checkout(root: Path, *words: str) -> dict[str, float]:
    """``run`` in a process that imports the package of a checkout."""
    command = [sys.executable, str(HERE), "--child", *words]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    found: dict[str, float] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def make_scan(path: Path, voxels: int, pixels: int) -> None:
    from phyradgs_cl.acquisition import ConeGeometry, make_protocol
    from phyradgs_cl.fields import Grid
    from phyradgs_cl.io import write_scan
    from phyradgs_cl.runtime import Runtime
    from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4 / pixels, 4 / pixels))
    scene = phantom_scene(Runtime(), "jaw", geometry, Grid.cube(voxels, 2.0), voxels, "rows", 0)
    protocol = make_protocol("rapid", views=25, exposure_deg=14.4)
    options = SimulationOptions(protocol=protocol, time_samples=2)
    write_scan(path, simulate(scene.source, geometry, scene.grid, options))


def main() -> None:
    from measuring import finish, median, parser_of, where

    parser = parser_of(__doc__ or "")
    parser.add_argument("other", type=Path)
    parser.add_argument("--pairs", type=int, default=3)
    chosen = parser.parse_args()
    from phyradgs_cl.runtime import Runtime

    facts: dict[str, object] = where(Runtime(chosen.device))
    sizes = (24, 32) if chosen.quick else (128, 256)
    facts["voxels"], facts["pixels"] = sizes
    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.h5"
        make_scan(scan, *sizes)
        for method, iterations in ITERATIONS.items():
            words = (method, str(scan), str(iterations), chosen.device or "")
            pairs = []
            for _ in range(chosen.pairs):
                pairs.append([in_checkout(root, *words) for root in (chosen.other.resolve(), HERE.parents[1])])
            facts[method] = {
                "other_iteration_s": min(other["iteration_s"] for other, _ in pairs),
                "iteration_s": min(own["iteration_s"] for _, own in pairs),
                "ratio": median([other["iteration_s"] / own["iteration_s"] for other, own in pairs]),
                "whole_ratio": median([other["whole_s"] / own["whole_s"] for other, own in pairs]),
                "iteration_bytes": pairs[0][1]["iteration_bytes"],
            }
    finish(facts, chosen.json)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        method, scan_file, count, device = sys.argv[2:]
        print(json.dumps(run(method, scan_file, int(count), device or None)))
    else:
        main()
