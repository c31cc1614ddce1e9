"""Measures accuracy and cost of the splats' motion models: quality of reconstructions, time per iteration, and a figure.

    python benchmarks/motion_models.py run VOLUMES RESULTS.jsonl [--size 64] [--names a,b] [--motions 8x5,static]
    python benchmarks/motion_models.py cost COST.json [--size 64]
    python benchmarks/motion_models.py figure RESULTS.jsonl COST.json TIME_EXACT.json FIGURE.png

Motions are static, MxN (micro-views) and "exact BOUND". ``run`` scans the volumes as benchmarks/scans.py does (rapid, rows,
TIGRE's noise at 1e4 photons and sigma 10), and continues where it stopped. ``cost`` times whole iterations without density
control on one scan of the foot phantom, as the median over rounds in which all motions take turns. benchmarks/time_exact.py
writes TIME_EXACT.json, the errors of one frame."""

import argparse
import json
import statistics
import sys
import time
from argparse import Namespace
from pathlib import Path

import numpy as np
from measuring import foot_scan, splat_run
from scans import append, files_of, make_scan, read_lines, runs_parser

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.runtime import Runtime

MOTIONS = "static,4x3,8x5,16x7,exact 0.02,exact 0.01,exact 0.005,exact 0.002"
REFERENCE = "8x5"

Line = dict[str, object]


def motion_of(name: str) -> dict[str, object]:
    """Returns the options of a motion by its name here."""
    if name.startswith("exact"):
        return {"motion": "exact", "time_error": float(name.split()[1])}
    if name == "static":
        return {"motion": "static"}
    strips, sub_intervals = (int(n) for n in name.split("x"))
    return {"motion": "micro-views", "strips": strips, "sub_intervals": sub_intervals}


# --- quality ----------------------------------------------------------------------------------------------------


def run(arguments: Namespace) -> None:
    rt = Runtime(arguments.device)
    results = arguments.results
    volumes = files_of(arguments.volumes, arguments.names, arguments.size)
    done = {key_of(line) for line in read_lines(results)}
    for motion in arguments.motions.split(","):
        for seed in arguments.seeds:
            for name, path in volumes.items():
                facts: Line = {
                    "volume": name,
                    "motion": motion,
                    "size": arguments.size,
                    "seed": seed,
                    "iterations": arguments.iterations,
                }
                if key_of(facts) in done:
                    continue
                scan = make_scan(rt, path, arguments.size, seed)
                append(results, {**facts, **run_one(rt, scan, motion, arguments.iterations, seed)})


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


def key_of(line: Line) -> tuple[object, ...]:
    return tuple(line[k] for k in ("volume", "motion", "size", "seed", "iterations"))


def means(lines: list[Line], size: int) -> dict[str, dict[str, tuple[float, float]]]:
    """Returns (PSNR dB, SSIM) by motion and volume, as means over seeds."""
    groups: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for line in lines:
        if line["size"] == size:
            runs = groups.setdefault(str(line["motion"]), {}).setdefault(str(line["volume"]), [])
            runs.append((float(line["psnr_db"]), float(line["ssim"])))  # type: ignore[arg-type]
    return {
        motion: {volume: tuple(np.mean(runs, axis=0)) for volume, runs in volumes.items()}
        for motion, volumes in groups.items()
    }  # type: ignore[return-value]


# --- cost -------------------------------------------------------------------------------------------------------


def cost(arguments: Namespace) -> dict[str, object]:
    """Returns median milliseconds per iteration by motion, and the ratio to ``REFERENCE``."""
    rt = Runtime(arguments.device)
    scan = foot_scan(rt, arguments.size)
    runs = {name: fresh_run(rt, scan, name) for name in arguments.motions.split(",")}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(arguments.rounds):
        for name, one in runs.items():
            started = time.perf_counter()
            for _ in range(arguments.steps):
                one.step()
            rt.finish()
            times[name].append(1e3 * (time.perf_counter() - started) / arguments.steps)
    median = {name: statistics.median(values) for name, values in times.items()}
    rows = {name: {"ms": ms, "ratio": ms / median[REFERENCE]} for name, ms in median.items()}
    return {"device": rt.device.name, "size": arguments.size, "motions": rows}


def fresh_run(rt: Runtime, scan: Scan, name: str) -> SplatRun:
    """Returns a reconstruction after 200 iterations. From there on its cost hardly changes."""
    options = method_options("phyradgs", None, motion_of(name))
    started = splat_run(rt, scan, options)
    for _ in range(200):
        started.step()
    return started


# --- figure -----------------------------------------------------------------------------------------------------


def figure(lines: list[Line], costs: dict, errors: dict, path: Path) -> None:
    """Draws the error of a frame and the PSNR of a reconstruction over the time of an iteration, by motion."""
    from matplotlib.figure import Figure

    size = int(costs["size"])
    found = means(lines, size)
    volumes = sorted(set.intersection(*(set(found[m]) for m in found)))
    drawing = Figure(figsize=(10, 4), layout="constrained")
    left, right = drawing.subplots(1, 2)
    time_ms = {name: row["ms"] for name, row in costs["motions"].items()}
    panels = ((left, frame_errors(errors)), (right, psnrs(found, volumes)))
    for exact, colour, label in ((False, "#b3261e", "micro-views"), (True, "#2b5c8a", "exact in time")):
        family = [m for m in time_ms if m != "static" and m.startswith("exact") == exact]
        for axes, values in panels:
            names = sorted((m for m in family if m in values), key=time_ms.__getitem__)
            points = [(time_ms[m], values[m]) for m in names]
            axes.plot(*zip(*points, strict=True), "o-", color=colour, label=label)
            for name, at in zip(names, points, strict=True):
                text = name.removeprefix("exact ")
                axes.annotate(text, at, xytext=(4, 4), textcoords="offset points", fontsize=8)
    for axes, values in ((left, frame_errors(errors)), (right, psnrs(found, volumes))):
        if "static" in values and "static" in costs["motions"]:
            axes.plot(
                costs["motions"]["static"]["ms"], values["static"], "s", color="#8a6d1a", label="static"
            )
        axes.set_xlabel("milliseconds per iteration")
        axes.legend()
    left.set_yscale("log")
    left.set_ylabel("error of a frame, %")
    right.set_ylabel(f"PSNR at {size}³, dB, mean of {len(volumes)}")
    drawing.savefig(path, dpi=110, metadata={"Software": None})


def frame_errors(errors: dict) -> dict[str, float]:
    """Returns errors in percent, as means of single Gaussians, by the motion's name here."""
    named = {
        name.removeprefix("micro-views ").replace("exact, bound", "exact"): 100 * row["error_gaussians"]
        for name, row in errors["models"].items()
    }
    return {name: value for name, value in named.items() if "K" not in name}


def psnrs(found: dict, volumes: list[str]) -> dict[str, float]:
    return {m: float(np.mean([found[m][v][0] for v in volumes])) for m in found}


def main() -> None:
    what = sys.argv.pop(1) if len(sys.argv) > 1 else ""
    if what == "run":
        parser = runs_parser(__doc__)
        parser.add_argument("--iterations", type=int, default=3000)
    else:
        parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument("paths", type=Path, nargs="+")
        parser.add_argument("--rounds", type=int, default=9)
        parser.add_argument("--steps", type=int, default=10)
        parser.add_argument("--device")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--motions", default=MOTIONS)
    asked = parser.parse_args()
    if what == "run":
        run(asked)
    elif what == "cost":
        asked.paths[0].write_text(json.dumps(cost(asked), indent=1) + "\n", encoding="utf-8")
    elif what == "figure":
        costs, errors = (json.loads(path.read_text()) for path in asked.paths[1:3])
        figure(read_lines(asked.paths[0]), costs, errors, asked.paths[3])
    else:
        parser.error(f"found {what!r}; expected run, cost or figure")


if __name__ == "__main__":
    main()
