"""Measures memory of parallel scans within a limit: ``fbp`` of 16 rows of 2048 columns, ``fista`` of 32 rows of 1024.

    python benchmarks/parallel_memory.py docs/results/parallel_memory.jsonl [--memory 2GiB] [--methods fbp fista] [--quick]

The object is Shepp-Logan over half a turn, with every row the same. ``fbp`` has 1800 views; one pass of ``fista`` has 60,
enough for the memory of its volumes. Scans come from a file, by the code of ``phyradgs reconstruct``. The slab of ``fista``
comes from a panel of 40 rows, as by ``--rows 4:36``. Buffers: the most that the runtime held at one time. Resident: the most
of the whole process, which includes the buffers on a processor. Each method runs in its own process."""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from fbp_peers import sinogram
from scans import append, results_parser

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, ParallelGeometry, Scan, Shutter
from phyradgs_cl.estimate import peak_host_bytes
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.reconstructors.plan import plan_run
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow import run_reconstruction
from phyradgs_cl.workflow.slabs import Slabs

# Columns, rows of the panel, views, rows that are reconstructed, options.
RUNS = {"fbp": (2048, 16, 1800, (0, 16), {}), "fista": (1024, 40, 60, (4, 36), {"iterations": 1})}


def write(path: Path, columns: int, rows: int, views: int) -> None:
    """Writes the scan file."""
    lines, _ = sinogram(columns, views)
    geometry, start_s = ParallelGeometry((rows, columns), 1.0), np.arange(float(views))
    orbit = CircularOrbit(geometry, ConstantSpeed(0.0, np.pi / views))
    frames = np.repeat(lines[:, None], rows, 1)
    write_scan(path, Scan(frames, geometry, orbit, Shutter(0.0), start_s, Grid((rows, columns, columns), (1.0,) * 3), False))


def measured(method: str, memory: str, quick: bool, device: str | None) -> dict[str, object]:
    """Returns the row of a method's run in this process."""
    columns, rows, views, kept, options = RUNS[method]
    if quick:
        columns, views = columns // 16, 60
    with tempfile.TemporaryDirectory() as folder:
        path, output = Path(folder) / "scan.h5", Path(folder) / "volume.h5"
        subprocess.run([sys.executable, __file__, str(path), "--write", *map(str, (columns, rows, views))], check=True)
        rt, before_s = Runtime(device, memory=memory), time.process_time()
        run_reconstruction(plan_run(method, options), path, output, lambda: rt, slabs=Slabs(kept))
        seconds = time.process_time() - before_s
    facts = {"method": method, "columns": columns, "rows": kept[1] - kept[0], "views": views, **options, "limit": memory}
    return facts | {"buffer_bytes": rt.peak_bytes, "host_bytes": peak_host_bytes(), "processor_s": round(seconds)}


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--memory", default="2GiB")
    parser.add_argument("--methods", nargs="+", default=list(RUNS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--write", type=int, nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.write:
        write(args.results, *args.write)
    elif args.here:
        append(args.results, measured(args.methods[0], args.memory, args.quick, args.device))
    else:
        for method in args.methods:
            subprocess.run([sys.executable, *sys.argv, "--here", "--methods", method], check=True)


if __name__ == "__main__":
    main()
