"""Reconstruction quality on a folder of volumes: one line of JSON a run, resumable at any run.

    python benchmarks/quality.py VOLUMES RESULTS.jsonl [--names a,b] [--size 64] [--axis rows] [--seeds 0] ...
    python benchmarks/quality.py --table RESULTS.jsonl

Volumes are HDF5 files NAME_COUNT.h5 with a dataset /volume; each is projected at the resolution of the file (twice
the reconstruction's, where there is one) and scored in 3D against its block mean.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import SimulationOptions, simulate, volume_scene

METHODS = {
    "fdk": ("fdk", {}),
    "r2": ("r2", {}),
    "r2 w/ ST": ("r2", {"motion": "micro-views"}),
    "phyradgs static": ("phyradgs", {"motion": "static"}),
    "phyradgs": ("phyradgs", {"motion": "micro-views"}),
    "phyradgs exact": ("phyradgs", {"motion": "exact"}),
}


def make_scan(rt: Runtime, path: Path, arguments: argparse.Namespace, seed: int) -> Scan:
    """The scan of one volume: rapid protocol unless told otherwise, TIGRE's noise at 1e4 photons and σ 10."""
    size, detector = arguments.size, 2 * arguments.size
    geometry = ConeGeometry(5.0, 7.0, (detector, detector), (4.0 / detector,) * 2)
    scene = volume_scene(rt, str(path), geometry, Grid.cube(size, 2.0), size, arguments.axis)
    options = SimulationOptions(
        protocol=make_protocol(arguments.protocol), readout_axis=arguments.axis, noise="tigre", seed=seed
    )
    return simulate(scene.source, geometry, scene.grid, options, reference=scene.reference, title=path.stem)


def file_for(folder: Path, name: str, size: int) -> Path:
    """The file with twice ``size`` voxels a side, else the largest that there is."""
    wanted = folder / f"{name}_{2 * size}.h5"
    if wanted.exists():
        return wanted
    return max(folder.glob(f"{name}_*.h5"), key=lambda p: int(p.stem.rsplit("_", 1)[1]))


def run_all(arguments: argparse.Namespace) -> None:
    rt = Runtime(arguments.device)
    folder, results = Path(arguments.volumes), Path(arguments.results)
    names = (
        arguments.names.split(",")
        if arguments.names
        else sorted({p.stem.rsplit("_", 1)[0] for p in folder.glob("*.h5")})
    )
    done = {key_of(line) for line in read_lines(results)}
    for seed in (int(s) for s in arguments.seeds.split(",")):
        for name in names:
            scan: Scan | None = None
            for label in arguments.methods.split(","):
                facts = {
                    "volume": name, "method": label, "size": arguments.size, "axis": arguments.axis,
                    "protocol": arguments.protocol, "seed": seed, "iterations": arguments.iterations,
                }  # fmt: skip
                if key_of(facts) in done:
                    continue
                scan = scan or make_scan(rt, file_for(folder, name, arguments.size), arguments, seed)
                append(results, {**facts, **run_one(rt, scan, label, arguments.iterations, seed)})


def run_one(rt: Runtime, scan: Scan, label: str, iterations: int, seed: int) -> dict[str, object]:
    method, changes = METHODS[label]
    changes = changes if method == "fdk" else {**changes, "iterations": iterations}
    started = time.perf_counter()
    result = reconstruct(scan, method, rt, method_options(method, None, changes), seed=seed)
    metrics = compare(result.volume, scan.reference if scan.reference is not None else np.zeros(1))
    return {
        **metrics,
        "seconds": round(time.perf_counter() - started, 2),
        "gaussians": result.facts.get("gaussians", 0),
        "device": rt.device.name,
        "cpu": platform.processor() or platform.machine(),
        "version": __version__,
        "options": str(result.facts["options"]),
    }


def key_of(line: dict[str, object]) -> tuple[object, ...]:
    return tuple(line[k] for k in ("volume", "method", "size", "axis", "protocol", "seed", "iterations"))


def read_lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def append(path: Path, line: dict[str, object]) -> None:
    with open(path, "a") as file:
        file.write(json.dumps(line) + "\n")


def table(path: Path) -> str:
    """Markdown: a block for each size, axis and protocol; PSNR dB / SSIM, mean and spread over seeds."""
    blocks: dict[tuple[object, ...], dict[str, dict[str, list[tuple[float, float, float]]]]] = {}
    for line in read_lines(path):
        block = blocks.setdefault(tuple(line[k] for k in ("size", "axis", "protocol", "iterations")), {})
        runs = block.setdefault(str(line["volume"]), defaultdict(list))
        runs[str(line["method"])].append(
            (float(line["psnr_db"]), float(line["ssim"]), float(line["seconds"]))
        )  # type: ignore[arg-type]
    text: list[str] = []
    for (size, axis, protocol, iterations), volumes in blocks.items():
        methods = [m for m in METHODS if any(m in runs for runs in volumes.values())]
        text += [f"\n**{size}³, {protocol}, readout along {axis}, {iterations} iterations**\n"]
        text += ["| volume | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
        for name, runs in sorted(volumes.items()):
            text.append(f"| {name} | " + " | ".join(cell(runs.get(m, [])) for m in methods) + " |")
        means = [
            [np.mean([r[:2] for r in runs[m]], axis=0) for runs in volumes.values() if m in runs]
            for m in methods
        ]
        seconds = [np.mean([r[2] for runs in volumes.values() for r in runs.get(m, [])]) for m in methods]
        text.append(
            "| **mean** | "
            + " | ".join(f"{np.mean(m, 0)[0]:.2f} / {np.mean(m, 0)[1]:.3f}" for m in means)
            + " |"
        )
        text.append("| seconds | " + " | ".join(f"{s:.0f}" for s in seconds) + " |")
    return "\n".join(text)


def cell(runs: list[tuple[float, float, float]]) -> str:
    if not runs:
        return ""
    values = np.array(runs)
    spread = f" ± {values[:, 0].std(ddof=1):.2f}" if len(runs) > 1 else ""
    return f"{values[:, 0].mean():.2f}{spread} / {values[:, 1].mean():.3f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("volumes", help="folder of volumes")
    parser.add_argument("results", nargs="?", help="JSON lines, appended to")
    parser.add_argument("--names", default="", help="comma-separated; all in the folder by default")
    parser.add_argument("--methods", default="fdk,phyradgs static,phyradgs")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--axis", default="rows")
    parser.add_argument("--protocol", default="rapid")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--device", default=None)
    parser.add_argument(
        "--table", action="store_true", help="print the tables of the results file given as VOLUMES"
    )
    arguments = parser.parse_args()
    if arguments.table:
        print(table(Path(arguments.volumes)))
    else:
        run_all(arguments)


if __name__ == "__main__":
    main()
