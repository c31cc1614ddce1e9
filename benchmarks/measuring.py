"""Functions that the benchmarks share: where they ran, runs of splats, children in processes, results as JSON."""

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import simulate
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.start import first_population, internal_scale
from phyradgs_cl.runtime import Runtime

Facts = dict[str, object]


def parser_of(text: str) -> argparse.ArgumentParser:
    """Returns a parser with the options of every benchmark: --quick, --device, --json."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small and few: to see that it runs, no figures")
    parser.add_argument("--device", default=None, help="as for phyradgs")
    parser.add_argument("--json", type=Path, default=None, help="file for the results")
    return parser


def where(rt: Runtime) -> Facts:
    """Returns machine, device, and how busy the machine was at the start."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else -1.0
    return {
        "device": rt.device.name,
        "kind": rt.device.kind,
        "driver": rt.device.version,
        "lanes": rt.lanes,
        "compute_units": rt.device.compute_units,
        "cpus": os.cpu_count(),
        "load_before": round(load, 2),
        "python": platform.python_version(),
        "version": __version__,
    }


def finish(facts: Facts, path: Path | None) -> None:
    """Prints results, and writes them to a file if asked."""
    text = json.dumps(facts, indent=1)
    print(text)
    if path is not None:
        path.write_text(text + "\n", encoding="utf-8")


def foot_scan(rt: Runtime, size: int) -> Scan:
    """Returns a scan of the foot phantom by a rapid protocol, with ``size`` voxels per side from twice as many pixels."""
    return simulate("foot", size=size, detector=2 * size, noise="tigre", device=rt)


def splat_run(rt: Runtime, scan: Scan, options: SplatOptions) -> SplatRun:
    """Returns a reconstruction before its first step, with FDK's cloud."""
    fdk, rng = static_fdk(rt, scan), np.random.default_rng(0)
    scale = internal_scale(fdk, scan.grid)
    grid = scan.grid.scaled(1 / scale.length_mm)
    return SplatRun(rt, scan, options, scale, first_population(fdk / scale.density_per_mm, grid, options, rng), rng)


def random_cloud(count: int, scale: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Returns random Gaussians (11, G) in a cube of half the volume, sorted by height as a reconstruction keeps them."""
    quaternion = rng.normal(size=(4, count))
    place, size = rng.uniform(-0.55, 0.55, (3, count)), rng.uniform(*scale, (3, count))
    turn, density = quaternion / np.linalg.norm(quaternion, axis=0), rng.uniform(0.1, 1.0, (1, count))
    rows = np.concatenate([place, size, turn, density])
    return rows[:, np.argsort(rows[2])]


def child(script: str, *words: str) -> Facts:
    """Runs a script in a new process. Returns its last line of output, which is JSON. Its errors are not caught."""
    done = subprocess.run([sys.executable, script, *words], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])
