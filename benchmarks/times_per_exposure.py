"""Measures how many times of an exposure ``per-row`` needs: PSNR and processor seconds by ``--counts``.

    python benchmarks/times_per_exposure.py VOLUMES docs/results/times_per_exposure.jsonl --counts 5 9 --names cthead
    python docs/make_results.py      # the table

Scans are those of ``priors.py``. There is a line per volume, scan, method and count. ``moved_voxels``: the travel of the rim
in an exposure. Runs in the file are not made again."""

import argparse
import time
from pathlib import Path

from priors import scan_of
from scans import append, files_of, read_lines

from phyradgs_cl.acquisition import PerRow
from phyradgs_cl.acquisition.motion import rim_travel_voxels
from phyradgs_cl.api import compare, reconstruct
from phyradgs_cl.runtime import Runtime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes")
    parser.add_argument("lines", type=Path)
    parser.add_argument("--names", help="with commas; all")
    parser.add_argument("--phantoms", nargs="+", default=[], help="of `simulate`, instead of volumes")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--method", default="fista")
    parser.add_argument("--counts", nargs="+", type=int, default=[5, 9])
    given = parser.parse_args()
    rt, there = Runtime(), read_lines(given.lines)
    phantoms = {name: name for name in given.phantoms}
    for name, path in (phantoms or files_of(given.volumes, given.names, given.size)).items():
        case = {"volume": name, "size": given.size, "views": given.views, "method": given.method}
        facts = {**case, "kind": "fly", "dose": 1e4, "seed": 0}
        counts = [n for n in given.counts if not any({**case, "times": n}.items() <= line.items() for line in there)]
        scan = scan_of(rt, path, facts) if counts else None
        for count in counts:
            assert scan is not None
            start_s = time.process_time()
            result = reconstruct(scan, given.method, motion=PerRow(count), device=rt, report=False)
            seconds = time.process_time() - start_s
            psnr_db = float(compare(result.volume, scan.reference)["psnr_db"])
            values = {"moved_voxels": rim_travel_voxels(scan), "psnr_db": psnr_db, "processor_s": seconds}
            append(given.lines, {**case, "times": count, **{key: round(value, 3) for key, value in values.items()}})


if __name__ == "__main__":
    main()
