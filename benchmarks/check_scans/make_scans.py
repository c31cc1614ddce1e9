"""Makes good scans and scans with planted faults for `phyradgs check`, by a projector that is not this project's: RTK's.

    python -m venv PEER && PEER/bin/pip install itk-rtk numpy h5py tifffile
    PEER/bin/python benchmarks/check_scans/make_scans.py OUT --volumes DIR [--only NAME] [--phyradgs CMD]

Nothing here imports phyradgs_cl. RTK computes line integrals at moments 0.6 degrees apart: by Joseph's method in a volume of
64^3 voxels, in closed form for Shepp-Logan. Every line averages intensities over its own exposure. NumPy counts photons,
flats and darks; h5py writes docs/formats.md by the letter. A few scans are TIFF folders or RTK's files, which
`phyradgs import` reads; the folders stay in OUT/source. DIR holds NAME_128.h5 with a dataset `volume` (z, y, x).

OUT/good and OUT/fault get the scans. OUT/manifest.jsonl has one line for each: file, group, kind, object and planted fault,
the questions that should alarm, and why a fault cannot be decided. A scan that is in the manifest is not made again."""

import argparse
import json
import os
import shlex
import sys
import time
import zlib
from pathlib import Path

import numpy as np
from files import imported, write_nxtomo, write_rtk, write_tiffs
from kinds import FAULTS, GOOD, Kind
from objects import another, density
from recording import SHEPP_LOGAN, counted, transmissions


def make(kind: Kind, group: str, out: Path, volumes: Path, command: list[str], seed: int) -> dict[str, object]:
    """Makes one scan; returns the manifest's line. ``seed``: of noise; if not 0, other volumes are taken too."""
    setup, panel = kind.setup, kind.counting
    scanned = another(kind.scanned, seed)
    shape = None if scanned == SHEPP_LOGAN else density(scanned, volumes)
    passed = transmissions(setup, shape, panel.peak)
    name = f"{group}/{kind.name}.h5"
    target, source = out / name, out / "source" / kind.name
    part = target.with_suffix(".part.h5")
    rng = np.random.default_rng([zlib.crc32(kind.name.encode()), *([seed] if seed else [])])
    if kind.form in ("attenuation", "transmission"):
        write_nxtomo(
            part, kind.name, kind.statement, -np.log(passed) if kind.form == "attenuation" else passed
        )
    elif kind.form == "rtk":
        write_rtk(source, kind.statement, -np.log(passed))
        imported(command, source, part, [])
    else:
        gain = kind.gain(np.linspace(0.0, 1.0, setup.views))
        recorded = kind.spoil(counted(panel, passed, gain, rng))
        if kind.form == "tiff":
            write_tiffs(source, kind.name, kind.statement, recorded, kind.writing.get("flat_value"))
            imported(command, source, part, ["--detector-model", setup.model])
        else:
            write_nxtomo(part, kind.name, kind.statement, recorded, **kind.writing)
    os.replace(part, target)
    return {
        "file": name,
        "group": group,
        "kind": kind.name,
        "object": scanned,
        "planted": kind.planted,
        "right": kind.right,
        "undecidable": kind.undecidable,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--volumes", type=Path, required=True)
    parser.add_argument("--only", action="append", help="a scan's name; repeatable")
    parser.add_argument("--seed", type=int, default=0, help="other noise, and stored volumes in each other's place")
    parser.add_argument("--phyradgs", default="phyradgs", help="the command that imports")
    options = parser.parse_args()
    for folder in ("good", "fault", "source"):
        (options.out / folder).mkdir(parents=True, exist_ok=True)
    manifest = options.out / "manifest.jsonl"
    lines = manifest.read_text("utf-8").splitlines() if manifest.exists() else []
    there = {json.loads(line)["kind"] for line in lines}
    for group, kinds in (("good", GOOD), ("fault", FAULTS)):
        for kind in kinds:
            if kind.name in there or (options.only and kind.name not in options.only):
                continue
            started = time.perf_counter()
            line = make(kind, group, options.out, options.volumes, shlex.split(options.phyradgs), options.seed)
            with manifest.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(f"{line['file']}: {time.perf_counter() - started:.1f} s", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
