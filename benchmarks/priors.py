"""Compares priors of ``fista``, values of an option, or times in an exposure: a line per scan, seed and choice.

    python benchmarks/priors.py VOLUMES docs/results/priors.jsonl --priors dct ridge
    python benchmarks/priors.py VOLUMES docs/results/prior_weight.jsonl --factors 0.71 1 1.41 --kinds still
    python benchmarks/priors.py VOLUMES docs/results/passes.jsonl --option iterations --factors 0.5 1 2 --holdout 2
    python benchmarks/priors.py VOLUMES docs/results/times_per_exposure.jsonl --counts 5 9 --kinds fly --views 25
    python docs/make_results.py      # the tables

Scans are those of benchmarks/tables, with the photons of ``--doses`` and the numbers of ``--views``. All exposures of a
fly-scan together cover one turn, unless it has 25 or 50 views. ``numbers`` of a line is the data on which the prior was
trained. ``--factors``: of the default of ``--option``; weights of the prior with 30 passes on the scan's own voxels. Choose
one file for each option. ``--holdout`` adds the error on that percentage of the pixels, which the run does not see.
``--counts``: times in an exposure of ``per-row``, by --method in place of priors; ``moved_voxels`` is the travel of
the rim in an exposure. Runs in the file are not made again."""

import argparse
import time
from itertools import product
from pathlib import Path

from scans import append, files_of, read_lines

from phyradgs_cl.acquisition import PerRow, Scan, Static
from phyradgs_cl.acquisition.motion import rim_travel_voxels
from phyradgs_cl.api import compare, reconstruct, simulate
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions
from phyradgs_cl.runtime import Runtime

MOTIONS = {"still": Static(), "fly": PerRow()}
NUMBERS = {"ridge": "procedural"}  # the data on which the numbers were trained
ARC_DEG = 360.0  # arc that all views of a fly-scan expose together
USUAL = {"prior_weight": {"subvoxels": 1, "iterations": 30}, "iterations": {}}
"""Further options of a run in which an option is swept."""


def scan_of(rt: Runtime, path: Path | str, facts: dict[str, object]) -> Scan:
    size, views, kind = int(facts["size"]), int(facts["views"]), facts["kind"]  # type: ignore[call-overload]
    usual = {"size": size, "detector": 2 * size, "noise": "tigre", "dose": facts["dose"], "seed": facts["seed"]}
    if kind == "still":
        return simulate(path, protocol="static", views=views, device=rt, **usual)  # type: ignore[arg-type]
    usual |= {"protocol": {25: "rapid", 50: "standard"}[views]} if views in (25, 50) else {
        "protocol": "rapid", "views": views, "exposure_deg": ARC_DEG / views,
    }
    return simulate(path, device=rt, **usual)  # type: ignore[arg-type]


def options_of(row: dict[str, object], option: str) -> dict[str, object]:
    """Returns the options that the choice in a row stands for."""
    if "prior" in row:
        return {"prior": row["prior"]}
    if "times" in row:
        return {"motion": PerRow(row["times"])}  # type: ignore[arg-type]
    usual = getattr(FistaOptions(), option)
    return {**USUAL[option], option: type(usual)(row["factor"] * usual)}


def _is_of(line: dict[str, object], row: dict[str, object]) -> bool:
    """Returns whether a line is that of a row. Lines of early versions have no ``numbers``."""
    return row.items() <= ({"numbers": row.get("numbers")} | line).items()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes")
    parser.add_argument("lines", type=Path)
    parser.add_argument("--priors", nargs="+", default=["dct", "ridge"])
    parser.add_argument("--factors", nargs="+", type=float, default=[], help="in place of --priors")
    parser.add_argument("--option", choices=list(USUAL), default="prior_weight", help="with --factors")
    parser.add_argument("--holdout", type=float, default=0.0, help="percent of the pixels")
    parser.add_argument("--counts", nargs="+", type=int, default=[], help="in place of --priors")
    parser.add_argument("--method", default="fista", help="with --counts")
    parser.add_argument("--names", help="with commas; all")
    parser.add_argument("--phantoms", nargs="*", default=[], help="in place of VOLUMES: spheres, shepp-logan, ...")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--kinds", nargs="+", default=["still", "fly"], choices=list(MOTIONS))
    parser.add_argument("--views", nargs="+", type=int, default=[25, 50])
    parser.add_argument("--doses", nargs="+", type=float, default=[1e4])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    given = parser.parse_args()
    rt, there = Runtime(), read_lines(given.lines)
    objects = {name: name for name in given.phantoms} or files_of(given.volumes, given.names, given.size)
    cases = [
        {"volume": name, "kind": kind, "views": views, "dose": dose, "size": given.size, "seed": seed}
        for seed, dose, views, kind, name in product(given.seeds, given.doses, given.views, given.kinds, objects)
    ]
    choices: list[dict[str, object]] = [{"prior": prior, "numbers": NUMBERS.get(prior)} for prior in given.priors]
    if given.factors or given.counts:
        choices = [{"pixels": 2 * given.size, "factor": factor} for factor in given.factors]
        choices += [{"method": given.method, "times": count} for count in given.counts]
    for case in cases:
        rows = [{**case, **choice} for choice in choices]
        rows = [row for row in rows if not any(_is_of(line, row) for line in there)]
        scan = scan_of(rt, objects[str(case["volume"])], case) if rows else None
        for row in rows:
            before_s = time.process_time()
            chosen = {"motion": MOTIONS[str(case["kind"])], "holdout": given.holdout, **options_of(row, given.option)}
            result = reconstruct(scan, row.get("method", "fista"), device=rt, report=False, **chosen)
            scores = compare(result.volume, scan.reference)
            row |= {"psnr_db": scores["psnr_db"], "ssim": scores["ssim"], "processor_s": time.process_time() - before_s}
            row |= result.facts.get("held_out", {})
            append(given.lines, row | ({"moved_voxels": round(rim_travel_voxels(scan), 3)} if "times" in row else {}))


if __name__ == "__main__":
    main()
