"""Compares priors of ``fista``, or times in an exposure, in the protocol of the default: a line per scan, seed and choice.

    python benchmarks/priors.py VOLUMES docs/results/priors.jsonl --priors dct ridge
    python benchmarks/priors.py VOLUMES docs/results/times_per_exposure.jsonl --counts 5 9 --kinds fly --views 25
    python docs/make_results.py      # the tables

Scans are those of benchmarks/tables, with the photons of ``--doses`` and the numbers of ``--views``. All exposures of a
fly-scan together cover one turn, unless it has 25 or 50 views. ``numbers`` of a line is the data on which the prior was
trained. ``--counts``: times in an exposure of ``per-row``, by --method in place of priors; ``moved_voxels`` is the travel of
the rim in an exposure. Runs in the file are not made again."""

import argparse
import time
from pathlib import Path

from scans import append, files_of, read_lines

from phyradgs_cl.acquisition import PerRow, Scan, Static
from phyradgs_cl.acquisition.motion import rim_travel_voxels
from phyradgs_cl.api import compare, reconstruct, simulate
from phyradgs_cl.runtime import Runtime

MOTIONS = {"still": Static(), "fly": PerRow()}
NUMBERS = {"ridge": "procedural"}  # the data on which the numbers were trained
ARC_DEG = 360.0  # arc that all views of a fly-scan expose together


def scan_of(rt: Runtime, path: Path | str, facts: dict[str, object]) -> Scan:
    size, views, kind = int(facts["size"]), int(facts["views"]), facts["kind"]  # type: ignore[call-overload]
    usual = {"size": size, "detector": 2 * size, "noise": "tigre", "dose": facts["dose"], "seed": facts["seed"]}
    if kind == "still":
        return simulate(path, protocol="static", views=views, device=rt, **usual)  # type: ignore[arg-type]
    usual |= {"protocol": {25: "rapid", 50: "standard"}[views]} if views in (25, 50) else {
        "protocol": "rapid", "views": views, "exposure_deg": ARC_DEG / views,
    }
    return simulate(path, device=rt, **usual)  # type: ignore[arg-type]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes")
    parser.add_argument("lines", type=Path)
    parser.add_argument("--priors", nargs="+", default=["dct", "ridge"])
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
        for seed in given.seeds for dose in given.doses for views in given.views for kind in given.kinds
        for name in objects
    ]  # fmt: skip
    choices = [{"prior": prior, "numbers": NUMBERS.get(prior)} for prior in given.priors]
    choices = [{"method": given.method, "times": count} for count in given.counts] or choices
    for case in cases:
        rows = [{**case, **choice} for choice in choices]
        rows = [row for row in rows if not any(all(line.get(k, v) == v for k, v in row.items()) for line in there)]
        scan = scan_of(rt, objects[str(case["volume"])], case) if rows else None
        for row in rows:
            before_s = time.process_time()
            chosen = {"prior": row["prior"]} if "prior" in row else {}
            motion = PerRow(row["times"]) if "times" in row else MOTIONS[str(case["kind"])]
            volume = reconstruct(scan, row.get("method", "fista"), motion=motion, device=rt, report=False, **chosen).volume
            scores = compare(volume, scan.reference)
            row |= {"psnr_db": scores["psnr_db"], "ssim": scores["ssim"], "processor_s": time.process_time() - before_s}
            append(given.lines, row | ({"moved_voxels": round(rim_travel_voxels(scan), 3)} if "times" in row else {}))


if __name__ == "__main__":
    main()
