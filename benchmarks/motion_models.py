"""Measures the quality of reconstructions by the splats' motion models.

    python benchmarks/motion_models.py VOLUMES RESULTS.jsonl [--size 64] [--names a,b] [--motions 8x5,static]

Motions are static, MxN (micro-views) and "exact BOUND". Scans are those of benchmarks/scans.py (rapid, rows, TIGRE's noise
at 1e4 photons and sigma 10). Runs in the file are not made again. benchmarks/time_exact.py has the errors and the cost of
one frame."""

from itertools import product

from scans import append, files_of, make_scan, read_lines, runs_parser

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime

MOTIONS = "static,4x3,8x5,16x7,exact 0.02,exact 0.01,exact 0.005,exact 0.002"
KEY = ("volume", "motion", "size", "seed", "iterations")
Line = dict[str, object]


def motion_of(name: str) -> dict[str, object]:
    """Returns the options of a motion by its name here."""
    if name.startswith("exact"):
        return {"motion": "exact", "time_error": float(name.split()[1])}
    if name == "static":
        return {"motion": "static"}
    strips, sub_intervals = (int(n) for n in name.split("x"))
    return {"motion": "micro-views", "strips": strips, "sub_intervals": sub_intervals}


def run_one(rt: Runtime, scan: Scan, motion: str, iterations: int, seed: int) -> Line:
    options = method_options("phyradgs", None, {**motion_of(motion), "iterations": iterations})
    result = reconstruct(scan, RunPlan("phyradgs", options, seed=seed), rt)
    facts = result.facts
    return {
        **compare(result.volume, scan.reference),
        "seconds": round(float(facts["seconds"]), 1),
        "gaussians": facts["gaussians"],
        "segments": facts.get("segments", 0),
        "device": rt.device.name,
    }


def main() -> None:
    parser = runs_parser(__doc__)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--motions", default=MOTIONS)
    asked = parser.parse_args()
    rt, size = Runtime(asked.device), asked.size
    done = {tuple(line[key] for key in KEY) for line in read_lines(asked.results)}
    files = files_of(asked.volumes, asked.names, size)
    for motion, seed, (name, path) in product(asked.motions.split(","), asked.seeds, files.items()):
        values = (name, motion, size, seed, asked.iterations)
        if values not in done:
            line = run_one(rt, make_scan(rt, path, size, seed), motion, asked.iterations, seed)
            append(asked.results, dict(zip(KEY, values, strict=True)) | line)


if __name__ == "__main__":
    main()
