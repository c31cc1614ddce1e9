"""Measures what stripes cost a parallel scan of many views, and what steps of ``prepare`` regain: PSNR of FBP's volume.

    python benchmarks/stripes.py docs/results/stripes.jsonl --views 180 720 1800

There is a line per object, number of views, kind of stripes and steps. Lines in the file are not made again. The table is in
docs/results/prepare.md. ``pip install algotom`` adds its filters, with medians of two widths."""

from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from scans import append, read_lines, results_parser

from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, ParallelGeometry, Scan, Shutter, pixel_centres
from phyradgs_cl.api import compare, prepare, reconstruct
from phyradgs_cl.detector.effects import beer_lambert_noise, pixel_gains
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.runtime import Runtime

ROWS, COLUMNS, WIDTH_MM, PHOTONS = 8, 256, 2.2, 1e5
# Attenuation per mm, centre x, y, z and half axes x, y, z in mm.
OBJECTS = {
    "head": [(2.0, 0, 0, 0, 0.75, 0.6, 0.8), (-0.7, 0, 0, 0, 0.68, 0.53, 0.72), (1.2, 0.3, 0.1, 0.0, 0.12, 0.2, 0.3)],
    "grains": [(3.0, 0.6 * np.cos(k), 0.6 * np.sin(k), 0.05 * np.sin(3 * k), 0.15, 0.15, 0.15) for k in range(7)],
}
KINDS = ("none", "gains", "columns", "partial", "unresponsive", "fluctuating", "wide")
STEPS: dict[str, dict[str, Any]] = {
    "": {}, "dead,rings": {}, "stripes": {}, "dead,rings,stripes": {}, "every column": {"stripes": {"ratio": 0}}
}  # fmt: skip
ALGOTOM = {"algotom": (51, 21), "algotom, narrow": (21, 5)}
"""Widths of the medians of ``remove_all_stripe`` in columns: its own defaults, and the best of some on these scans."""


def scan_of(name: str, views: int) -> Scan:
    """Returns a full turn at rest, with photon noise."""
    body = EllipsoidPhantom(tuple(Ellipsoid((x, y, z), (a, b, c), mu) for mu, x, y, z, a, b, c in OBJECTS[name]), name)
    geometry = ParallelGeometry((ROWS, COLUMNS), WIDTH_MM / COLUMNS)
    angle_rad, start_s = 2 * np.pi * np.arange(views) / views, np.arange(views, dtype=np.float64)
    frames = np.empty((views, ROWS, COLUMNS), np.float32)
    for frame, pose in enumerate(geometry.pose(angle_rad)):
        middle, along = pixel_centres(pose, (ROWS, COLUMNS)), 2 * WIDTH_MM * pose[:3]
        frames[frame] = body.line_integrals(middle - along, middle + along)
    frames = beer_lambert_noise(frames, PHOTONS, 0.0, np.random.default_rng(5))
    grid = Grid((4, 192, 192), (2.0 / 192,) * 3)
    orbit = CircularOrbit(geometry, FrameSweeps(start_s, 1.0, angle_rad, angle_rad))
    return Scan(frames, geometry, orbit, Shutter(0.0), start_s, grid, is_fly=False, reference=body.voxelise(grid, 2))


def spoilt(frames: np.ndarray, kind: str) -> np.ndarray:
    """Returns line integrals (F, v, u) with stripes of a kind: gains of 2 % in all pixels; eight columns 5 % off, in all
    views or in two fifths of them; three columns that repeat one value, or have a noise of 0.3; two bands of 7 columns."""
    rng, bad = np.random.default_rng(3), frames.copy()
    views, rows, _ = frames.shape
    columns = np.array([35, 60, 84, 110, 150, 166, 200, 213])  # none is the mirror image of another
    few = columns[[1, 4, 6]]
    if kind == "gains":
        bad -= np.log(pixel_gains(frames.shape[1:], 0.02, rng)).astype(np.float32)
    elif kind == "columns":
        bad[:, :, columns] -= np.log(1 + 0.05 * rng.choice([-1, 1], len(columns))).astype(np.float32)
    elif kind == "partial":
        for column, first in zip(columns, rng.integers(0, views, len(columns)), strict=True):
            bad[(first + np.arange(2 * views // 5)) % views, :, column] -= np.float32(np.log(1.05))
    elif kind == "unresponsive":
        bad[:, :, few] = 0.6 + 0.002 * rng.standard_normal((views, rows, 3))
    elif kind == "fluctuating":
        bad[:, :, few] += 0.3 * rng.standard_normal((views, rows, 3)).astype(np.float32)
    elif kind == "wide":
        for column in (60, 170):
            bad[:, :, column : column + 7] -= np.float32(np.log(1.05))
    return bad


def by_algotom(frames: np.ndarray, large: int, small: int) -> np.ndarray:
    """Returns line integrals (F, v, u) after all of algotom's filters."""
    from algotom.prep.removal import remove_all_stripe

    rows = [remove_all_stripe(frames[:, row].astype(np.float64), 3.0, large, small) for row in range(frames.shape[1])]
    return np.stack(rows, axis=1).astype(np.float32)


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--views", type=int, nargs="+", default=[180, 720, 1800])
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    given = parser.parse_args()
    rt = Runtime(given.device)
    peers = ALGOTOM if find_spec("algotom") else {}
    done = {(line["object"], line["views"], line["stripes"], line["steps"]) for line in read_lines(given.results)}
    for views in given.views:
        for name in given.objects:
            clean = scan_of(name, views)
            assert (reference := clean.reference) is not None
            for kind in KINDS:
                scan = Scan(**{**vars(clean), "projections": spoilt(clean.projections, kind)})
                for steps in (*STEPS, *peers):
                    if (name, views, kind, steps) in done:
                        continue
                    options = STEPS.get(steps, {})
                    names = "stripes" if options else steps
                    if steps in peers:
                        ready = replace(scan, projections=by_algotom(scan.projections, *peers[steps]))
                    else:
                        ready = prepare(scan, names, device=rt, **options) if names else scan
                    volume = reconstruct(ready, "fbp", device=rt, report=False).volume
                    psnr_db = round(float(compare(volume, reference)["psnr_db"]), 3)
                    line = {"object": name, "views": views, "stripes": kind, "steps": steps, "psnr_db": psnr_db}
                    append(given.results, line)


if __name__ == "__main__":
    main()
