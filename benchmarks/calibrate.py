"""Plants errors, and measures what `phyradgs calibrate` finds of them and what that does for the volume.

    python benchmarks/calibrate.py FOLDER RESULTS.jsonl [--cases panel,...] [--only NAME,...] [--size 32] [--views 25]

It writes one line of JSON per run, and continues where it stopped. docs/results/calibrate.md lists the cases, and has the
tables that docs/make_results.py makes from the lines. FOLDER holds volumes as for benchmarks/tables; --only spheres is the
sphere phantom, in closed form. The scanner is R2-Gaussian's with TIGRE's noise and a panel twice as wide as the volume.
Volumes are those of fista-tv, with every line at its own times."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scans import append, chosen, files_of, read_lines, runs_parser
from scipy.spatial.transform import Rotation
from tables.case import FLY, SyntheticCase

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, PerRow, Protocol, Scan
from phyradgs_cl.acquisition.altered.perturbed import (
    GeometryCorrection,
    PerturbedTrajectory,
    Sway,
    Views,
    perturb,
)
from phyradgs_cl.calibrate import calibrate
from phyradgs_cl.calibrate.parameters import PARAMETERS, correction_of
from phyradgs_cl.calibrate.per_view import SPLINES, MotionParameters, WobbleParameters
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.metrics import psnr
from phyradgs_cl.phantoms import Cylinder, Ellipsoid, EllipsoidPhantom, sphere_phantom
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate, volume_scene

ITERATIONS = 60
SPHERES = "spheres"
Maker = Callable[..., Scan]


@dataclass(frozen=True)
class Planned(Protocol):
    """A protocol whose gantry turns the other way, wobbles, or is built with other numbers than stated."""

    is_backwards: bool = False
    views_off: Views | Sway | None = None
    off: GeometryCorrection = GeometryCorrection()

    def orbit(self, geometry: ConeGeometry, jitter_deg: float = 0.0, rng: np.random.Generator | None = None):  # type: ignore[no-untyped-def]
        path = super().orbit(geometry, jitter_deg, rng)
        if self.is_backwards:
            sweeps = path.kinematics
            first, last = -sweeps.angle_start_rad, -sweeps.angle_end_rad
            path = CircularOrbit(geometry, replace(sweeps, angle_start_rad=first, angle_end_rad=last))
        if self.views_off is None and self.off == GeometryCorrection():
            return path
        return PerturbedTrajectory(path, geometry.detector_shape, self.off, self.views_off)


@dataclass(frozen=True)
class Case:
    """The scan as stated, the right scan, other scans, the parameters to ask for, and what is planted by parameter."""

    stated: Scan
    right: Scan
    what: str | None
    planted: dict[str, float]
    others: tuple[Scan, ...] = ()
    is_scored: bool = True
    phantom: EllipsoidPhantom | None = None
    splines: int = 0


def panel(make: Maker, seed: int) -> Case:
    right = make(seed)
    offset_mm = 2.5 * right.geometry.pixel_size_mm[1]
    planted = {"offset-u": offset_mm, "roll": np.deg2rad(0.5), "tilt-v": np.deg2rad(1.0)}
    return Case(_without(right, planted), right, "offset,roll,tilt", planted)


def right(make: Maker, seed: int) -> Case:
    scan = make(seed)
    return Case(scan, scan, None, {})


def columns(make: Maker, seed: int) -> Case:
    return _readout(make(seed, axis="columns"))


def rows(make: Maker, seed: int) -> Case:
    return _readout(make(seed))


def _readout(scan: Scan) -> Case:
    planted = {"readout": scan.shutter.readout_s * (1 - 1 / 1.2)}
    return Case(_without(scan, planted), scan, "readout,exposure", planted)


def turned(make: Maker, seed: int) -> Case:
    scan, back = make(seed), make(seed + 1000, is_backwards=True)
    shutter = scan.shutter
    planted = {"readout": shutter.readout_s * (1 - 1 / 1.2), "exposure": shutter.exposure_s * (1 - 1 / 1.2)}
    return Case(_without(scan, planted), scan, "readout,exposure", planted, (_without(back, planted),))


def wobble(make: Maker, seed: int) -> Case:
    """Plants a wobble without the part that a turned or shifted object explains: its volume could not be compared."""
    scan = make(seed)
    return _shaken(make, scan, seed, np.array([np.deg2rad(0.3), *scan.geometry.pixel_size_mm]))


def slow(make: Maker, seed: int) -> Case:
    scan = make(seed)
    parameters = WobbleParameters.of(scan, 6)
    drawn = parameters.without_gauges(np.random.default_rng(seed).normal(size=(6, 3)))
    size = np.array([np.deg2rad(0.3), *scan.geometry.pixel_size_mm])
    views = parameters.views_of(drawn / np.std(parameters.basis @ drawn, axis=0) * size)
    shaken = make(seed, views_off=views)
    return Case(replace(shaken, trajectory=scan.trajectory), shaken, "wobble", {}, splines=6)


def kaist(make: Maker, seed: int) -> Case:
    """Plants turns about the axis only, where theirs have three axes, and shifts along the panel."""
    scan = make(seed)
    voxel_mm = scan.grid.voxel_size_mm[0] * scan.geometry.magnification
    return _shaken(make, scan, seed, np.array([0.03, voxel_mm, voxel_mm]))


def _shaken(make: Maker, scan: Scan, seed: int, sizes: np.ndarray) -> Case:
    rng = np.random.default_rng(seed)
    parameters = WobbleParameters.of(scan)
    views = parameters.views_of(parameters.without_gauges(sizes * rng.normal(size=(scan.frames, 3))))
    shaken = make(seed, views_off=views)
    return Case(replace(shaken, trajectory=scan.trajectory), shaken, "wobble", {})


def motion(make: Maker, seed: int) -> Case:
    """Plants splines about the mean place, whose coefficients are half drift and half random."""
    scan, rng = make(seed), np.random.default_rng(seed)
    parameters = MotionParameters.of(scan)
    course = np.linspace(-1, 1, SPLINES)[:, None] * rng.choice([-1, 1], 6) + rng.uniform(-1, 1, (SPLINES, 6))
    course = course / np.ptp(parameters.basis @ course, axis=0)
    most = np.array([np.deg2rad(2.0)] * 3 + [2 * scan.grid.voxel_size_mm[0]] * 3)
    sway = parameters.views_of(parameters.without_gauges(course * most))
    shaken = make(seed, views_off=sway)
    return Case(replace(shaken, trajectory=scan.trajectory), shaken, "motion", {})


def beads(make: Maker, seed: int) -> Case:
    """Plants twelve beads and two wires. Readout and exposure are off by 10 to 20 %, the rest as in ``draw``."""
    rng = np.random.default_rng(seed)
    known, lying = drawn_beads(rng)
    size = {
        "offset-u": 0.1, "roll": np.deg2rad(0.5), "tilt-v": np.deg2rad(1.0), "source-distance": 0.1,
        "detector-distance": 0.05, "readout": 0.172, "exposure": 0.2,
    }  # fmt: skip
    planted = {name: most * rng.uniform(0.5, 1) * rng.choice([-1, 1]) for name, most in size.items()}
    times = {name: planted[name] for name in ("readout", "exposure")}
    off = correction_of({name: size for name, size in planted.items() if name not in times})
    right = make(seed, phantom=lying, off=off)
    stated = replace(right, trajectory=right.trajectory.base)  # type: ignore[attr-defined]
    return Case(_without(stated, times), right, None, planted, is_scored=False, phantom=known)


def drawn_beads(rng: np.random.Generator) -> tuple[EllipsoidPhantom, EllipsoidPhantom]:
    """Returns a phantom as its file has it, in R2-Gaussian's scanner, and the same phantom turned and shifted, in mm."""
    centres: list[np.ndarray] = []
    while len(centres) < 12:
        place = rng.uniform(-0.7, 0.7, 3)
        if np.hypot(*place[:2]) < 0.7 and all(np.linalg.norm(place - other) > 0.25 for other in centres):
            centres.append(place)
    ends = [np.array([[x, y, -0.7], [-x, y / 2, 0.7]]) for x, y in ((0.6, 0.3), (-0.2, -0.6))]
    radii = rng.choice([0.05, 0.07], 12)
    turn = Rotation.from_euler("zyx", [rng.uniform(0, 360), *rng.uniform(-10, 10, 2)], degrees=True)
    shift_mm = rng.uniform(-0.05, 0.05, 3)

    def placed(move: Callable[[np.ndarray], np.ndarray]) -> EllipsoidPhantom:
        bodies = [Ellipsoid(tuple(move(at)), (radius,) * 3, 5.0) for at, radius in zip(centres, radii, strict=True)]
        wires = [Cylinder((tuple(move(one)), tuple(move(two))), 0.025, 5.0) for one, two in ends]
        return EllipsoidPhantom((*bodies, *wires), "beads")

    return placed(lambda at: at), placed(lambda at: turn.apply(at) + shift_mm)


def draw(make: Maker, seed: int) -> Case:
    return _drawn(make(seed, axis="columns"), seed)


def draw_rows(make: Maker, seed: int) -> Case:
    return _drawn(make(seed), seed)


def _drawn(right: Scan, seed: int) -> Case:
    rng = np.random.default_rng(seed)
    most = {
        "offset-u": 2.5 * right.geometry.pixel_size_mm[1], "roll": np.deg2rad(0.5), "tilt-v": np.deg2rad(1.0),
        "readout": 0.2 * right.shutter.readout_s,
    }  # fmt: skip
    planted = {name: size * rng.uniform(-1, 1) for name, size in most.items()}
    return Case(_without(right, planted), right, "offset,roll,tilt,readout,exposure", planted, is_scored=False)


def _without(scan: Scan, planted: dict[str, float]) -> Scan:
    return perturb(scan, correction_of({name: -value for name, value in planted.items()}))


CASES = {
    one.__name__: one
    for one in (panel, right, columns, rows, turned, wobble, slow, kaist, motion, beads, draw, draw_rows)
}


def maker(rt: Runtime, path: Path | None, size: int, views: int) -> Maker:
    """Returns a maker of scans of a volume file, or of the sphere phantom."""
    detector = 2 * size
    geometry = ConeGeometry(5.0, 7.0, (detector, detector), (4.0 / detector,) * 2)

    def make(seed: int, axis: str = "rows", phantom: EllipsoidPhantom | None = None, **plan: object) -> Scan:
        where = geometry, Grid.cube(size, 2.0), size, axis
        if phantom is None and path is None:
            scene = phantom_scene(rt, sphere_phantom(1.0), *where, seed)
        elif phantom is None:
            assert path is not None
            scene = volume_scene(rt, load_attenuation(path), f"volume {path}", *where)
        else:
            scene = phantom_scene(rt, phantom, *where, seed, pixel_samples=2)
        protocol = Planned(views=views, exposure_deg=360.0 / views, **plan)  # type: ignore[arg-type]
        if phantom is not None:  # a few times of an exposure are less spread than all of it: an error of 0.2 %
            options = SimulationOptions(protocol, axis, noise="tigre", seed=seed, time_samples=16)
            return simulate(scene.source, geometry, scene.grid, options)
        return SyntheticCase(rt, scene, geometry, protocol, axis, seed).scan(FLY)

    return make


def run_one(rt: Runtime, case: Case) -> dict[str, object]:
    started, cpu_started = time.perf_counter(), time.process_time()
    found = calibrate(case.stated, rt, case.what, case.others, phantom=case.phantom, splines=case.splines)
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - cpu_started
    scans = {"stated": case.stated, "calibrated": found.scan, "right": case.right}
    if not found.corrected and case.stated is case.right:
        scans = {"right": case.right}
    scores = {name: score(rt, scan) for name, scan in scans.items()} if case.is_scored else {}
    return {
        "parameters": [line(one, case.planted) for one in found.parameters],
        "psnr_db": {"stated": scores["right"], "calibrated": scores["right"], **scores} if scores else {},
        **{key: value for key, value in found.facts().items() if key not in ("parameters", "views")},
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
        "device": rt.device.name,
        "version": __version__,
    }


def line(found, planted: dict[str, float]) -> dict[str, object]:  # type: ignore[no-untyped-def]
    truth = planted[found.name] * PARAMETERS[found.name].scale if found.name in planted else 0.0
    if found.found is None or found.name not in PARAMETERS:  # of single views the table has sizes
        return {**found.facts(), "truth": truth + found.stated, "error": None, "z": None}
    error = found.found - found.stated - truth
    return {**found.facts(), "truth": truth + found.stated, "error": error, "z": error / found.deviation}


def score(rt: Runtime, scan: Scan) -> float:
    """Returns the PSNR in dB of fista-tv's volume."""
    options = method_options("fista-tv", None, {"motion": PerRow(3), "iterations": ITERATIONS})
    volume = reconstruct(scan, RunPlan("fista-tv", options), rt).volume
    assert scan.reference is not None
    return round(psnr(volume, scan.reference), 3)


def volumes_of(folder: Path, names: str | None, size: int) -> dict[str, Path | None]:
    """Returns the files of volumes; None for the sphere phantom."""
    given = names.split(",") if names else []
    of_files = ",".join(name for name in given if name != SPHERES)
    files: dict[str, Path | None] = dict(files_of(folder, of_files or None, size)) if of_files or not given else {}
    return files | ({SPHERES: None} if SPHERES in given else {})


def main() -> None:
    parser = runs_parser(__doc__, names="--only", seeds="0,1")
    parser.add_argument("--cases", default=",".join(CASES), help="with commas")
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--views", type=int, default=25)
    asked = parser.parse_args()
    cases, volumes = chosen("--cases", asked.cases, CASES), volumes_of(asked.volumes, asked.names, asked.size)
    rt = Runtime(asked.device)
    key = ("case", "volume", "size", "views", "seed")
    done = {tuple(run[k] for k in key) for run in read_lines(asked.results)}
    for seed in asked.seeds:
        for case in cases:
            for name, path in ({case: None} if case == "beads" else volumes).items():
                what = (case, name, asked.size, asked.views, seed)
                if what not in done:
                    result = run_one(rt, CASES[case](maker(rt, path, asked.size, asked.views), seed))
                    append(asked.results, dict(zip(key, what, strict=True)) | result)


if __name__ == "__main__":
    main()
