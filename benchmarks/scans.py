"""Functions that benchmarks of whole reconstructions share: scans of a folder's volumes, and files of JSON lines."""

import argparse
import json
from collections.abc import Iterable
from pathlib import Path

from tables.case import FLY, SyntheticCase
from tables.volumes import find_volumes

from phyradgs_cl.acquisition import PROTOCOLS, ConeGeometry, Protocol, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import volume_scene

RAPID = PROTOCOLS["rapid"]


def make_scan(rt: Runtime, path: Path, size: int, seed: int, protocol: Protocol = RAPID) -> Scan:
    """Returns the scan of a volume file as benchmarks/tables makes it: R2-Gaussian's scanner, TIGRE's noise (1e4, σ 10).

    size: the reference's voxels per side, half the detector's pixels."""
    detector = 2 * size
    geometry = ConeGeometry(5.0, 7.0, (detector, detector), (4.0 / detector,) * 2)
    scene = volume_scene(rt, load_attenuation(path), f"volume {path}", geometry, Grid.cube(size, 2.0), size, "rows")
    return SyntheticCase(rt, scene, geometry, protocol, "rows", seed).scan(FLY)


def files_of(folder: str | Path, names: str | None, size: int) -> dict[str, Path]:
    """Returns volumes as for benchmarks/tables: those of ``names`` (with commas) or all, of twice ``size`` voxels."""
    try:
        return find_volumes(Path(folder), names.split(",") if names else None, size)
    except InputError as error:
        raise SystemExit(str(error)) from None


def chosen(option: str, names: str, known: Iterable[str]) -> list[str]:
    """Returns the ``names`` of an option, which commas separate. The script ends where one of them is not ``known``."""
    asked = names.split(",")
    if unknown := set(asked) - set(known):
        raise SystemExit(f"{option}: found {', '.join(sorted(unknown))}; expected some of {', '.join(known)}")
    return asked


def lines_of(path: Path) -> list[dict[str, object]]:
    """Returns ``read_lines`` of a file. The script ends where the file does not exist."""
    if not path.is_file():
        raise SystemExit(f"{path}: found no such file; expected JSON lines; check the path")
    return read_lines(path)


def read_lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def append(path: Path, line: dict[str, object]) -> None:
    """Prints a line, and adds it to a file of lines."""
    text = json.dumps(line)
    print(text, flush=True)
    with open(path, "a") as file:
        file.write(text + "\n")


def results_parser(text: str | None) -> argparse.ArgumentParser:
    """Returns a parser with a file of lines and a device."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="JSON lines, appended to; runs that it has are not made again")
    parser.add_argument("--device")
    return parser


def runs_parser(text: str | None, names: str = "--names", seeds: str = "0") -> argparse.ArgumentParser:
    """Returns a parser with a folder of volumes, a file of lines, names of volumes, seeds, and a device."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("volumes", type=Path, help="folder of volumes")
    parser.add_argument("results", type=Path, help="JSON lines, appended to; runs that it has are not made again")
    parser.add_argument(names, dest="names", default=None, help="volumes, with commas; all in the folder by default")
    parser.add_argument("--seeds", type=_numbers, default=_numbers(seeds), help="with commas")
    parser.add_argument("--device", default=None)
    return parser


def _numbers(text: str) -> list[int]:
    return [int(word) for word in text.split(",")]
