"""What a command costs before it does anything: seconds, processor seconds, and what its imports take.

    python benchmarks/startup.py [--repeat 5] [--json FILE]

Prints a table in Markdown: the best of some runs of each command, the sum of `python -X importtime`, and the packages that
take most of it. The budget is 0.5 s on a quiet machine.
"""

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume

START = "from phyradgs_cl.__main__ import main; main()"
SHOWN = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = [measured(words, name, options.repeat) for name, words in commands(Path(folder))]
    load = os.getloadavg()[0]
    print(f"Load of the machine: {load:.1f} on {os.cpu_count()} cores.\n")
    print("| command | wall, s | CPU, s | imports, s | most of it, ms |\n| --- | ---: | ---: | ---: | --- |")
    for row in rows:
        most = ", ".join(f"{name} {ms:.0f}" for name, ms in row["packages_ms"].items())
        numbers = " | ".join(f"{row[key]:.2f}" for key in ("wall_s", "cpu_s", "import_s"))
        print(f"| `{row['command']}` | {numbers} | {most} |")
    if options.json:
        options.json.write_text(json.dumps({"load": load, "rows": rows}, indent=1), encoding="utf-8")


def commands(folder: Path) -> list[tuple[str, list[str]]]:
    """Returns the commands that are measured: their names and words."""
    volume, grid = folder / "volume.h5", Grid.cube(96, 100.0)
    values = np.random.default_rng(0).random(grid.shape, dtype=np.float32)
    write_volume(volume, values, grid, {"method": "noise"})
    return [
        ("phyradgs --help", ["--help"]),
        ("phyradgs reconstruct --help", ["reconstruct", "--help"]),
        ("phyradgs reconstruct --nonsense", ["reconstruct", "--nonsense"]),
        ("phyradgs info volume.h5", ["info", str(volume)]),
        ("phyradgs export volume.h5 --to nii (96³)", ["export", str(volume), "--to", "nii"]),
    ]


def measured(words: list[str], name: str, repeat: int) -> dict[str, object]:
    """The best of ``repeat`` runs, and the imports of one more."""
    command = [sys.executable, "-c", START, *words]
    wall_s, cpu_s = (min(column) for column in zip(*(timed(command) for _ in range(repeat)), strict=True))
    told = subprocess.run([command[0], "-X", "importtime", *command[1:]], capture_output=True, text=True, check=False)
    own = Counter[str]()
    for microseconds, module in re.findall(r"^import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", told.stderr, re.MULTILINE):
        own[module.split(".")[0]] += int(microseconds) / 1000
    return {
        "command": name,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "import_s": own.total() / 1000,
        "packages_ms": dict(own.most_common(SHOWN)),
    }


def timed(command: list[str]) -> tuple[float, float]:
    """Seconds by the clock, and of processors, of a process and those that it waits for."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, capture_output=True, check=False)
    wall_s, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
