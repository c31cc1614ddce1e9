"""Runs `make demo`: a fly-scan reconstructed with its motion ignored and with it known, a table and a picture.

    python benchmarks/demo.py FOLDER [--quick]

Seconds are processor seconds (user and system) of the whole command, so that other programs do not change them."""

import argparse
import resource
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from phyradgs_cl.io import Volume, read_volume
from phyradgs_cl.metrics import psnr
from phyradgs_cl.workflow import load_reference

OPTIONS = Path(__file__).resolve().parents[1] / "data" / "demo.toml"
SCAN = ("--phantom", "foot", "--protocol", "rapid", "--noise", "tigre", "--dose", "1e4", "--electronic-noise", "10")
RUNS = {
    "fdk": ("fdk", "ignored", ("--method", "fdk", "--motion", "static")),
    "static": ("fista", "ignored", ("--motion", "static")),
    "moving": ("fista", "known", ()),
    "splats": ("phyradgs", "known", ("--method", "phyradgs", "--config", str(OPTIONS))),
}
"""The runs by file name: method and motion, as the table prints them, and the options of `phyradgs reconstruct`."""
_HEIGHT = 0.28  # height of the drawn slice over the volume's height
_CROP = slice(0.28, 0.98), slice(0.33, 0.69)  # part of that slice along y and x that holds the foot


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quick", action="store_true", help="small: to see that it runs")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    size, quick = ("16", ("--iterations", "10")) if given.quick else ("64", ())
    scan = given.folder / "scan.h5"
    shape = ("--size", size, "--detector", str(2 * int(size)), "--seed", "0")
    total_s = run("simulate", *SCAN, *shape, "-o", str(scan))
    rows: list[tuple[str, str, Volume, float]] = []
    for name, (method, motion, options) in RUNS.items():
        path = given.folder / f"{name}.h5"
        iterations = () if method == "fdk" else quick
        used_s = run("reconstruct", str(scan), *options, *iterations, "-o", str(path))
        rows.append((method, motion, read_volume(path), used_s))
        total_s += used_s
    print(f"\n{'method':8s}  {'motion':7s}  PSNR (dB)    SSIM  processor seconds")
    for method, motion, stored, used_s in rows:
        metrics = stored.metrics or {}
        print(f"{method:8s}  {motion:7s}  {metrics['psnr_db']:9.2f}  {metrics['ssim']:6.4f}  {used_s:17.1f}")
    print(f"{'all, with the simulation':35s}  {total_s:17.1f}")
    picture = given.folder / "demo.png"
    truth = load_reference(scan)[0].values
    ignored, known = (rows[list(RUNS).index(name)][2].values for name in ("static", "moving"))
    draw(truth, {"motion ignored": ignored, "motion known": known}, picture)
    print(f"picture: {picture}")


def run(*words: str) -> float:
    """Runs a command of `phyradgs` and returns the processor seconds that it took."""
    print("phyradgs", *words, flush=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "phyradgs_cl", *words], check=False)
    if done.returncode:
        sys.exit(done.returncode)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def draw(truth: np.ndarray, volumes: Mapping[str, np.ndarray], path: Path) -> None:
    """Draws one slice of the truth (z, y, x) and of each volume, on one grey scale, and below them the errors."""
    z = round(_HEIGHT * truth.shape[0])
    part = z, *(slice(round(s.start * n), round(s.stop * n)) for s, n in zip(_CROP, truth.shape[1:], strict=True))
    most = float(truth[part].max())
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    axes = figure.subplots(2, 1 + len(volumes))
    slices = {"truth": truth, **volumes}
    for column, (name, volume) in enumerate(slices.items()):
        # The image is transposed, so that the long side of the foot lies along the picture.
        above, below = axes[:, column]
        above.imshow(volume[part].T, cmap="gray", vmin=0, vmax=most, origin="lower")
        above.set_title(name if volume is truth else f"{name}: {psnr(volume, truth):.1f} dB")
        error = (volume - truth)[part].T
        shown = below.imshow(error, cmap="RdBu_r", vmin=-most / 2, vmax=most / 2, origin="lower")
        below.set_title("" if volume is truth else "its error")
        for each in (above, below):
            each.set_axis_off()
    axes[1, 0].clear()  # the truth has no error
    axes[1, 0].set_axis_off()
    words = "one slice by the default\nmethod: 25 frames, each\nexposed while the gantry\nturns by 14.4°"
    axes[1, 0].text(0.5, 0.5, words, ha="center", va="center", transform=axes[1, 0].transAxes)
    bar = figure.colorbar(shown, ax=axes[1, 1:], label="1/mm", shrink=0.9)
    bar.ax.tick_params(labelsize=8)
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
