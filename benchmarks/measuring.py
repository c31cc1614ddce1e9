"""What the benchmarks share: where they ran, medians, exponents, children in processes of their own, results as JSON."""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.runtime import Runtime

Facts = dict[str, object]


def parser_of(text: str) -> argparse.ArgumentParser:
    """A parser with what every benchmark takes: --quick, --device, --json."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small and few: to see that it runs, no figures")
    parser.add_argument("--device", default=None, help="as for phyradgs")
    parser.add_argument("--json", type=Path, default=None, help="file for the results")
    return parser


def where(rt: Runtime) -> Facts:
    """Machine, device and how busy the machine was when this began."""
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
    """Prints results, and keeps them where asked."""
    text = json.dumps(facts, indent=1)
    print(text)
    if path is not None:
        path.write_text(text + "\n", encoding="utf-8")


def median(values: Sequence[float]) -> float:
    return float(statistics.median(values))


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """p of cost ~ size^p, by least squares on logarithms."""
    slope, _ = np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)
    return float(slope)


def child(script: str, *words: str) -> Facts:
    """Runs a script in a process of its own; what it prints last is JSON. Its errors are shown as they are."""
    done = subprocess.run([sys.executable, script, *words], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])
