"""Measures how near a default of ``fista`` comes to the best of a sweep: its prior's weight, or its number of passes.

    python benchmarks/sweep.py VOLUMES docs/results/prior_weight.jsonl
    python benchmarks/sweep.py VOLUMES docs/results/passes.jsonl --option iterations --holdout 2
    python docs/make_results.py      # the tables of both in docs/results/settings.md

There is a line per volume, scan and factor: the PSNR in dB with ``factor`` times the default of the option. ``--holdout``
adds the error on that percentage of the pixels, which the run does not see. Runs in the file are not made again. Scans are
those of priors.py. Weights are swept with 30 passes on the scan's own voxels
(``subvoxels`` 1), passes with the other defaults."""

import argparse
from itertools import product

from priors import MOTIONS, scan_of
from scans import append, files_of, read_lines, runs_parser

from phyradgs_cl.api import compare, reconstruct
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions
from phyradgs_cl.runtime import Runtime

USUAL = {"prior_weight": {"subvoxels": 1, "iterations": 30}, "iterations": {}}
"""Further options of a run in which an option is swept."""
SCAN = ("kind", "views", "dose", "size", "pixels")


def run(given: argparse.Namespace) -> None:
    rt = Runtime(given.device)
    there = {_key(line) for line in read_lines(given.results)}
    for name, path in files_of(given.volumes, given.names, given.size).items():
        for kind, views, dose, seed in product(given.kinds, given.views, given.doses, given.seeds):
            of_scan = dict(zip(SCAN, (kind, views, dose, given.size, 2 * given.size), strict=True))
            facts = {"volume": name, **of_scan, "seed": seed}
            left = [f for f in given.factors if _key({**facts, "factor": f}) not in there]
            scan = scan_of(rt, path, facts) if left else None
            for factor in left:
                usual = getattr(FistaOptions(), given.option)
                chosen = {**USUAL[given.option], given.option: type(usual)(factor * usual), "motion": MOTIONS[kind]}
                chosen |= {"holdout": given.holdout, "device": rt, "report": False}
                result = reconstruct(scan, "fista", **chosen)  # type: ignore[arg-type]
                scores = compare(result.volume, scan.reference)  # type: ignore[union-attr]
                line = {**facts, "factor": factor, "psnr_db": scores["psnr_db"], "ssim": scores["ssim"]}
                line.update(result.facts.get("held_out", {}))
                append(given.results, line)


def _key(line: dict[str, object]) -> tuple[object, ...]:
    return tuple(line[name] for name in ("volume", *SCAN, "seed", "factor"))


def main() -> None:
    parser = runs_parser(__doc__)
    parser.add_argument("--size", type=int, default=64, help="voxels per side; up to 48 far fewer than what is projected")
    parser.add_argument("--kinds", nargs="+", default=["still"], choices=list(MOTIONS))
    parser.add_argument("--views", nargs="+", type=int, default=[25, 50])
    parser.add_argument("--doses", nargs="+", type=float, default=[1e3, 1e4, 1e5])
    parser.add_argument("--factors", nargs="+", type=float, default=[0.5, 0.71, 1.0, 1.41, 2.0])
    parser.add_argument("--option", choices=list(USUAL), default="prior_weight")
    parser.add_argument("--holdout", type=float, default=0.0, help="percent of the pixels")
    run(parser.parse_args())


if __name__ == "__main__":
    main()
