"""What it is worth to model the detector: intensity averaging, a pulsed beam and lag, each modelled and ignored.

    python benchmarks/detector_models.py [--names shepp-logan,VOLUME.h5] [--json docs/results/detector_models.json]

Rapid fly-scans (25 frames of 14.4 degrees, rows read out) with counts of 1e5 photons and electronic noise of 10, at
peak line integrals of 4 and 6, reconstructed by the iterative methods with a pose for every line and time.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from phyradgs_cl.acquisition import ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import InputOptions, method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import Scene, SimulationOptions, phantom_scene, simulate, volume_scene

VOXELS, PIXELS, SUB_INTERVALS = 48, 72, 5
DOSE, ELECTRONIC_NOISE = 1e5, 10.0
LAGS, PULSE = (0.1, 0.3), (0.86, 0.14)  # the pulse that all lines of the rapid protocol share
ITERATIONS = {"sart": 10, "os-sart": 15, "sirt": 60, "cgls": 12, "asd-pocs": 10, "fista-tv": 50}
GEOMETRY = ConeGeometry(5.0, 7.0, (PIXELS, PIXELS), (4.0 / PIXELS, 4.0 / PIXELS))

Row = dict[str, object]


def scene_of(rt: Runtime, name: str) -> Scene:
    box = Grid.cube(VOXELS, 2.0)
    if name.endswith(".h5"):
        return volume_scene(rt, name, GEOMETRY, box, VOXELS, "rows")
    return phantom_scene(rt, name, GEOMETRY, box, VOXELS, "rows", 0)


def scan_of(scene: Scene, peak: float, pulse: tuple[float, float] | None = None, lag: float = 0.0) -> Scan:
    options = SimulationOptions(
        protocol=make_protocol("rapid", pulse=pulse),
        detector_model="intensity",
        peak=peak,
        noise="beer",
        dose=DOSE,
        electronic_noise=ELECTRONIC_NOISE,
        lag=lag,
    )
    return simulate(scene.source, GEOMETRY, scene.grid, options, reference=scene.reference)


def psnr_db(
    rt: Runtime, scan: Scan, method: str, model: str = "intensity", ignore_lag: bool = False
) -> float:
    changes = {"motion": "per-row", "sub_intervals": SUB_INTERVALS, "iterations": ITERATIONS[method]}
    options = method_options(method, None, {**changes, "detector_model": model})
    before = InputOptions(ignore_lag=ignore_lag)
    return compare(reconstruct(scan, method, rt, options, before=before).volume, scan.reference)["psnr_db"]


def rows(rt: Runtime, name: str) -> Iterator[Row]:
    scene = scene_of(rt, name)
    for peak in (4.0, 6.0):
        scan = scan_of(scene, peak)
        for method in ITERATIONS:
            pair = {model: psnr_db(rt, scan, method, model) for model in ("intensity", "log")}
            yield row(name, peak, method, "intensity", pair["intensity"], pair["log"])
    pulsed = scan_of(scene, 4.0, pulse=PULSE)
    always_on = replace(pulsed, shutter=replace(pulsed.shutter, pulse_s=None))
    for method in ("sart", "fista-tv"):
        modelled, ignored = (psnr_db(rt, scan, method) for scan in (pulsed, always_on))
        yield row(name, 4.0, method, f"pulse {PULSE[0]},{PULSE[1]}", modelled, ignored)
    yield from lag_rows(rt, scene, name)


def lag_rows(rt: Runtime, scene: Scene, name: str) -> Iterator[Row]:
    for lag in LAGS:
        scan = scan_of(scene, 4.0, lag=lag)
        for method in ("sart", "sirt", "fista-tv"):
            modelled, ignored = (psnr_db(rt, scan, method, ignore_lag=ignore) for ignore in (False, True))
            yield row(name, 4.0, method, f"lag {lag}", modelled, ignored)


def row(name: str, peak: float, method: str, effect: str, modelled_db: float, ignored_db: float) -> Row:
    return {
        "object": Path(name).stem,
        "peak": peak,
        "method": method,
        "effect": effect,
        "modelled_db": round(modelled_db, 2),
        "ignored_db": round(ignored_db, 2),
        "gain_db": round(modelled_db - ignored_db, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--names", default="shepp-logan", help="phantoms and volume files, with commas")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--device")
    arguments = parser.parse_args()
    rt, found = Runtime(arguments.device), []
    for name in arguments.names.split(","):
        for line in rows(rt, name):
            found.append(line)
            print(json.dumps(line), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
