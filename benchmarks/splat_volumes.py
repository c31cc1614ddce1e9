"""Gaussians fitted to volumes of 64³: error, compression, processor time. One line per run; made runs are kept.

    python benchmarks/splat_volumes.py VOLUMES docs/results/splat_volumes.jsonl [--gaussians 20000,5000] [--device D]

VOLUMES: a folder of HDF5 volumes, whose 128³ ones are averaged over 2³ voxels (docs/export.md#gaussians-of-any-volume).
"""

import argparse
import time
from pathlib import Path

from scans import append, read_lines

from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.gaussians import ROWS
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors.splats.volume_fit import VolumeFitOptions, fit_volume
from phyradgs_cl.runtime import Runtime

VOXELS, BOX_MM = 64, 2.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--gaussians", default="20000,5000")
    parser.add_argument("--device")
    given = parser.parse_args()
    present = {(line["volume"], line["gaussians"]) for line in read_lines(given.results)}
    rt = Runtime(given.device)
    for count in map(int, given.gaussians.split(",")):
        for path in sorted(given.volumes.glob("*_128.h5")):
            name = path.stem.removesuffix("_128")
            if (name, count) in present:
                continue
            values = load_attenuation(path).values.reshape(VOXELS, 2, VOXELS, 2, VOXELS, 2).mean((1, 3, 5))
            started, used = time.perf_counter(), time.process_time()
            result = fit_volume(rt, values, Grid.cube(VOXELS, BOX_MM), VolumeFitOptions(count))
            seconds, processor_s = time.perf_counter() - started, time.process_time() - used
            append(given.results, {
                "volume": name, "gaussians": count, "iterations": VolumeFitOptions().iterations,
                **compare(result.volume, values), "compression": values.size / (ROWS * count),
                "seconds": round(seconds, 2), "processor_s": round(processor_s, 2), "device": rt.device.name,
            })  # fmt: skip


if __name__ == "__main__":
    main()
