"""Means over volumes, and spreads over seeds, of the lines that belong to a table."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tables.job import BenchJob
from tables.results import Line

REFERENCE = "reference"  # the acquisition of lines about the truth and the pseudo-truth


@dataclass(frozen=True)
class Summary:
    """One row under one acquisition: means over volumes. Spreads are standard deviations over seeds."""

    mean: dict[str, float]
    spread: dict[str, float]
    volumes: int
    seeds: int


def lines_of(job: BenchJob, lines: Sequence[Line]) -> list[Line]:
    """Returns the newest line of every successful run at the job's size, iterations and readout axis.

    The job's names, protocols and rows restrict them. Volumes and seeds of earlier jobs are included."""
    size = job.bench_size
    runs = {row.run for row in job.chosen_rows} | {row.static().run for row in job.chosen_rows}
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


def lines_of_run(lines: Sequence[Line], protocol: str, run: str, acquisition: str) -> list[Line]:
    """Returns the lines of one run under a protocol and an acquisition, of all volumes and seeds."""
    wanted = (protocol, run, acquisition)
    return [line for line in lines if (line["protocol"], line["run"], line["acquisition"]) == wanted]


def summarise(lines: Sequence[Line]) -> Summary | None:
    """Returns means over volumes of means over seeds; None without lines.

    Only a few volumes may have been run with several seeds. A spread is that of the mean over the volumes that have all
    seeds. Volumes with one seed would add the spread of volumes to that of seeds."""
    if not lines:
        return None
    found = [(line["volume"], line["seed"], _numbers(line)) for line in lines]
    names = {name for _, _, numbers in found for name in numbers}
    mean, spread = {}, {}
    for name in names:
        values: dict[str, dict[int, float]] = defaultdict(dict)
        for volume, seed, numbers in found:
            if name in numbers:
                values[volume][seed] = numbers[name]
        mean[name] = float(np.mean([np.mean(list(of_seeds.values())) for of_seeds in values.values()]))
        seeds = {seed for of_seeds in values.values() for seed in of_seeds}
        several = [of_seeds for of_seeds in values.values() if set(of_seeds) == seeds]
        if len(seeds) > 1 and several:
            per_seed = [np.mean([of_seeds[seed] for of_seeds in several]) for seed in sorted(seeds)]
            spread[name] = float(np.std(per_seed, ddof=1))
    return Summary(mean, spread, len({volume for volume, _, _ in found}), len({seed for _, seed, _ in found}))


def _numbers(line: Line) -> dict[str, float]:
    """Returns a line's measures, with the times that it has: the truth's lines have none, those of early versions one."""
    numbers = {name: value for name, value in line["metrics"].items() if value is not None}
    return numbers | {name: line[name] for name in ("seconds", "processor_s") if name in line}
