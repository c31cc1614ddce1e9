"""Objects that breathe during a scan, reconstructed at rest, with the true field, and as if they rested.

    python benchmarks/moving.py VOLUMES RESULTS.jsonl [--names a,b] [--views 75,150] [--method fista] [--size 64]

Volumes and scanner as benchmarks/scans.py has them: TIGRE's noise at 1e4 photons, a gantry that turns without stopping,
exposures without gaps. A turn takes a minute. The breath has a period of 4 s, jittered by 10 %, and an amplitude of 15 % of
half the box. PSNR and SSIM against the reference volume; seconds of processor time. A run goes on where it was interrupted:
a line for each volume, number of views, method and case."""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

from scans import append, files_of, read_lines

from phyradgs_cl import api
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import ObjectMotion, RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation.object_motion import ObjectMotion as Breathing

TURN_S = 60.0
CASES = ("rest", "known", "ignored")


def breathing_scan(rt: Runtime, path: Path, size: int, views: int, amplitude: float) -> Scan:
    """The scan of a volume file; with an amplitude of 0 the same scan of the object at rest."""
    motion = Breathing("breathing", amplitude=amplitude)
    return api.simulate(
        str(path), size=size, detector=2 * size, views=views, exposure_deg=360 / views, fps=views / TURN_S, noise="tigre",
        dose=1e4, motion_of_object=motion, device=rt,
    )  # fmt: skip


def run_case(rt: Runtime, scan: Scan, case: str, method: str) -> dict[str, float]:
    """PSNR, SSIM, seconds and MiB in buffers of one reconstruction."""
    motion = "exact" if method in ("phyradgs", "fused") else "per-row"
    plan = RunPlan(method, method_options(method, None, {"motion": motion}))
    if case == "known":
        plan = replace(plan, object_motion=ObjectMotion(scan.moving_truth.deformation))
    rt.reset_peak()
    started = time.process_time()
    result = reconstruct(scan, plan, rt)
    seconds = time.process_time() - started
    return {**compare(result.volume, scan.reference), "seconds": round(seconds, 1), "device_mib": rt.peak_bytes >> 20}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--names")
    parser.add_argument("--views", default="75")
    parser.add_argument("--method", default="fista")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--device")
    arguments = parser.parse_args()
    rt, done = Runtime(arguments.device), {key_of(line) for line in read_lines(arguments.results)}
    for name, path in files_of(arguments.volumes, arguments.names, arguments.size).items():
        for views in (int(n) for n in arguments.views.split(",")):
            scans: dict[bool, Scan] = {}
            for case in CASES:
                facts = {"volume": name, "views": views, "method": arguments.method, "case": case, "size": arguments.size}
                if key_of(facts) in done:
                    continue
                moves = case != "rest"
                if moves not in scans:
                    scans[moves] = breathing_scan(rt, path, arguments.size, views, 0.15 if moves else 0.0)
                line = {**facts, **run_case(rt, scans[moves], case, arguments.method), "device": rt.device.name}
                append(arguments.results, line)
                print(json.dumps(line), flush=True)


def key_of(line: dict[str, object]) -> tuple[object, ...]:
    return tuple(line[key] for key in ("volume", "views", "method", "case", "size"))


if __name__ == "__main__":
    main()
