"""Measures the NMSE of least squares and of ``fista`` on a fan beam's fly-scan, as in the published test of RACE.

    python benchmarks/fan_fly.py docs/results/fan_fly.jsonl [--side 700]

The object is Shepp-Logan with Toft's contrasts on 700² voxels of 0.1 mm, simulated on 1400² voxels. The source is 500 mm
from the axis and the panel 250 mm beyond it, with 1250 pixels of 0.15 mm. There are 40 views over 196 degrees, each an
exposure of 4.9 degrees, one after the other, with 10⁵ photons. The panel averages intensity over 120 times of an exposure
and two pixels. The largest line integral along an axis of the phantom is 3.

Least squares (``cgls``, 25 iterations) averages line integrals (ARTIC) or intensity (RACE), at 10 times of an exposure. NMSE
is the squared error over the squared truth. ``best``: the smallest, and its iteration. Present rows are not made again."""

import time
from typing import Any

import numpy as np
from parallel_fly import Trial, mean_light
from scans import append, read_lines, results_parser

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Scan, Shutter
from phyradgs_cl.api import reconstruct
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.runtime import Runtime

SIDE, COLUMNS, VIEWS, TIMES, VOXEL_MM, PIXEL_MM = 700, 1250, 40, 120, 0.1, 0.15
ARC_RAD, PHOTONS, PEAK = np.deg2rad(4.9), 1e5, 3.0


def trials(iterations: int) -> list[Trial]:
    """Returns the trials, each with the name of its model."""
    moving = {"motion": "per-row", "sub_intervals": 10}
    least = {"iterations": iterations}
    log, intensity = ({"detector_model": name} for name in ("log", "intensity"))
    return [
        Trial("fdk", "ignored", {"motion": "static"}),
        Trial("cgls", "ignored", {"motion": "static", **least, **log}),
        Trial("cgls", "log average", {**moving, **least, **log}),
        Trial("cgls", "intensity average", {**moving, **least, **intensity}),
        Trial("fista", "ignored", {"motion": "static", **log}),
        Trial("fista", "intensity average", {**moving, **intensity}),
        Trial("fista", "log average", {**moving, **log}),
    ]


def slice_of(side: int, voxel_mm: float) -> np.ndarray:
    """Returns the phantom (side, side) as means over 4² points of each voxel."""
    axis = (np.arange(4 * side) - (4 * side - 1) / 2) * voxel_mm / 4
    x, y = np.meshgrid(axis, axis)
    field = shepp_logan(0.48 * side * voxel_mm, "toft", 1.0).density(x, y, 0 * x)
    return np.asarray(field).reshape(side, 4, side, 4).mean((1, 3))


def make_scan(rt: Runtime, side: int, columns: int) -> tuple[Scan, np.ndarray]:
    """Returns the scan, on a panel of the same width at all sizes, and the truth (side, side) in 1/mm."""
    voxel_mm, pixel_mm = VOXEL_MM * SIDE / side, PIXEL_MM * COLUMNS / columns
    motion = ConstantSpeed(0.0, ARC_RAD)  # an exposure takes a second
    start_s, shutter = np.arange(float(VIEWS)), Shutter(1.0)
    fine = ConeGeometry(500.0, 750.0, (1, 2 * columns), pixel_mm / 2)
    grid = Grid((1, 2 * side, 2 * side), (voxel_mm / 2,) * 3)
    field = slice_of(2 * side, voxel_mm / 2)
    field *= PEAK / (max(field.sum(0).max(), field.sum(1).max()) * voxel_mm / 2)
    light = mean_light(rt, CircularOrbit(fine, motion), shutter, start_s, grid, field, TIMES, 2)
    counts = np.random.default_rng(0).poisson(light * PHOTONS)
    frames = -np.log(np.maximum(counts, 0.5) / PHOTONS)[:, None].astype(np.float32)
    geometry, grid = ConeGeometry(500.0, 750.0, (1, columns), pixel_mm), Grid((1, side, side), (voxel_mm,) * 3)
    orbit = CircularOrbit(geometry, motion)
    scan = Scan(frames, geometry, orbit, shutter, start_s, grid, detector_model="intensity")
    return scan, field.reshape(side, 2, side, 2).mean((1, 3))


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--iterations", type=int, default=25, help="of least squares")
    parser.add_argument("--side", type=int, default=SIDE, help="voxels of the grid; the panel's pixels follow")
    parser.add_argument("--trials", type=int, help="the first of them alone")
    args = parser.parse_args()
    side, columns = args.side, round(COLUMNS * args.side / SIDE)
    done = {(row["method"], row["model"]) for row in read_lines(args.results) if row["side"] == side}
    wanted = [t for t in trials(args.iterations)[: args.trials] if (t.method, t.label) not in done]
    if not wanted:
        return
    rt = Runtime(args.device)
    scan, truth = make_scan(rt, side, columns)
    for trial in wanted:
        curve: dict[int, float] = {}

        def follow(progress: Any, curve: dict[int, float] = curve) -> None:
            if progress.volume is not None:
                curve[progress.iteration] = nmse(progress.volume()[0][0], truth)

        before_s = time.process_time()
        volume = reconstruct(scan, method=trial.method, device=rt, report=follow, **trial.options).volume
        curve[max(curve, default=0) + (not curve)] = nmse(volume[0], truth)
        best = min(curve, key=lambda iteration: curve[iteration])
        append(args.results, {
            "side": side, "method": trial.method, "model": trial.label, "nmse": round(nmse(volume[0], truth), 5),
            "best": round(curve[best], 5), "best_at": best, "processor_s": round(time.process_time() - before_s),
        })  # fmt: skip


def nmse(image: np.ndarray, truth: np.ndarray) -> float:
    """Returns ‖image − truth‖² / ‖truth‖²."""
    return float(((image - truth) ** 2).sum() / (truth**2).sum())


if __name__ == "__main__":
    main()
