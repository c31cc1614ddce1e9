"""Measures the density of a ball in every kind of geometry by every kind of method, and finds silent errors.

    python benchmarks/geometries.py [--quick] [--case WORD] [--method NAME] [--json FILE] [--table FILE.md]

The ball has 0.02 per mm in closed form. Rays pass through the middles of pixels. The ball is off the axis where the field of
view allows. The measured density is the mean of the voxels within 0.6 of its radius, over 0.02. The table has the least and
the largest density of each kind of geometry; `w` counts runs with a warning about the scan or the run. The command ends with
1 if a run without a warning is off by more than 2 %."""

import argparse
import json
import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import PoseTable, Scan
from phyradgs_cl.api import (
    ConeGeometry,
    Grid,
    InputError,
    ParallelGeometry,
    Shutter,
    fly_scan,
    reconstruct,
    static_scan,
)
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

DENSITY_PER_MM = 0.02
LIMIT = 0.02
SWEEPS = 5  # times in a line's exposure
METHODS: dict[str, dict[str, object]] = {
    "fista": {"iterations": 14},
    "fista-tv": {"iterations": 25},
    "sirt": {"iterations": 60},
    "os-sart": {"iterations": 8},
    "cgls": {"iterations": 20, "noise_stop": 0.0},  # the ball's edges would count as noise
    "asd-pocs": {"iterations": 12},
    "fdk": {},
    "phyradgs": {"iterations": 300},
}
OF_FLY_SCANS = ("fista", "sirt", "fdk", "phyradgs")
COSTLY = ("sirt", "asd-pocs", "phyradgs")
KINDS = {
    "fly-scan": "fly-scans of 5°: senses, missing views, helix, tilt, fine voxels",
    "own grid": "rows 0.3 to 4 times as far apart as columns, grid left out",
    "rows": "rows 0.3 to 4 times as far apart as columns",
    "pixel": "pixels of 0.25 to 4 voxels",
    "beside": "panels 0.1 to 0.49 of their width beside the axis, views lost",
    "unit": "units of 10⁻³ to 10⁶ mm",
    "helix": "helices, 6 and 10 mm a turn",
    "tilted": "panel tilted by 3° and rolled by 2°",
    "one row": "one row",
    "": "arcs: 1 to 5 views lost, 240°, 12 views; clockwise; jumps by a turn",
}
"""Kinds of geometries for the table, by a word in a case's name. The first that fits counts."""


@dataclass(frozen=True)
class Case:
    """One geometry. Lengths are in mm at unit 1. The grid is ``voxels`` of ``voxel_mm``, or None for the scan's own grid.

    exposure_deg: the arc of a line's exposure in a fly-scan, whose readout takes as long; 0 for a scanner at rest. feed_mm:
    the way along z per turn. turned: rotates a panel's steps (u, v) in space. unit: mm per unit of length."""

    name: str
    rows: int = 24
    columns: int = 24
    pitch_mm: tuple[float, float] = (1.5, 1.5)
    offset: float = 0.0  # offset over the panel's width
    angles_deg: np.ndarray = field(default_factory=lambda: np.arange(48) * 7.5)
    voxel_mm: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    voxels: tuple[int, int, int] = (20, 20, 20)
    is_parallel: bool = False
    exposure_deg: float = 0.0
    feed_mm: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    unit: float = 1.0
    radius_mm: float = 7.0
    centre_mm: tuple[float, float, float] = (0.6, -0.8, 0.3)

    def geometry(self) -> ConeGeometry | ParallelGeometry:
        shape, sizes = (self.rows, self.columns), np.array(self.pitch_mm) * self.unit / (1.5 if self.is_parallel else 1)
        pitch = (float(sizes[0]), float(sizes[1]))
        offset = 0.0, self.offset * self.columns * pitch[1]
        if self.is_parallel:
            return ParallelGeometry(shape, pitch, offset)
        return ConeGeometry(150.0 * self.unit, 225.0 * self.unit, shape, pitch, offset)

    def poses(self, angles_deg: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) at these angles (...), with travel and tilt."""
        poses = self.geometry().pose(np.deg2rad(angles_deg))
        if self.tilt_deg or self.roll_deg:
            # The panel turns about its middle: roll in its plane, tilt about its rows.
            half_u, half_v = (self.columns - 1) / 2, (self.rows - 1) / 2
            middle = poses[..., 3:6] + half_u * poses[..., 6:9] + half_v * poses[..., 9:12]
            u, v = poses[..., 6:9].copy(), poses[..., 9:12].copy()
            du, dv = (np.linalg.norm(one, axis=-1, keepdims=True) for one in (u, v))
            c, s = np.cos(np.deg2rad(self.roll_deg)), np.sin(np.deg2rad(self.roll_deg))
            u, v = c * u / du + s * v / dv, c * v / dv - s * u / du
            normal = np.cross(u, v)
            v = np.cos(np.deg2rad(self.tilt_deg)) * v + np.sin(np.deg2rad(self.tilt_deg)) * normal
            poses[..., 6:9], poses[..., 9:12] = u * du, v * dv
            poses[..., 3:6] = middle - half_u * poses[..., 6:9] - half_v * poses[..., 9:12]
        turns = (np.asarray(angles_deg) - self.angles_deg.mean()) / 360.0
        travel = self.feed_mm * self.unit * turns
        poses[..., 5] += travel
        if not self.is_parallel:
            poses[..., 2] += travel
        return poses

    def phantom(self) -> EllipsoidPhantom:
        centre, radius = np.array(self.centre_mm) * self.unit, self.radius_mm * self.unit
        ball = Ellipsoid(tuple(centre.tolist()), (radius,) * 3, DENSITY_PER_MM / self.unit)
        return EllipsoidPhantom((ball,), "ball")

    def frames(self) -> np.ndarray:
        """Returns line integrals (F, rows, columns) of the ball. In a fly-scan every row has its own times."""
        opens = np.arange(self.rows) / self.rows if self.exposure_deg else np.zeros(self.rows)
        within = (np.arange(SWEEPS) + 0.5) / SWEEPS if self.exposure_deg else np.zeros(1)
        sense = np.sign(np.gradient(np.unwrap(self.angles_deg, period=360.0)))
        frames = np.zeros((len(self.angles_deg), self.rows, self.columns))
        columns, rows = np.arange(self.columns)[:, None], np.arange(self.rows)[:, None, None]
        for when in within:
            arc_deg = sense[:, None] * self.exposure_deg * (opens + when)
            pose = self.poses(self.angles_deg[:, None] + arc_deg)[:, :, None]
            targets = pose[..., 3:6] + columns * pose[..., 6:9] + rows * pose[..., 9:12]
            sources = np.broadcast_to(pose[..., :3], targets.shape)
            if self.is_parallel:
                along = 100.0 * self.unit * pose[..., :3]
                sources, targets = targets - along, targets + along
            frames += self.phantom().line_integrals(sources, targets) / len(within)
        return frames.astype(np.float32)

    def grid(self) -> Grid | None:
        if self.voxel_mm is None:
            return None
        z, y, x = (side * self.unit for side in self.voxel_mm)
        return Grid(self.voxels, (z, y, x))

    def scan(self) -> Scan:
        frames, grid = self.frames(), self.grid()
        if not (self.feed_mm or self.tilt_deg or self.roll_deg):  # else only a table of poses can describe it
            if not self.exposure_deg:
                return static_scan(frames, self.geometry(), self.angles_deg, grid=grid)
            arc = self.exposure_deg * (1 if np.diff(np.unwrap(self.angles_deg, period=360.0))[0] > 0 else -1)
            ratio = (self.rows - 1) / self.rows
            return fly_scan(frames, self.geometry(), self.angles_deg, exposure_deg=arc, readout_ratio=ratio, grid=grid)
        if not self.exposure_deg:
            return Scan.from_poses(frames, self.poses(self.angles_deg), grid, is_parallel=self.is_parallel)
        # Exposure and readout take a second each: the table ends two seconds after the last frame's start.
        step_deg = self.exposure_deg
        start_s = (self.angles_deg - self.angles_deg[0]) / step_deg
        time_s = np.arange(0, start_s[-1] + 2.1, 0.05)
        table = PoseTable(time_s, self.poses(self.angles_deg[0] + step_deg * time_s), is_parallel=self.is_parallel)
        still = Scan.from_poses(frames, self.poses(self.angles_deg), grid, is_parallel=self.is_parallel)
        shutter = Shutter(1.0, (self.rows - 1) / self.rows, "rows", 1)
        return replace(still, trajectory=table, shutter=shutter, frame_start_s=start_s, is_fly=True)


def cases() -> Iterator[Case]:
    """Yields the geometries, kind by kind."""
    turn = np.arange(48) * 7.5
    for parallel in (False, True):
        beam, of_beam = ("parallel" if parallel else "cone"), partial(Case, is_parallel=parallel)
        for ratio in (0.3, 0.5, 2.0, 4.0):
            rows = max(round(24 / ratio), 6)
            yield of_beam(f"{beam}, rows {ratio:g} × columns apart", rows, 24, (1.5 * ratio, 1.5))
            yield of_beam(f"{beam}, rows {ratio:g} ×, own grid", rows, 24, (1.5 * ratio, 1.5), voxel_mm=None)
        for ratio, panel, radius_mm in ((0.25, 96, 30.0), (0.5, 48, 15.0)):  # edges ring in a ball of 7.5 voxels
            yield of_beam(f"{beam}, pixel {ratio:g} voxels", panel, panel, voxel_mm=(1 / ratio,) * 3, radius_mm=radius_mm)
        for ratio in (1.5, 2.0, 2.5, 3.0, 4.0):
            count = round(20 * ratio)
            yield of_beam(f"{beam}, pixel {ratio:g} voxels", voxel_mm=(20.0 / count,) * 3, voxels=(count,) * 3)
        for offset in (0.1, 0.25, 0.4, 0.45, 0.49):
            yield of_beam(f"{beam}, panel {offset:g} beside", 24, 28, offset=offset)
        for name, angles in {
            "a view lost": np.delete(turn, [20]),
            "two views lost": np.delete(turn, [20, 21]),
            "ends early": np.arange(47) * 7.5,
            "short, 240°": np.arange(48) * 5.0,
            "two gaps": np.delete(turn, [5, 6, 30, 31, 32]),
            "12 views": np.arange(12) * 30.0,
            "clockwise": -turn,
            "jumps by a turn": np.where(turn > 180, turn - 360, turn),
        }.items():
            yield of_beam(f"{beam}, {name}", angles_deg=angles)
            if name != "short, 240°" and name != "12 views":
                yield of_beam(f"{beam}, {name}, panel 0.4 beside", 24, 28, offset=0.4, angles_deg=angles)
        for unit in (1e-3, 1e3, 1e6):
            yield of_beam(f"{beam}, unit {unit:g} mm", unit=unit)
        yield of_beam(f"{beam}, one row", 1, 24, voxel_mm=(1.0,) * 3, voxels=(1, 20, 20), centre_mm=(0.6, -0.8, 0.0))
        for feed, turns in ((6.0, 3), (10.0, 3)):
            angles = np.arange(48 * turns) * 7.5
            yield of_beam(f"{beam}, helix of {feed:g} mm a turn", angles_deg=angles, feed_mm=feed)
        yield of_beam(f"{beam}, tilted by 3°, rolled by 2°", tilt_deg=3.0, roll_deg=2.0)
        moving, lost = {"exposure_deg": 5.0}, np.delete(turn, [20, 21])
        yield of_beam(f"{beam}, fly-scan", **moving)
        yield of_beam(f"{beam}, fly-scan, clockwise", angles_deg=-turn, **moving)
        yield of_beam(f"{beam}, fly-scan, swings back", angles_deg=np.r_[turn, turn[::-1] + 5.0], **moving)
        yield of_beam(f"{beam}, fly-scan, jumps by a turn", angles_deg=np.where(turn > 180, turn - 360, turn), **moving)
        yield of_beam(f"{beam}, fly-scan, panel 0.4 beside", 24, 28, offset=0.4, **moving)
        yield of_beam(f"{beam}, fly-scan, two views lost, panel 0.4 beside", 24, 28, offset=0.4, angles_deg=lost, **moving)
        yield of_beam(f"{beam}, fly-scan, pixel 3 voxels", voxel_mm=(1 / 3,) * 3, voxels=(60,) * 3, **moving)
        yield of_beam(f"{beam}, fly-scan, rows 2 × columns apart", 12, 24, (3.0, 1.5), **moving)
        yield of_beam(f"{beam}, fly-scan, helix", angles_deg=np.arange(144) * 7.5, feed_mm=6.0, **moving)
        yield of_beam(f"{beam}, fly-scan, tilted by 3°, rolled by 2°", tilt_deg=3.0, roll_deg=2.0, **moving)
        yield of_beam(f"{beam}, fly-scan, unit 1e+06 mm", unit=1e6, **moving)


def listened(work: Callable[[], object]) -> tuple[object, list[str]]:
    """Returns what the work returns, or the InputError that it raises, and its warnings."""
    lines: list[str] = []
    logger, heard = logging.getLogger("phyradgs_cl"), logging.Handler(logging.WARNING)
    heard.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(heard)
    try:
        return work(), lines
    except InputError as error:
        return error, lines
    finally:
        logger.removeHandler(heard)


def density(case: Case, volume: np.ndarray, grid: Grid) -> float:
    """Returns the mean within 0.6 of the ball's radius over the ball's own density."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    centre = np.array(case.centre_mm) * case.unit
    distance = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2)
    return float(volume[distance < 0.6 * case.radius_mm * case.unit].mean() * case.unit / DENSITY_PER_MM)


def measured(case: Case, method: str) -> dict[str, object]:
    """Returns the density over the right density, or the refusal, and the warnings of scan and run."""
    scan, of_scan = listened(case.scan)
    if isinstance(scan, InputError):
        return {"case": case.name, "method": method, "refused": str(scan), "warnings": of_scan}
    assert isinstance(scan, Scan)
    named = "fbp" if method == "fdk" and case.is_parallel else method
    motion = {"motion": "per-row"} if case.exposure_deg and method != "phyradgs" else {}
    result, of_run = listened(lambda: reconstruct(scan, named, report=False, **motion, **METHODS[method]))
    row: dict[str, object] = {"case": case.name, "method": method, "warnings": of_scan + of_run}
    if isinstance(result, InputError):
        return {**row, "refused": str(result)}
    return {**row, "density": density(case, result.volume, result.grid)}  # type: ignore[attr-defined]


def is_wrong(row: dict[str, object]) -> bool:
    """Returns whether the density is off by more than the limit without a warning."""
    return "density" in row and abs(float(row["density"]) - 1) > LIMIT and not row["warnings"]  # type: ignore[arg-type]


def table(rows: list[dict[str, object]]) -> str:
    """Returns the matrix in Markdown: the least and the largest density of a kind, and the number of warnings."""
    methods = [name for name in METHODS if any(row["method"] == name for row in rows)]
    lines = ["| geometries | " + " | ".join(methods) + " |", "| --- |" + " --- |" * len(methods)]
    for beam in ("cone", "parallel"):
        for kind, text in KINDS.items():
            cells = []
            for method in methods:
                of_kind = [
                    row for row in rows
                    if row["method"] == method and str(row["case"]).startswith(beam)
                    and next(word for word in KINDS if word in str(row["case"])) == kind
                ]  # fmt: skip
                found = [float(row["density"]) for row in of_kind if "density" in row]  # type: ignore[arg-type]
                warned = sum(bool(row["warnings"]) for row in of_kind)
                refused = len(of_kind) - len(found)
                cell = f"{min(found):.3f} … {max(found):.3f}" if found else ""
                cells.append(cell + f", {warned} w" * bool(warned) + f", {refused} refused" * bool(refused))
            lines.append(f"| {beam}: {text} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="cones and a third of parallel beams, each by one method")
    parser.add_argument("--case", default="", help="only geometries whose names hold this")
    parser.add_argument("--method", choices=METHODS, help="only this method")
    parser.add_argument("--json", type=Path, help="lines of results; those that are there are not run again")
    parser.add_argument("--table", type=Path, help="the matrix, in Markdown")
    words = parser.parse_args()
    lines = words.json.read_text(encoding="utf-8").splitlines() if words.json and words.json.exists() else []
    rows = [json.loads(line) for line in lines]
    done = {(row["case"], row["method"]) for row in rows}
    for number, case in enumerate(case for case in cases() if words.case in case.name):
        names = [name for name in METHODS if not case.exposure_deg or name in OF_FLY_SCANS]
        if words.quick:
            turn, rest = divmod(number, 9)
            kept = [name for name in names if (name in COSTLY) == (rest == 1)]
            names = [] if case.is_parallel and number % 3 else [kept[(turn + rest) % len(kept)]]
        for method in names:
            if (case.name, method) in done or words.method not in (None, method):
                continue
            rows.append(measured(case, method))
            print("WRONG" if is_wrong(rows[-1]) else "ok", json.dumps(rows[-1]), flush=True)
            if words.json:
                with words.json.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
    if words.table:
        words.table.write_text(table(rows), encoding="utf-8")
    wrong = [row for row in rows if is_wrong(row)]
    print(f"{len(rows)} cells, {len(wrong)} wrong without a word", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main())
