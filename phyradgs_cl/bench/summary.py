"""Means over volumes and spreads over seeds of the lines that belong to a table."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.bench.job import BenchJob
from phyradgs_cl.bench.results import Line

REFERENCE = "reference"  # the acquisition of lines about the truth and the pseudo-truth


@dataclass(frozen=True)
class Summary:
    """One row under one acquisition: means over volumes; spreads are standard deviations over seeds."""

    mean: dict[str, float]
    spread: dict[str, float]
    volumes: int
    seeds: int


def lines_of(job: BenchJob, lines: Sequence[Line]) -> list[Line]:
    """The newest line of every successful run at the job's size, iterations and readout axis.

    Names, protocols and rows restrict them where the job gives any; volumes and seeds of earlier jobs are included.
    """
    size = job.bench_size
    runs = {row.run for row in job.chosen_rows} | {row.standing().run for row in job.chosen_rows}
    chosen: dict[tuple[object, ...], Line] = {}
    for line in lines:
        fits = (
            line.get("study") == job.study
            and (line.get("voxels"), line.get("pixels")) == (size.voxels, size.pixels)
            and line.get("axis") == job.axis
            and line.get("iterations") in (None, size.iterations)
            and line.get("protocol") in job.chosen_protocols
            and (line.get("run") in runs or line.get("acquisition") == REFERENCE)
            and (not job.names or line.get("volume") in job.names)
            and "metrics" in line
        )
        if fits:
            key = tuple(line[name] for name in ("volume", "run", "acquisition", "protocol", "seed"))
            chosen[key] = line
    return list(chosen.values())


def summarise(lines: Sequence[Line]) -> Summary | None:
    """Means of each number over volumes, then over seeds; None without lines."""
    if not lines:
        return None
    by_seed: dict[int, list[dict[str, float]]] = defaultdict(list)
    for line in lines:
        numbers = {name: value for name, value in line["metrics"].items() if value is not None}
        if "seconds" in line:  # lines about the truth have none
            numbers["seconds"] = line["seconds"]
        by_seed[line["seed"]].append(numbers)
    names = {name for runs in by_seed.values() for run in runs for name in run}
    mean, spread = {}, {}
    for name in names:
        per_seed = [_mean(runs, name) for runs in by_seed.values()]
        known = [value for value in per_seed if value is not None]
        mean[name] = float(np.mean(known))
        if len(known) > 1:
            spread[name] = float(np.std(known, ddof=1))
    return Summary(mean, spread, len({line["volume"] for line in lines}), len(by_seed))


def _mean(runs: Sequence[dict[str, float]], name: str) -> float | None:
    values = [run[name] for run in runs if name in run]
    return float(np.mean(values)) if values else None
