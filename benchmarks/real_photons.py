"""Measures fly-scans of real photons: sums of projections of dense real scans, which are the reference.

    python benchmarks/real_photons.py RESULTS.jsonl DENSE.h5 ... [--counts 20] [--readouts 0,0.86] [--methods fista]
        [--side 640] [--rim 80,155] [--axis columns] [--times 0] [--passes 25]

A scan is made by ``sum_frames``, with --counts projections a frame, read out at once or along --axis. The reference is the
default method on every second projection, at rest. A line has the PSNR of a run against the reference, in the ring --rim
(voxels from the axis) and inside of it; the peak is the 99.9th percentile of the reference. It has the error on 2 % held-out
pixels, and the rise of edges along the rotation in the ring. --side: voxels of the grid. An interrupted run continues."""

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
from scans import append, read_lines

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.coarse import some_frames
from phyradgs_cl.api import PerRow, load_scan, reconstruct, sum_frames
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.result import HELD_OUT
from phyradgs_cl.runtime import Runtime

_ANGLES = 4096  # samples of a circle
_SIGMAS_PX = np.arange(0, 8, 0.05)
_RISE = 2.563  # rise of a Gaussian's edge from 10 to 90 %, in its standard deviations
SPLATS = ("phyradgs", "r2")
_PEAK = 99.9  # percentile of the reference: a dead pixel makes brighter dots


def wide(scan: Scan, side: int) -> Scan:
    voxel_mm = scan.grid.voxel_size_mm
    shape = (scan.grid.shape[0], side, side) if side else scan.grid.shape
    return replace(scan.on_grid(Grid(shape, voxel_mm, scan.grid.offset_mm)), detector_model="intensity")


def at_rest(scan: Scan, passes: int, rt: Runtime, path: Path) -> np.ndarray:
    """Returns the volume of every second projection, which is kept in a file beside the results."""
    if not path.is_file():
        half = some_frames(scan, np.arange(0, scan.frames, 2))
        np.save(path, reconstruct(half, motion="static", iterations=passes, device=rt, report=False).volume)
    return np.load(path)


def rings(shape: tuple[int, ...], rim: tuple[float, float]) -> dict[str, np.ndarray]:
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape[1:])
    radius = np.broadcast_to(np.hypot(y[:, None], x), shape)
    return {"rim": (radius >= rim[0]) & (radius < rim[1]), "inside": radius < rim[0]}


def edge_rise_px(volume: np.ndarray, reference: np.ndarray, rim: tuple[float, float]) -> float:
    """Returns the 10 to 90 % rise along the rotation, in voxels, of the reference's edges in the volume. It is that of the
    Gaussian whose blur of the reference along the circles of the ring resembles the volume most."""
    radius = np.arange(rim[0], rim[1])[:, None]
    angle = np.arange(_ANGLES) * 2 * np.pi / _ANGLES
    middle = (np.array(reference.shape[1:]) - 1) / 2
    places = middle[0] + radius * np.sin(angle), middle[1] + radius * np.cos(angle)
    of_rings = [[scipy.ndimage.map_coordinates(one, places, order=1) for one in image] for image in (volume, reference)]
    seen, sharp = (np.fft.rfft(image) for image in of_rings)
    waves_per_px = np.arange(seen.shape[-1]) / (2 * np.pi * radius)
    likeness = []
    for sigma_px in _SIGMAS_PX:
        blurred = sharp * np.exp(-2 * (np.pi * sigma_px * waves_per_px) ** 2)
        blurred[..., 0] = 0
        likeness.append((blurred.conj() * seen).real.sum() / np.linalg.norm(blurred))
    return float(_RISE * _SIGMAS_PX[int(np.argmax(likeness))])


def run(scan: Scan, reference: np.ndarray, rim: tuple[float, float], rt: Runtime, **options: object) -> dict[str, float]:
    began_s = time.process_time()
    result = reconstruct(scan, device=rt, report=False, holdout=2, **options)  # type: ignore[arg-type]
    facts = {"processor_s": round(time.process_time() - began_s, 1), "holdout_rms": result.facts[HELD_OUT]["holdout_rms"]}
    for name, ring in rings(reference.shape, rim).items():
        error = math.sqrt(np.mean((result.volume - reference)[ring] ** 2))
        facts[f"{name}_psnr_db"] = 20 * math.log10(float(np.percentile(reference, _PEAK)) / error)
    return {**facts, "rim_rise_px": edge_rise_px(result.volume, reference, rim)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("scans", type=Path, nargs="+")
    parser.add_argument("--counts", default="20")
    parser.add_argument("--readouts", default="0,0.86")
    parser.add_argument("--methods", default="fista")
    parser.add_argument("--side", type=int, default=0)
    parser.add_argument("--rim", default="80,155")
    parser.add_argument("--axis", default="columns", choices=["rows", "columns"])
    parser.add_argument("--times", type=int, default=0, help="in an exposure; of coarse scans, their count")
    parser.add_argument("--passes", type=int, default=25)
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    rt, done = Runtime(given.device), read_lines(given.results)
    low, high = map(float, given.rim.split(","))
    for path in given.scans:
        dense = wide(load_scan(path), given.side)
        reference = at_rest(dense, given.passes, rt, given.results.with_name(f"{path.stem}_at_rest.npy"))
        for count in map(int, given.counts.split(",")):
            for ratio in map(float, given.readouts.split(",")):
                flown = sum_frames(dense, count, ratio, given.axis)
                for method in given.methods.split(","):
                    for motion in ("static", "exact" if method in SPLATS else "per-row"):
                        key = {"scan": path.stem, "count": count, "readout": ratio, "method": method, "motion": motion}
                        if any(all(line[name] == value for name, value in key.items()) for line in done):
                            continue
                        of_method = {"iterations": given.passes} if method == "fista" else {}
                        model = PerRow(given.times) if motion == "per-row" else motion
                        found = run(flown, reference, (low, high), rt, method=method, motion=model, **of_method)
                        line = {**key, "frames": flown.frames, **found}
                        append(given.results, line)


if __name__ == "__main__":
    main()
