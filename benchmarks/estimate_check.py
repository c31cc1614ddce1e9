"""Compares the time and peak memory that `phyradgs estimate` predicts with those of the run, by method.

    python benchmarks/estimate_check.py [--quick] [--size 64] [--methods phyradgs,r2,sirt] [--device D] [--json FILE]

Estimate and run are separate processes, one after the other. Ratios are prediction over measurement. Time is the wall time
of the whole process, with its start, reading, writing and comparing. Memory is the largest resident memory and the largest
sum of device buffers. On a CPU the resident memory includes the buffers."""

import json
import sys
import tempfile
import time
from pathlib import Path

from measuring import Facts, child, finish, foot_scan, parser_of, where

from phyradgs_cl.api import save_scan
from phyradgs_cl.estimate import estimate, peak_host_bytes, seconds_around
from phyradgs_cl.reconstructors import plan_run
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow import load_scan, run_reconstruction

RUNS: dict[str, tuple[str, Facts]] = {
    "fdk": ("fdk", {}),
    "sart": ("sart", {}),
    "sirt static": ("sirt", {"motion": "static"}),
    "sirt": ("sirt", {}),
    "cgls": ("cgls", {}),
    "asd-pocs": ("asd-pocs", {}),
    "fista-tv": ("fista-tv", {}),
    "fista": ("fista", {}),
    "r2": ("r2", {}),
    "phyradgs static": ("phyradgs", {"motion": "static"}),
    "phyradgs 8x5": ("phyradgs", {"motion": "micro-views"}),
    "phyradgs": ("phyradgs", {}),
}


def said(scan: Path, name: str, device: str | None, iterations: int | None) -> Facts:
    """Returns an estimate made in this process."""
    method, changes = changed(name, iterations)
    loaded, rt = load_scan(scan), Runtime(device)
    before_s = time.process_time()
    plan = plan_run(method, changes)
    found = estimate(loaded, plan, rt, around=lambda result: before_s + seconds_around(scan, loaded, result))
    return {"seconds": found.seconds, "host_bytes": found.host_bytes, "device_bytes": found.device_bytes}


def happened(scan: Path, name: str, device: str | None, iterations: int | None) -> Facts:
    """Returns the time and memory of a run in this process."""
    method, changes = changed(name, iterations)
    rt = Runtime(device)
    run_reconstruction(plan_run(method, changes), scan, scan.with_name("volume.h5"), lambda: rt)
    return {"host_bytes": peak_host_bytes(), "device_bytes": rt.peak_bytes}


def changed(name: str, iterations: int | None) -> tuple[str, Facts]:
    method, changes = RUNS[name]
    more = {} if iterations is None or method == "fdk" else {"iterations": iterations}
    return method, {**changes, **more}


def one(name: str, scan: Path, words: list[str]) -> Facts:
    predicted = child(__file__, "--child", "said", str(scan), name, *words)
    begun = time.perf_counter()
    taken = child(__file__, "--child", "happened", str(scan), name, *words)
    taken["seconds"] = time.perf_counter() - begun
    ratio = {key: predicted[key] / max(taken[key], 1e-9) for key in predicted}  # type: ignore[operator, call-overload]
    return {"method": name, "said": predicted, "happened": taken, "ratio": ratio}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--methods", default=",".join(RUNS))
    parser.add_argument("--iterations", type=int, default=None, help="else each method's own")
    parser.add_argument("--child", nargs=3, default=None, metavar=("WHAT", "SCAN", "METHOD"))
    arguments = parser.parse_args()
    if arguments.child:
        what, scan, name = arguments.child
        call = said if what == "said" else happened
        print(json.dumps(call(Path(scan), name, arguments.device, arguments.iterations)))
        return
    if arguments.quick:
        arguments.size, arguments.iterations = 16, arguments.iterations or 4
    names = arguments.methods.split(",")
    if unknown := set(names) - set(RUNS):
        sys.exit(f"no such method: {', '.join(sorted(unknown))}; there are {', '.join(RUNS)}")
    words = ["--device", arguments.device] if arguments.device else []
    words += ["--iterations", str(arguments.iterations)] if arguments.iterations else []
    facts = where(Runtime(arguments.device)) | {"size": arguments.size}
    with tempfile.TemporaryDirectory() as folder:
        scan = Path(folder) / "scan.h5"
        save_scan(scan, foot_scan(Runtime(arguments.device), arguments.size))
        facts["runs"] = [one(name, scan, words) for name in names]
    finish(facts, arguments.json)


if __name__ == "__main__":
    main()
