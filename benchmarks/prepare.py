"""Measures the PSNR that each effect of a real scan costs, and what its step of ``prepare`` regains.

    python benchmarks/prepare.py docs/results/prepare.jsonl --size 32

There is a line per effect, volume and method: ``clean``, ``clean_prepared`` (the step on a scan without the effect),
``spoilt`` and ``prepared``, in dB. Lines in the file are not made again. docs/results/prepare.md has the tables, and the
figure that --figure docs/images/prepare.png draws."""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scans import append, read_lines

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import compare, prepare, reconstruct, simulate
from phyradgs_cl.fields import Grid
from phyradgs_cl.prepare import water_polynomial
from phyradgs_cl.runtime import Runtime

PEAK = 3.0  # largest line integral, as in a head
METHODS: dict[str, dict[str, Any]] = {
    "fdk": {"motion": "per-row"},
    "fista-tv": {"motion": "per-row", "iterations": 30},
    "phyradgs": {"motion": "exact", "iterations": 800},
    "fista": {"motion": "per-row"},
}
USUAL = ["fdk", "fista-tv", "phyradgs"]
GAUSSIANS = 1000  # at least, in a box of any size


@dataclass(frozen=True)
class Effect:
    """What is planted, the steps that undo it, and their options. part: the reconstructed
    fraction of each side of the grid, about its middle. margin: the fraction added at each side, and discarded."""

    planted: dict[str, float]
    steps: str
    options: dict[str, Any] = field(default_factory=dict)
    part: float = 1.0
    margin: float = 0.0

    def grid(self, whole: Grid) -> Grid:
        shape = [max(1, round(self.part * n)) for n in whole.shape]
        return whole.part([(n - m) // 2 for n, m in zip(whole.shape, shape, strict=True)], shape)

    def undone(self, scan: Scan, rt: Runtime) -> Scan:
        return prepare(scan, self.steps, device=rt, **self.options) if self.steps else scan

    def beyond(self, method: str, grid: Grid) -> dict[str, Any]:
        """Returns options of a method that fills the margin of ``grid``, with Gaussians as dense as in the box alone."""
        if not self.margin:
            return {}
        gaussians = round(GAUSSIANS * (1 + 2 * self.margin) ** 3)
        own: dict[str, Any] = {"fdk": {"extrapolate": "reprojected"}, "phyradgs": {"gaussians": gaussians}}
        return {"margin_mm": [self.margin * side_mm for side_mm in grid.size_mm], **own.get(method, {})}


EFFECTS = {
    "sparks 0.01 %": Effect({"sparks": 1e-4}, "sparks"),
    "sparks 0.1 %": Effect({"sparks": 1e-3}, "sparks"),
    "rings 1 %": Effect({"rings": 0.01}, "rings"),
    "rings 5 %": Effect({"rings": 0.05}, "rings"),
    "drift 2 %": Effect({"drift": 0.02}, "air"),
    "scatter 0.3, fitted": Effect({"scatter": 0.3}, "scatter"),
    "scatter 0.3, stated": Effect({"scatter": 0.3}, "scatter", {"scatter": {"to_primary": 0.3}}),
    "120 kVp, water": Effect({"kvp": 120.0}, "hardening", {"hardening": {"polynomial": water_polynomial(120.0)}}),
    "120 kVp, bone": Effect({"kvp": 120.0}, "hardening", {"hardening": {"kvp": 120.0}}),
    "a third cut off": Effect({"truncation": 0.6}, "", part=0.375, margin=0.5),  # of the width
    "all": Effect(
        {"sparks": 1e-4, "rings": 0.01, "drift": 0.02, "scatter": 0.3, "kvp": 120.0},
        "sparks,scatter,air,hardening,rings",
        {"hardening": {"kvp": 120.0}},
    ),
}


def volume_of(rt: Runtime, scan: Scan, method: str, more: dict[str, Any] | None = None) -> np.ndarray:
    return reconstruct(scan, method, device=rt, report=False, **METHODS[method], **(more or {})).volume


def psnr_db(volume: np.ndarray, scan: Scan) -> float:
    return float(compare(volume, scan.reference)["psnr_db"])


def lines(rt: Runtime, phantom: str, usual: dict[str, Any], left: dict[str, list[str]]) -> Iterator[dict[str, Any]]:
    """Yields the lines of a phantom that are ``left``: an effect's methods."""
    if not left:
        return
    clean = simulate(phantom, **usual)
    clean_volume = cache(lambda method: volume_of(rt, clean, method))
    for name, methods in left.items():
        effect = EFFECTS[name]
        grid = effect.grid(clean.grid)
        part, spoilt = (scan.on_grid(grid) for scan in (clean, simulate(phantom, **usual, **effect.planted)))
        clean_prepared, prepared = (effect.undone(scan, rt) for scan in (part, spoilt))
        for method in methods:
            whole = replace(clean, reference=clean_volume(method))
            found = {"clean": psnr_db(whole.on_grid(grid).reference, part)}
            more = effect.beyond(method, grid)
            for stage, scan in (("clean_prepared", clean_prepared), ("spoilt", spoilt), ("prepared", prepared)):
                found[stage] = psnr_db(volume_of(rt, scan, method, None if stage == "spoilt" else more), scan)
            found["regained"] = (found["prepared"] - found["spoilt"]) / max(found["clean"] - found["spoilt"], 1e-2)
            rounded = {key: round(value, 3) for key, value in found.items()}
            yield {"effect": name, "phantom": Path(phantom).stem, "method": method, **rounded}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("results", type=Path, nargs="?", help="a file of one line of JSON per run")
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--dose", type=float, default=1e5)
    parser.add_argument("--phantoms", nargs="+", default=["jaw", "foot"], help="names, or files of volumes")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers of noise and effects")
    parser.add_argument("--methods", nargs="+", default=USUAL, choices=list(METHODS))
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), choices=list(EFFECTS))
    parser.add_argument("--figure", type=Path, help="draw slices of the jaw into this file, run nothing else")
    given = parser.parse_args()
    rt = Runtime()
    facts = {"size": given.size, "views": given.views, "dose": given.dose, "seed": given.seed, "device": rt.device.name}
    usual = {
        "size": given.size, "detector": 3 * given.size // 2, "views": given.views, "peak": PEAK, "noise": "beer",
        "dose": given.dose, "exposure_deg": 0.8 * 360 / given.views, "device": rt, "seed": given.seed,
    }  # fmt: skip
    if given.figure is not None:
        draw(given.figure, rt, usual)
        return
    there = read_lines(given.results) or [facts]
    if there[0] != facts:
        parser.error(f"{given.results}: found runs of {there[0]}; expected {facts}; name another file")
    if not given.results.exists():
        append(given.results, facts)
    done = {(line["effect"], line["phantom"], line["method"]) for line in there[1:]}
    for phantom in given.phantoms:
        name = Path(phantom).stem
        missing = {effect: [m for m in given.methods if (effect, name, m) not in done] for effect in given.effects}
        for line in lines(rt, phantom, usual, {effect: methods for effect, methods in missing.items() if methods}):
            append(given.results, line)


def draw(path: Path, rt: Runtime, usual: dict[str, Any]) -> None:
    """Draws the middle slice of the jaw by FDK: with each effect, and corrected."""
    from matplotlib.figure import Figure

    unseen = ("sparks 0.01 %", "rings 1 %", "drift 2 %", "120 kVp, water")
    shown = [name for name, effect in EFFECTS.items() if name not in unseen and effect.part == 1]
    figure = Figure(figsize=(2 * len(shown), 4.4), layout="constrained")
    axes = figure.subplots(2, len(shown))
    for name, (above, below) in zip(shown, axes.T, strict=True):
        effect = EFFECTS[name]
        scan = simulate("jaw", **usual, **effect.planted)
        for axis, shown_scan in ((above, scan), (below, effect.undone(scan, rt))):
            volume = volume_of(rt, shown_scan, "fdk")
            axis.imshow(volume[volume.shape[0] // 2, ::-1], cmap="gray", vmin=0, vmax=0.9 * scan.reference.max())
            axis.set_axis_off()
        above.set_title(name, fontsize=9)
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
