"""Metal in a polychromatic beam: two beads in water or in a volume, with and without `prepare --steps metal`.

    python benchmarks/metal.py [VOLUME.h5 ...] [--metals steel,titanium] [--views 120]

The beam is SpekPy's at 120 kV behind 5 mm of aluminium, with 2·10⁵ photons. Streak energy: mean square of the difference to
the volume of the same scan without beads, 10⁻⁶/mm². It and the PSNR count voxels more than two away from the metal."""

import argparse
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from scipy import ndimage

from phyradgs_cl import api
from phyradgs_cl.detector import tube_spectrum
from phyradgs_cl.detector.attenuation import _BONE, _WATER, _at
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

SIDE, GRID, PHOTONS = 64, api.Grid.cube(64, 120.0), 2e5
BONE_G_PER_CM3 = 1.92
IRON = ((10, 170.6), (20, 25.68), (30, 8.176), (40, 3.629), (60, 1.205), (80, 0.5952), (100, 0.3717), (150, 0.1964))
TITANIUM = ((10, 110.7), (20, 15.85), (30, 4.972), (40, 2.214), (60, 0.7661), (80, 0.4052), (100, 0.2721), (150, 0.1649))
METALS = {"steel": (7.87, IRON), "titanium": (4.51, TITANIUM)}
"""g/cm³, and cm²/g at energies in keV (NIST)."""


def beads() -> tuple[np.ndarray, ...]:
    """Shares (z, y, x) of water, bone and metal: an ellipsoid with a rod, a dent and two beads of 8 mm."""
    places = {
        "body": ((0, 0, 0), (45, 35, 48)), "rod": ((0, 18, 0), (7, 7, 40)), "dent": ((-15, -8, 5), (8, 8, 8)),
        "left": ((22, -5, 0), (4, 4, 4)), "right": ((-20, 8, 0), (4, 4, 4)),
    }  # fmt: skip
    bodies = {name: Ellipsoid(centre, axes, 1.0) for name, (centre, axes) in places.items()}
    share = {name: EllipsoidPhantom((body,), name).voxelise(GRID, 3) for name, body in bodies.items()}
    soft = np.clip(share["body"] - share["rod"] - 0.3 * share["dent"], 0, None)
    return soft, share["rod"], share["left"] + share["right"]


def of_volume(path: Path) -> tuple[np.ndarray, ...]:
    """The same of a volume, with a bead inside its matter at either end of x."""
    with h5py.File(path) as file:
        values = file["volume"][()].astype(np.float32)
    step = len(values) // SIDE
    values = values.reshape(SIDE, step, SIDE, step, SIDE, step).mean((1, 3, 5))
    values /= np.median(values[values > 0.15 * values.max()])
    inner = np.argwhere(ndimage.binary_erosion(values > 0.6, iterations=3))
    inner = inner[np.argsort(np.abs(inner[:, 0] - SIDE // 2), kind="stable")[:800]]
    ends = (inner[np.argmin(inner[:, 2])], inner[np.argmax(inner[:, 2])])
    places = np.moveaxis(np.indices(values.shape), 0, -1)
    metal = np.max([np.sum((places - end) ** 2, -1) <= 2.1**2 for end in ends], axis=0).astype(np.float32)
    return 0.9 * np.minimum(values, 1.4) * (1 - metal), 0.4 * np.clip(values - 1.4, 0, None) * (1 - metal), metal


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("volumes", nargs="*", type=Path)
    parser.add_argument("--metals", default="steel")
    parser.add_argument("--views", type=int, default=120)
    words = parser.parse_args()
    cone = api.ConeGeometry(785.0, 1200.0, (72, 72), 2.95)
    angles_deg = np.arange(words.views) * 360 / words.views
    empty = api.static_scan(np.zeros((words.views, 72, 72), np.float32), cone, angles_deg, grid=GRID)
    objects = [(path.stem, of_volume(path)) for path in words.volumes] or [("water", beads())]
    for name, parts in objects:
        for metal in words.metals.split(","):
            compare(empty, f"{name} | {metal}", parts, *METALS[metal])


def compare(empty: api.Scan, name: str, parts: tuple[np.ndarray, ...], g_per_cm3: float, table: tuple) -> None:
    """Prints a row for each method: PSNR without metal, with it and with the step; streaks; does a clean scan stay?"""
    project, spectrum = api.ray_operator(empty), tube_spectrum(120.0, 5.0, 12.0)
    energies, cm2_per_g = np.log(np.array(table).T)
    metal = np.exp(np.interp(np.log(spectrum.energy_kev), energies, cm2_per_g)) * g_per_cm3
    per_mm = np.stack([_at(spectrum.energy_kev, _WATER), _at(spectrum.energy_kev, _BONE) * BONE_G_PER_CM3, metal]) / 10
    paths, scans = np.stack([project(part.astype(np.float32)) for part in parts]), []
    for has_metal in (False, True):
        paths_mm = paths * np.array([1, 1, has_metal])[:, None, None, None]
        light = sum(w * np.exp(-np.tensordot(mu, paths_mm, 1)) for w, mu in zip(spectrum.weight, per_mm.T, strict=True))
        counts = np.maximum(np.random.default_rng(0).poisson(PHOTONS * light), 1)
        scans.append(replace(empty, projections=-np.log(counts / PHOTONS).astype(np.float32)))
    scans.append(api.prepare(scans[1], "metal"))
    stays = api.prepare(scans[0], "metal").projections is scans[0].projections
    truth = parts[0] * float(spectrum.weight @ per_mm[0]) + parts[1] * float(spectrum.weight @ per_mm[1])
    far = ~ndimage.binary_dilation(parts[2] > 0.02, iterations=2)
    for method, options in (("fdk", {}), ("fista", {"iterations": 15})):
        volumes = [api.reconstruct(scan, method, report=False, **options).volume[far] for scan in scans]
        db = [20 * np.log10(truth[far].max() / np.sqrt(np.mean((volume - truth[far]) ** 2))) for volume in volumes]
        streaks = [1e6 * float(np.mean((volume - volumes[0]) ** 2)) for volume in volumes[1:]]
        numbers = " | ".join([*(f"{one:.2f}" for one in db), *(f"{one:.3f}" for one in streaks)])
        print(f"| {name} | {method} | {numbers} | {'yes' if stays else 'no'} |", flush=True)


if __name__ == "__main__":
    main()
