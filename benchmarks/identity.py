"""Shows whether a change of the code leaves every volume the same: small reconstructions by every method, prior and motion.

    python benchmarks/identity.py FILE.npz [WORD]

It writes the volumes where FILE does not exist. Otherwise it compares them with FILE, prints a line for each volume that
differs, with the size of the difference over the volume's norm, and ends with 1. WORD: takes only the runs whose names hold
it. Bits depend on processor and driver, so compare on one machine."""

import sys
from pathlib import Path

import numpy as np

import phyradgs_cl.api as ct
from phyradgs_cl.acquisition import Scan

FEW = {
    "fista": 4,
    "fista-tv": 4,
    "sirt": 4,
    "sart": 3,
    "os-sart": 3,
    "cgls": 4,
    "asd-pocs": 3,
    "changing": 3,
    "phyradgs": 60,
    "r2": 60,
    "moving": 12,
    "fdk": None,
}
"""Iterations of each method."""
MOTIONS = {"phyradgs": ("static", "micro-views", "centres", "exact"), "r2": ("static",), "fdk": ("static", "per-row")}
OF_RAYS = "static", "per-row", "micro-views"
"""Motion models by method. Those of rays are the same for all other methods."""


def scans() -> dict[str, Scan]:
    """Simulates a cone-beam fly-scan of two blades, and one of parallel beams."""
    cone = ct.simulate("foot", size=20, detector=28, views=12, seed=1, noise="tigre")
    parallel = ct.simulate("foot", size=20, detector=28, views=12, seed=1, scanner="parallel")
    return {"cone": cone, "parallel": parallel}


def runs() -> dict[str, tuple[str, dict[str, object]]]:
    """Returns the scan and the arguments of ``reconstruct`` by the name of a run."""
    every: dict[str, tuple[str, dict[str, object]]] = {}
    for method, iterations in FEW.items():
        steps = {} if iterations is None else {"iterations": iterations}
        for motion in MOTIONS.get(method, OF_RAYS):
            every[f"{method}, {motion}"] = "cone", {"method": method, "motion": motion, **steps}
    for prior in ("ridge", "dct", "tv", "none"):
        every[f"fista, {prior}"] = "cone", {"prior": prior, "iterations": 4}
    start = np.full((20, 20, 20), 0.02, dtype=np.float32)
    every["fista, piccs"] = "cone", {"prior": "piccs", "initial": start, "iterations": 4}
    for model in ("fista", "sirt"):
        every[f"{model}, intensity"] = "cone", {"method": model, "detector_model": "intensity", "iterations": 3}
    every["phyradgs, default"] = "cone", {"method": "phyradgs", "iterations": 60}
    for method in ("fbp", "fista", "sirt"):
        every[f"parallel {method}"] = "parallel", {"method": method, **({} if method == "fbp" else {"iterations": 3})}
    return every


def volumes(word: str) -> dict[str, np.ndarray]:
    """Reconstructs the runs whose names hold the word. Returns volumes (nz, ny, nx) in 1/mm by the name of a run."""
    of_scan, found = scans(), {}
    for name, (scan, arguments) in runs().items():
        if word not in name:
            continue
        found[name] = ct.reconstruct(of_scan[scan], report=False, **arguments).volume
        print(name, file=sys.stderr)
    return found


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Returns the norm of the difference over that of ``one``. It is 0 for the same bits."""
    if np.array_equal(one, other):
        return 0.0
    return float(np.linalg.norm(other - one) / max(float(np.linalg.norm(one)), 1e-30))


def main(path: Path, word: str = "") -> int:
    now = volumes(word)
    if not path.exists():
        np.savez_compressed(path, **now)
        return 0
    with np.load(path) as before:
        sizes = {name: difference(before[name], made) for name, made in now.items() if name in before}
        gone = [name for name in before.files if name not in now and word in name]
    for name, size in sizes.items():
        if size:
            print(f"{name}: {size:.1e}")
    print(f"{sum(not size for size in sizes.values())} of {len(sizes)} volumes have the same bits; not there: {gone}")
    return int(any(sizes.values()) or bool(gone))


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), *sys.argv[2:]))
