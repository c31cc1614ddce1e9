"""Reconstructs objects that move during a scan: as if at rest, with the true field, and with a field that ``moving`` finds.

    python benchmarks/moving.py VOLUMES RESULTS.jsonl [--names a,b] [--views 75,150] [--method fista] [--size 64]
        [--cases rest,known,unknown,still] [--motion breathing]
    python benchmarks/moving.py --insert VOLUMES RESULTS.jsonl [--size 64]: the error of the centre of a ball in a body

Volumes and scanner are those of benchmarks/scans.py: TIGRE's noise at 1e4 photons, a gantry that turns without stopping,
exposures without gaps. A turn takes a minute. The breath has a period of 4 s, jittered by 10 %, and an amplitude of 15 %
of half the box; --motion takes another preset with its own defaults. PSNR and SSIM compare with the reference volume.
Seconds are processor time.

The case unknown has means over ten true states, of the method ``moving`` and of the volume that --method makes as if the
object rested. The case still has ``moving`` and --method on an object at rest. A run that was interrupted continues.
There is a line for each volume, number of views, method, case and motion."""

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scans import append, chosen, files_of, read_lines

from phyradgs_cl import api
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import Deformation, Grid, deformed
from phyradgs_cl.io import Volume, write_volume
from phyradgs_cl.metrics import compare
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors import ObjectMotion, Reconstruction, RunPlan, method_options, reconstruct
from phyradgs_cl.reconstructors.result import MOTION_FOUND
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation.object_motion import ObjectMotion as PresetMotion
from phyradgs_cl.workflow.volumes import compared_states

TURN_S = 60.0
CASES = ("rest", "known", "unknown", "still")


def moving_scan(
    rt: Runtime, path: Path, size: int, views: int, amplitude: float, kind: str = "breathing"
) -> Scan:
    """Returns the scan of a volume file. With an amplitude of 0 the object is at rest."""
    motion = PresetMotion(kind, amplitude=amplitude)
    return api.simulate(
        str(path), size=size, detector=2 * size, views=views, exposure_deg=360 / views, fps=views / TURN_S, noise="tigre",
        dose=1e4, motion_of_object=motion, device=rt,
    )  # fmt: skip


def plan_of(method: str) -> RunPlan:
    motion = "exact" if method == "phyradgs" else "per-row"
    return RunPlan(method, method_options(method, None, {"motion": motion}))


def run_case(rt: Runtime, scan: Scan, case: str, method: str) -> dict[str, float]:
    """Returns PSNR, SSIM, seconds and MiB in buffers of one reconstruction."""
    plan = plan_of(method)
    if case == "known":
        plan = replace(plan, object_motion=ObjectMotion(scan.moving_truth.deformation))
    rt.reset_peak()
    started = time.process_time()
    result = reconstruct(scan, plan, rt)
    seconds = time.process_time() - started
    return {**compare(result.volume, scan.reference), "seconds": round(seconds, 1), "device_mib": rt.peak_bytes >> 20}


def run_insert(rt: Runtime, size: int, folder: Path) -> Iterator[dict[str, object]]:
    """Yields by how many mm the centre of a ball in a breathing body is off in the reference and, as a mean, in true states.

    Reconstructions have the true field, no field, and the field that ``moving`` finds. The reference of ``moving`` is not
    compared, because its field may hold a constant displacement. ``moved_mm``: the ball's largest displacement."""
    body, ball = Ellipsoid((0.0, 0.0, 0.0), (0.7, 0.6, 0.85), 0.4), Ellipsoid((0.1, 0.0, 0.35), (0.2, 0.2, 0.2), 0.4)
    fine = Grid.cube(2 * size, 2.0)
    write_volume(folder / "insert.h5", EllipsoidPhantom((body, ball), "insert").voxelise(fine, 4), fine, {})
    scan = moving_scan(rt, folder / "insert.h5", size, 75, 0.15)
    field = scan.moving_truth.deformation
    moved_mm = float(np.linalg.norm(np.ptp([ball_at(ball, field, state).centre_mm for state in field.weights[::4]], axis=0)))
    for case in ("known", "ignored", "unknown"):
        plan = plan_of("moving" if case == "unknown" else "fista")
        plan = replace(plan, object_motion=ObjectMotion(field) if case == "known" else None)
        result = reconstruct(scan, plan, rt)
        shown_by = field if case == "known" else result.deformation
        line = {"case": "insert", "motion": case, "size": size, "moved_mm": moved_mm}
        line["states_off_mm"] = mean_distance_mm(result, shown_by, scan, ball)
        if case != "unknown":
            off_mm = centre_mm(result.volume, scan.grid, ball) - centre_mm(scan.reference, scan.grid, ball)
            line["off_mm"] = float(np.linalg.norm(off_mm))
        yield line


def mean_distance_mm(result: Reconstruction, field: Deformation | None, scan: Scan, ball: Ellipsoid) -> float:
    """Returns the mean distance of the ball's centre from its place in the true states. ``field`` deforms the volume."""
    truth, distances_mm = scan.moving_truth, []
    for time_s, state in zip(truth.times_s, truth.volumes, strict=True):
        volume = result.volume
        if field is not None:
            volume = deformed(volume, result.grid, field, field.weights_at(time_s)[0])
        at_time = ball_at(ball, truth.deformation, truth.deformation.weights_at(time_s)[0])
        distances_mm.append(np.linalg.norm(centre_mm(volume, result.grid, at_time) - centre_mm(state, scan.grid, at_time)))
    return float(np.mean(distances_mm))


def ball_at(ball: Ellipsoid, field: Deformation, weights: np.ndarray) -> Ellipsoid:
    """Returns the ball at the place of its centre in the state with these weights."""
    return replace(ball, centre_mm=tuple(ball.centre_mm + field.inverse_mm(np.array([ball.centre_mm]), weights)[0]))


def centre_mm(volume: np.ndarray, grid: Grid, ball: Ellipsoid) -> np.ndarray:
    """Returns the centre of the voxels within two radii of the ball that are denser than the mean of body and ball."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    places_mm = np.stack([x, y, z], -1)
    near = np.linalg.norm(places_mm - ball.centre_mm, axis=-1) < 2 * ball.reach_mm
    dense = np.clip(volume[near] - 1.5 * ball.attenuation_per_mm, 0, None)
    return np.average(places_mm[near], axis=0, weights=dense)


def run_unknown(rt: Runtime, scan: Scan, method: str) -> dict[str, object]:
    """Returns means over the true states of ``moving`` and of ``method`` as if the object rested, and the field's error."""
    lines: dict[str, object] = {}
    for name, label in ((method, "static_"), ("moving", "")):
        rt.reset_peak()
        started = time.process_time()
        result = reconstruct(scan, plan_of(name), rt)
        lines[f"{label}seconds"] = round(time.process_time() - started, 1)
        lines |= {label + key: value for key, value in means_over_states(result, scan).items()}
    found = result.facts[MOTION_FOUND]
    return {**lines, "device_mib": rt.peak_bytes >> 20, "moves": found["moves"], "period_s": found["period_s"]}


def run_still(rt: Runtime, scan: Scan, method: str) -> dict[str, object]:
    """Returns what ``moving`` makes of an object at rest: its difference from ``method`` in dB, and its field in voxels."""
    volumes = {name: reconstruct(scan, plan_of(name), rt) for name in (method, "moving")}
    psnr_db = {name: compare(result.volume, scan.reference)["psnr_db"] for name, result in volumes.items()}
    found = volumes["moving"].facts[MOTION_FOUND]
    rms_voxels = found.get("rms_mm", 0.0) / scan.grid.voxel_size_mm[0]
    return {
        "psnr_db": psnr_db["moving"], "static_psnr_db": psnr_db[method], "field_rms_voxels": rms_voxels,
        "moves": found["moves"], "gain": found["gain"],
    }  # fmt: skip


def means_over_states(result: Reconstruction, scan: Scan) -> dict[str, object]:
    volume = Volume(result.volume, result.grid, deformation=result.deformation, states=result.states)
    states = compared_states(volume, scan.moving_truth, scan.grid)
    return {key: value for key, value in states.items() if key.startswith(("mean_", "p95_"))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--names")
    parser.add_argument("--views", default="75")
    parser.add_argument("--method", default="fista")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--motion", default="breathing", choices=("breathing", "drying", "sliding"))
    parser.add_argument("--device")
    parser.add_argument("--insert", action="store_true")
    arguments = parser.parse_args()
    if arguments.insert:
        with tempfile.TemporaryDirectory() as folder:
            for line in run_insert(Runtime(arguments.device), arguments.size, Path(folder)):
                append(arguments.results, line)
        return
    rt, done = Runtime(arguments.device), {key_of(line) for line in read_lines(arguments.results) if "volume" in line}
    for name, path in files_of(arguments.volumes, arguments.names, arguments.size).items():
        for views in (int(n) for n in arguments.views.split(",")):
            scans: dict[bool, Scan] = {}
            for case in chosen("--cases", arguments.cases, CASES):
                facts = {"volume": name, "views": views, "method": arguments.method, "case": case, "size": arguments.size}
                facts |= {} if arguments.motion == "breathing" else {"motion": arguments.motion}
                if key_of(facts) in done:
                    continue
                moves = case not in ("rest", "still")
                if moves not in scans:
                    scans[moves] = moving_scan(rt, path, arguments.size, views, 0.15 if moves else 0.0, arguments.motion)
                if case in ("unknown", "still"):
                    run = (run_unknown if case == "unknown" else run_still)(rt, scans[moves], arguments.method)
                else:
                    run = run_case(rt, scans[moves], case, arguments.method)
                append(arguments.results, {**facts, **run, "device": rt.device.name})


def key_of(line: dict[str, object]) -> tuple[object, ...]:
    return tuple(line.get(key, "breathing") for key in ("volume", "views", "method", "case", "size", "motion"))


if __name__ == "__main__":
    main()
