"""Slices of every run, kept beside the results, and figures that put the rows of a table side by side."""

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl.errors import OutputError
from phyradgs_cl.io import written_beside
from tables.case import FLY, Images
from tables.job import BenchJob
from tables.metrics import panels_png
from tables.results import Line, key_of
from tables.summary import lines_of

log = logging.getLogger(__name__)
_TRUTH = {"run": "truth", "acquisition": None, "protocol": None, "seed": None, "iterations": None}


def write_slices(folder: Path, facts: Mapping[str, Any], images: Images) -> None:
    """Keeps the slices of a run, or of the truth where ``facts`` are the truth's."""
    path = slices_path(folder, facts)
    _make(path.parent)
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, *[np.asarray(image, np.float32) for image in images])


def read_slices(folder: Path, facts: Mapping[str, Any]) -> Images | None:
    """Returns the slices of a run, or None where there are none or they are damaged."""
    try:
        with np.load(slices_path(folder, facts), allow_pickle=False) as stored:
            images = [stored[f"arr_{number}"] for number in range(len(stored))]
            return images if all(isinstance(image, np.ndarray) for image in images) else None
    except Exception:  # zipfile, zlib and NumPy's parser raise whatever they meet
        return None


def slices_path(folder: Path, facts: Mapping[str, Any]) -> Path:
    """Returns the path of a run's slices. The file's name follows from the run's identity."""
    digest = hashlib.sha256(json.dumps(key_of(facts)).encode()).hexdigest()[:16]
    return folder / "slices" / f"{facts['volume']}_{digest}.npz"


def truth_of(facts: Mapping[str, Any]) -> Line:
    """Returns the facts under which the truth's slices of a run's volume are kept."""
    return {**facts, **_TRUTH}


def write_figures(job: BenchJob, lines: Sequence[Line]) -> list[Path]:
    """Writes one PNG for each volume and protocol of the lines. Returns the files written."""
    job = job.with_all(lines)
    chosen = [line for line in lines_of(job, lines) if line["acquisition"] == FLY]
    cases = dict.fromkeys((line["protocol"], line["volume"]) for line in chosen)
    figures = [
        _figure(job, protocol, [x for x in chosen if (x["protocol"], x["volume"]) == (protocol, volume)])
        for protocol, volume in cases
    ]
    if cases and None in figures:
        lacking = figures.count(None)
        log.warning(
            "%s: no slices of %d of %d pictures, which are left out", job.output, lacking, len(figures)
        )
    return [path for path in figures if path is not None]


def _figure(job: BenchJob, protocol: str, lines: Sequence[Line]) -> Path | None:
    """Writes the figure of one volume, of its first seed. Returns None where no slices are kept."""
    seed = min(line["seed"] for line in lines)
    by_run = {line["run"]: line for line in lines if line["seed"] == seed}
    truth = read_slices(job.output, truth_of(lines[0]))
    columns = [("truth", truth)] if truth is not None else []
    for row in job.chosen_rows:
        line = by_run.get(row.run)
        images = read_slices(job.output, line) if line is not None else None
        if line is not None and images is not None:
            columns.append((f"{row.label}\n{line['metrics']['psnr_db']:.2f} dB", images))
    if len(columns) < 2:
        return None
    volume, size = lines[0]["volume"], job.bench_size
    path = job.output / "figures" / f"{job.stem}_{protocol}_{volume}.png"
    _make(path.parent)
    title = f"{volume}, {size.voxels}³ from {lines[0]['views']} views of {size.pixels}², seed {seed}"
    panels_png(path, columns, title)
    return path


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(str(folder), error.strerror or str(error), "a folder that can be made") from error
