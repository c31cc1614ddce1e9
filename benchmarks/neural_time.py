"""Measures PSNR over processor seconds for naf, sax-nerf and phyradgs, static and with known motion.

    python benchmarks/neural_time.py VOLUMES RESULTS.jsonl [--names cthead,walnut] [--size 64] [--methods a,b] ...

Scans are those of scans.py. A run's volume is scored each time that a third more time has passed. Scoring, and making the
volume for it, is not counted. Seconds are processor seconds of all threads in this process. With --threads 1, the default,
a busy machine hardly changes them. They begin with the call, and include FDK and kernel builds. A
run is in the file once it is done; runs in the file are not made again."""

import argparse
import os
import time
from itertools import product

import numpy as np
from scans import append, files_of, make_scan, read_lines, runs_parser

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import Progress, RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime

METHODS = {
    "naf": ("naf", {}),
    "naf per-row": ("naf", {"motion": "per-row"}),
    "sax-nerf": ("sax-nerf", {}),
    "sax-nerf per-row": ("sax-nerf", {"motion": "per-row"}),
    "phyradgs static": ("phyradgs", {"motion": "static"}),
    "phyradgs exact": ("phyradgs", {"motion": "exact"}),
}
KEY = ("volume", "method", "size", "seed", "factor")
_SPACING = 1.3


class Scores:
    """A report that scores the present volume now and then. Its clock stops meanwhile."""

    def __init__(self, reference: np.ndarray) -> None:
        self.reference = reference
        self.points: list[dict[str, float]] = []
        self._started, self._scoring_s, self._due_s = time.process_time(), 0.0, 0.0

    def __call__(self, progress: Progress) -> None:
        begun = time.process_time()
        seconds = begun - self._started - self._scoring_s
        if seconds >= self._due_s and progress.volume is not None and progress.iteration < progress.iterations:
            self._add(progress.iteration, seconds, progress.volume()[0])
            self._due_s = _SPACING * seconds
        self._scoring_s += time.process_time() - begun

    def finish(self, iteration: int, volume: np.ndarray) -> None:
        """Adds the result of the run."""
        self._add(iteration, time.process_time() - self._started - self._scoring_s, volume)

    def _add(self, iteration: int, seconds: float, volume: np.ndarray) -> None:
        metrics = compare(volume, self.reference)
        point = {"iteration": iteration, "seconds": round(seconds, 3)}
        self.points.append({**point, "psnr_db": metrics["psnr_db"], "ssim": metrics["ssim"]})


def run_one(rt: Runtime, scan: Scan, label: str, factor: float, seed: int) -> dict[str, object]:
    """Returns the scores of one run. ``factor``: iterations over the default number."""
    method, changes = METHODS[label]
    iterations = max(round(factor * method_options(method).iterations), 1)
    options = method_options(method, None, {**changes, "iterations": iterations})
    assert scan.reference is not None
    scores = Scores(scan.reference)
    result = reconstruct(scan, RunPlan(method, options, seed=seed), rt, report=scores)
    scores.finish(iterations, result.volume)
    return {
        "points": scores.points,
        "iterations": iterations,
        "device": rt.device.name,
        "torch_device": result.facts.get("torch_device"),
        "torch_version": result.facts.get("torch_version"),
        "version": __version__,
    }


def run_all(arguments: argparse.Namespace) -> None:
    for variable in ("POCL_MAX_PTHREAD_COUNT", "OMP_NUM_THREADS"):  # one is OpenCL's on a CPU, the other PyTorch's
        os.environ[variable] = str(arguments.threads)
    rt = Runtime(arguments.device)
    done = {tuple(line[name] for name in KEY) for line in read_lines(arguments.results)}
    volumes = files_of(arguments.volumes, arguments.names, arguments.size)
    for (name, path), seed in product(volumes.items(), arguments.seeds):
        scan: Scan | None = None
        for label, factor in product(arguments.methods.split(","), map(float, arguments.factors.split(","))):
            values = (name, label, arguments.size, seed, factor)
            if values not in done:
                scan = scan or make_scan(rt, path, arguments.size, seed)
                facts = {**dict(zip(KEY, values, strict=True)), "threads": arguments.threads}
                append(arguments.results, {**facts, **run_one(rt, scan, label, factor, seed)})


def main() -> None:
    parser = runs_parser(__doc__)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--factors", default="1", help="iterations as multiples of the defaults, e.g. 0.25,1,4")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--threads", type=int, default=1)
    run_all(parser.parse_args())


if __name__ == "__main__":
    main()
