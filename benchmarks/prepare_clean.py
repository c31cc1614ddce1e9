"""Measures what the usual steps of ``prepare`` cost clean scans, and what ``rings`` regains in scans that have rings.

    python benchmarks/prepare_clean.py docs/results/prepare_clean.jsonl --phantoms VOLUMES/cthead_128.h5 ...

There is a line per volume, views, method and cell: a step on the clean scan, or rings of some percent. Where the step leaves
the frames bit for bit, ``lost_db`` is 0 without a run. Lines in the file are not made again. docs/results/prepare.md has the
table."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scans import append, read_lines, results_parser

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import compare, prepare, reconstruct, simulate
from phyradgs_cl.prepare import DEFAULT_STEPS
from phyradgs_cl.runtime import Runtime

VIEWS = (25, 75, 180, 360, 720)
RINGED_VIEWS = (180, 360, 720)
RINGS = (0.01, 0.02, 0.05)
STEPS = (*DEFAULT_STEPS.split(","), DEFAULT_STEPS)


def psnr_db(scan: Scan, method: str, rt: Runtime) -> float:
    result = reconstruct(scan, method, motion="per-row", device=rt, report=False)
    return float(compare(result.volume, np.asarray(scan.reference))["psnr_db"])


def clean_cells(clean: Scan, method: str, rt: Runtime) -> Iterator[dict[str, Any]]:
    for steps in STEPS:
        prepared = prepare(clean, steps, device=rt)
        same = np.array_equal(prepared.projections, clean.projections) and bool(prepared.valid.all())
        lost = 0.0 if same else psnr_db(clean, method, rt) - psnr_db(prepared, method, rt)
        yield {"steps": steps, "unchanged": same, "lost_db": round(lost, 3)}


def ringed_cells(
    clean: Scan, method: str, rt: Runtime, usual: dict[str, Any], spreads: list[float]
) -> Iterator[dict[str, Any]]:
    clean_db = cache(lambda: psnr_db(clean, method, rt))
    for spread in spreads:
        ringed = simulate(**usual, rings=spread)
        ringed_db, prepared_db = psnr_db(ringed, method, rt), psnr_db(prepare(ringed, DEFAULT_STEPS, device=rt), method, rt)
        regained = (prepared_db - ringed_db) / max(clean_db() - ringed_db, 1e-2)
        values = {"clean_db": clean_db(), "ringed_db": ringed_db, "prepared_db": prepared_db, "regained": regained}
        yield {"steps": f"rings {spread}", **{key: round(value, 3) for key, value in values.items()}}


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--phantoms", nargs="+", default=["jaw", "foot"], help="names, or files of volumes")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--detector", type=int, default=96)
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    parser.add_argument("--rings", type=float, nargs="*", default=RINGS, help="spreads of gains; none: clean scans alone")
    parser.add_argument("--methods", nargs="+", default=["fdk"])
    given = parser.parse_args()
    rt = Runtime(given.device)
    for views in given.views:
        for phantom in given.phantoms:
            usual = {
                "phantom": phantom, "size": given.size, "detector": given.detector, "views": views, "device": rt,
                "exposure_deg": 0.8 * 360 / views, "noise": "tigre", "dose": 28_000, "seed": 3,
            }  # fmt: skip
            for method in given.methods:
                place = {"size": given.size, "detector": given.detector, "phantom": Path(phantom).stem}
                place |= {"views": views, "method": method}
                done = {line["steps"] for line in read_lines(given.results) if place.items() <= line.items()}
                spreads = [s for s in given.rings if views in RINGED_VIEWS and f"rings {s}" not in done]
                if set(STEPS) <= done and not spreads:
                    continue
                clean = simulate(**usual)
                cells = [] if set(STEPS) <= done else [clean_cells(clean, method, rt)]
                cells.append(ringed_cells(clean, method, rt, usual, spreads))
                for line in (line for cell in cells for line in cell):
                    append(given.results, {**place, **line})


if __name__ == "__main__":
    main()
