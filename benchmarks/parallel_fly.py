"""Measures fly-scans of parallel beams: PSNR, and the modulation at half Nyquist at rim and centre, with and without motion.

    python benchmarks/parallel_fly.py docs/results/parallel_fly.jsonl [--views 180 720] [--blur-px 0.5 5] [--dose 1e4]

A disc of unit attenuation over its diameter holds discs of other contrasts and four gratings of 4 pixels' period across the
motion. Three gratings are at 0.85 of the radius, one is in the middle. The panel has 128 columns and 4 rows. Views extend
over as many turns as exposures of the stated blur need, at evenly spaced angles modulo a turn. Frames are averages of
intensity over 24 times of an exposure, of the object on pixels half as large, with Poisson noise. The modulation is the
amplitude of a grating in the volume over that in the truth. Runs that the results file has are not made again."""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from scans import append, read_lines, results_parser

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, ParallelGeometry, Scan, Shutter
from phyradgs_cl.acquisition.cells import per_line_cells
from phyradgs_cl.api import reconstruct
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import psnr
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.runtime import Runtime

SIDE, ROWS, FINER, TIMES = 128, 4, 2, 24
RADIUS, PERIOD, PATCH = 0.46 * SIDE, 4.0, 10.0  # in pixels
ATTENUATION = 2.0 / (2 * RADIUS)
PLACES_PX = [(0.85 * RADIUS * math.cos(a), 0.85 * RADIUS * math.sin(a), a) for a in (0.3, 2.4, 4.5)] + [(0.0, 0.0, 0.0)]


@dataclass(frozen=True)
class Trial:
    """A method with its options. ``label``: the name of the motion or the model in its row."""

    method: str
    label: str
    options: dict[str, object]


TRIALS = (
    Trial("fbp", "ignored", {"motion": "static"}),
    Trial("fbp", "deblurred", {"motion": "static", "deblur": 0.03}),
    Trial("fbp", "deblurred ten times", {"motion": "static", "deblur": 0.003}),
    Trial("sirt", "ignored", {"motion": "static", "iterations": 100}),
    Trial("sirt", "known", {"motion": "per-row", "iterations": 100}),
    Trial("fista", "ignored", {"motion": "static"}),
    Trial("fista", "known", {"motion": "per-row"}),
    Trial("phyradgs", "ignored", {"motion": "static", "iterations": 1500}),
    Trial("phyradgs", "known", {"motion": "exact", "iterations": 1500}),
)


def phantom(side: int) -> np.ndarray:
    """Returns a slice (side, side) of the object in 1/pixel of the panel."""
    axis = (np.arange(side) - (side - 1) / 2) * SIDE / side
    x, y = np.meshgrid(axis, axis)
    field = np.where(np.hypot(x, y) < RADIUS, 1.0, 0.0)
    for number, turn in enumerate((1.1, 3.4, 5.5)):
        at = np.hypot(x - 0.45 * RADIUS * math.cos(turn), y - 0.45 * RADIUS * math.sin(turn))
        field[at < 5 + 2 * number] += 0.3 * (number - 1) or 0.5
    for place in PLACES_PX:
        inside, wave = grating(x, y, place)
        field += np.where(inside, 0.4 * wave, 0.0)
    return ATTENUATION * field


def grating(x: np.ndarray, y: np.ndarray, place: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns where a grating is, and its wave, which follows the motion of its place."""
    dx, dy = x - place[0], y - place[1]
    along = -math.sin(place[2]) * dx + math.cos(place[2]) * dy
    across = math.cos(place[2]) * dx + math.sin(place[2]) * dy
    return (np.abs(along) < PATCH) & (np.abs(across) < PATCH * 0.6), np.cos(2 * np.pi * along / PERIOD)


def modulation(image: np.ndarray, truth: np.ndarray, place: tuple[float, float, float]) -> float:
    """Returns the amplitude of a grating in an image over that in the truth."""
    axis = np.arange(SIDE) - (SIDE - 1) / 2
    x, y = np.meshgrid(axis, axis)
    inside, wave = grating(x, y, place)
    wave = np.where(inside, wave - wave[inside].mean(), 0.0)
    return float((image * wave).sum() / (truth * wave).sum())


def turns_for(views: int, blur_px: float) -> int:
    """Returns the number of turns, coprime to the number of views, that leaves room for exposures of this blur."""
    turns = max(1, math.ceil(views * blur_px / RADIUS / (2 * math.pi)))
    while math.gcd(turns, views) > 1:
        turns += 1
    return turns


def make_scan(rt: Runtime, views: int, blur_px: float, dose: float, seed: int) -> tuple[Scan, np.ndarray]:
    """Returns a fly-scan and the truth (SIDE, SIDE)."""
    speed, arc_rad = 2 * math.pi * turns_for(views, blur_px) / views, blur_px / RADIUS
    shutter = Shutter(arc_rad / speed)
    orbit = CircularOrbit(ParallelGeometry((1, SIDE * FINER), 1 / FINER), ConstantSpeed(0.1, speed))
    grid = Grid((1, SIDE * FINER, SIDE * FINER), (1 / FINER,) * 3)
    light = mean_light(rt, orbit, shutter, np.arange(float(views)), grid, phantom(SIDE * FINER), TIMES, FINER)
    rng = np.random.default_rng(seed)
    counts = rng.poisson(np.repeat(light[:, None], ROWS, 1) * dose)
    frames = -np.log(np.maximum(counts, 0.5) / dose)
    geometry = ParallelGeometry((ROWS, SIDE), 1.0)
    trajectory = CircularOrbit(geometry, ConstantSpeed(0.1, speed))
    start_s, coarse = np.arange(float(views)), Grid((ROWS, SIDE, SIDE), (1.0, 1.0, 1.0))
    scan = Scan(frames.astype(np.float32), geometry, trajectory, shutter, start_s, coarse, detector_model="intensity")
    return scan, phantom(SIDE * 8).reshape(SIDE, 8, SIDE, 8).mean((1, 3))


def mean_light(
    rt: Runtime, orbit: CircularOrbit, shutter: Shutter, start_s: np.ndarray, grid: Grid, field: np.ndarray, times: int,
    finer: int,
) -> np.ndarray:
    """Returns the light (views, columns) behind a slice (y, x), over that without it, for a panel of one row. It is the mean
    of ``times`` times of an exposure and of ``finer`` pixels."""
    columns, light = orbit.geometry.detector_shape[1], []
    one_line = {"line_start": np.zeros(1, np.int32), "line_stop": np.ones(1, np.int32), "weight": np.ones(1)}
    for view, at_s in enumerate(start_s):
        cells = per_line_cells(orbit, shutter, view, float(at_s), 1, times)
        each = (slice(k, k + 1) for k in range(times))
        tables = [replace(cells, pose=cells.pose[k], time_s=cells.time_s[k], **one_line) for k in each]
        frames = RayOperator(rt, grid, (1, columns), tables).forward(field[None].astype(np.float32))[:, 0]
        light.append(np.exp(-frames).mean(0).reshape(columns // finer, finer).mean(1))
    return np.array(light)


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--views", type=int, nargs="+", default=[180, 720, 1800])
    parser.add_argument("--blur-px", type=float, nargs="+", default=[0.5, 1.5, 5.0])
    parser.add_argument("--dose", type=float, nargs="+", default=[1e4, 1e5])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--methods", nargs="+", default=["fbp", "sirt", "fista", "phyradgs"])
    args = parser.parse_args()
    done = {tuple(row[key] for key in KEYS) for row in read_lines(args.results)}
    rt = Runtime(args.device)
    for views, blur_px, dose, seed in (
        (v, b, d, s) for v in args.views for b in args.blur_px for d in args.dose for s in args.seeds
    ):
        trials = [t for t in TRIALS if t.method in args.methods]
        wanted = [t for t in trials if (views, blur_px, dose, seed, t.method, t.label) not in done]
        if not wanted:
            continue
        scan, truth = make_scan(rt, views, blur_px, dose, seed)
        for trial in wanted:
            before_s = time.process_time()
            volume = reconstruct(scan, method=trial.method, device=rt, **trial.options).volume
            image, seen = volume.mean(0, dtype=np.float64), np.repeat(truth[None], ROWS, 0)
            *rim, centre = (modulation(image, truth, place) for place in PLACES_PX)
            values = (views, blur_px, dose, seed, trial.method, trial.label)
            append(args.results, dict(zip(KEYS, values, strict=True)) | {
                "psnr_db": round(float(psnr(volume, seen.astype(np.float32))), 2), "rim": round(float(np.mean(rim)), 3),
                "centre": round(centre, 3), "processor_s": round(time.process_time() - before_s, 1),
            })  # fmt: skip


KEYS = ("views", "blur_px", "dose", "seed", "method", "motion")

if __name__ == "__main__":
    main()
