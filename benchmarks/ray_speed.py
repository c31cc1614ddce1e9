"""Compares the speed of the ray-driven projector and its adjoint with RTK's Joseph projectors, and between motion models.

    python -m venv PEER && PEER/bin/pip install itk-rtk numpy
    python benchmarks/ray_speed.py --peer-python PEER/bin/python [--json docs/results/ray_speed.json] [--device D]

The scanner has its source 600 mm from the axis and 1200 mm from the detector, with a full turn of 90 views of 128 x 128
pixels of 4 mm, and 128^3 voxels of 2 mm. Ours and RTK's operators take turns, both from host arrays to host arrays. Times
are the smallest of all runs. The volume is random with a border of zeros, because RTK ends a volume half a voxel earlier;
frames are random. Results are compared away from that border. RTK's adjoint runs on one thread. Where the machine is busy,
processor time over all threads says more than wall time.

Motion models are compared with each other on a rolling shutter that exposes for half a view and reads for the other half;
``gapless`` exposes for a whole view. Panels that lean are rolled by 0.3 degrees and tilted by 0.5."""

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import finish, parser_of

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter, Trajectory
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, PerturbedTrajectory
from phyradgs_cl.acquisition.cells import common_time_cells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.runtime import Runtime

VIEWS, PIXELS, VOXELS = 90, 128, 128
BORDER = 2  # in voxels
SID_MM, SDD_MM, PIXEL_MM, VOXEL_MM = 600.0, 1200.0, 4.0, 2.0
EXPOSURE_S, READOUT_S, VIEW_S = 0.5, 0.5, 1.0
ROLL_DEG, TILT_DEG = 0.3, 0.5

Seconds = dict[str, float]


def tables(motion: str) -> list[TimeCells]:
    """Returns the cells of a full turn. ``still`` is a gantry at rest, which is all that RTK knows."""
    geometry = ConeGeometry(SID_MM, SDD_MM, (PIXELS, PIXELS), (PIXEL_MM, PIXEL_MM))
    orbit: Trajectory = CircularOrbit(geometry, ConstantSpeed(0.0, 2 * np.pi / VIEWS / VIEW_S))
    if motion.endswith("leaning"):
        lean = GeometryCorrection(roll_rad=np.deg2rad(ROLL_DEG), tilt_u_rad=np.deg2rad(TILT_DEG))
        orbit = PerturbedTrajectory(orbit, (PIXELS, PIXELS), lean)
    shutter = Shutter(0.0) if motion == "still" else Shutter(EXPOSURE_S, READOUT_S)
    if motion.startswith("gapless"):
        shutter = Shutter(VIEW_S, READOUT_S)
    wheres = [(orbit, shutter, frame, frame * VIEW_S, PIXELS) for frame in range(VIEWS)]
    if motion == "micro-views 8x5":
        return [micro_view_cells(*where, 8, 5) for where in wheres]
    if motion.startswith("own times"):
        return [per_line_cells(*where, 5) for where in wheres]
    if motion.startswith(("per-row", "gapless")):
        start_s = VIEW_S * np.arange(VIEWS)
        return [common_time_cells(orbit, shutter, frame, start_s, PIXELS, 5) for frame in range(VIEWS)]
    return [static_cells(*where) for where in wheres]


INNER: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "forward": lambda frames: frames,
    "adjoint": lambda volume: volume[BORDER:-BORDER, BORDER:-BORDER, BORDER:-BORDER],
}
MOTIONS = (
    "static", "static, leaning", "per-row 5", "per-row 5, leaning", "gapless per-row 5", "own times 5", "micro-views 8x5",
)  # fmt: skip


def timed(call: Callable[[], np.ndarray]) -> Seconds:
    started = time.perf_counter(), time.process_time()
    call()
    return {"wall_s": time.perf_counter() - started[0], "processor_s": time.process_time() - started[1]}


class Peer:
    """RTK in a process of its own, which answers one request at a time."""

    def __init__(self, python: str, folder: Path, volume: np.ndarray, frames: np.ndarray) -> None:
        """volume (z, y, x) 1/mm, frames (F, rows, columns); RTK's (X, Y, Z) are (y, z, x) here."""
        np.savez(
            folder / "task.npz",
            volume=volume.transpose(2, 0, 1),
            frames=frames,
            gantry_deg=np.arange(VIEWS) * 360 / VIEWS,
            sid_mm=SID_MM,
            sdd_mm=SDD_MM,
            pixel_mm=PIXEL_MM,
            voxel_mm=VOXEL_MM,
        )
        script = str(Path(__file__).with_name("rtk_peer.py"))
        pipe = subprocess.PIPE
        self.folder = folder
        self.process = subprocess.Popen([python, script, str(folder)], stdin=pipe, stdout=pipe, text=True)
        self.facts: dict[str, object] = self._answer()

    def run(self, name: str) -> Seconds:
        assert self.process.stdin is not None
        self.process.stdin.write(name + "\n")
        self.process.stdin.flush()
        return self._answer()

    def result(self, name: str) -> np.ndarray:
        """Returns frames, or a volume (z, y, x), of the last run."""
        values = np.load(self.folder / f"{name}.npy")
        return values if name == "forward" else values.transpose(1, 2, 0)

    def _answer(self) -> dict:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("the peer ended without an answer: does its Python have itk-rtk?")
        return json.loads(line)


def least(runs: list[Seconds]) -> Seconds:
    return {key: min(run[key] for run in runs) for key in runs[0]}


def beside_rtk(rt: Runtime, grid: Grid, volume: np.ndarray, python: str, repeats: int) -> dict[str, dict[str, object]]:
    """Returns the seconds of both, their ratios, and the relative RMS difference of their results, by operator."""
    operator = RayOperator(rt, grid, (PIXELS, PIXELS), tables("still"))
    frames = np.random.default_rng(1).uniform(0, 1, operator.frames_shape).astype(np.float32)
    mine = {"forward": lambda: operator.forward(volume), "adjoint": lambda: operator.adjoint(frames)}
    result: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as folder:
        peer = Peer(python, Path(folder), volume, frames)
        for name, call in mine.items():
            own = INNER[name](call())
            peer.run(name)
            runs = [(timed(call), peer.run(name)) for _ in range(repeats)]
            ours, theirs = least([a for a, _ in runs]), least([b for _, b in runs])
            other = INNER[name](peer.result(name))
            result[name] = {
                "ours": ours,
                "rtk": theirs,
                "times_as_fast_wall": theirs["wall_s"] / ours["wall_s"],
                "times_as_fast_processor": theirs["processor_s"] / ours["processor_s"],
                "relative_rms_difference": float(np.linalg.norm(own - other) / np.linalg.norm(other)),
            }
        result["peer"] = peer.facts
        peer.process.communicate()  # ends it
    return result


def by_motion(rt: Runtime, grid: Grid, volume: np.ndarray, repeats: int) -> dict[str, dict[str, Seconds]]:
    """Returns the seconds of forward and adjoint with every motion model, run in turns."""
    operators = {motion: RayOperator(rt, grid, (PIXELS, PIXELS), tables(motion)) for motion in MOTIONS}
    frames = operators["static"].forward(volume)
    runs: dict[str, dict[str, list[Seconds]]] = {m: {"forward": [], "adjoint": []} for m in MOTIONS}
    for _ in range(repeats):
        for motion, operator in operators.items():
            runs[motion]["forward"].append(timed(lambda o=operator: o.forward(volume)))
            runs[motion]["adjoint"].append(timed(lambda o=operator: o.adjoint(frames)))
    return {motion: {step: least(times) for step, times in steps.items()} for motion, steps in runs.items()}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--peer-python", default=None, help="a Python that has itk-rtk; without it, no comparison")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    rt = Runtime(arguments.device)
    grid = Grid.cube(VOXELS, VOXELS * VOXEL_MM)
    inside = np.random.default_rng(0).uniform(0, 1, (VOXELS - 2 * BORDER,) * 3)
    volume = np.pad(inside, BORDER).astype(np.float32)
    peer = arguments.peer_python
    facts = {
        "device": rt.device.name,
        "lanes": rt.lanes,
        "case": f"{VOXELS}^3 voxels, {VIEWS} views of {PIXELS}^2 pixels",
        "repeats": arguments.repeats,
        "beside_rtk": beside_rtk(rt, grid, volume, peer, arguments.repeats) if peer else {},
        "by_motion": by_motion(rt, grid, volume, arguments.repeats),
    }
    finish(facts, arguments.json)


if __name__ == "__main__":
    main()
