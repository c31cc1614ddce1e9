"""What each effect of a real scan costs, and what its step of ``prepare`` gives back: PSNR without it, with it, corrected.

    python benchmarks/prepare.py --size 48 --views 60 --output docs/results/prepare.jsonl

A line per effect, volume and method: ``clean``, ``clean_prepared`` (the step on a scan without the effect), ``spoilt`` and
``prepared``, dB. docs/prepare.md has the table, and the figure that --figure docs/images/prepare.png draws.
"""

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import compare, reconstruct, simulate
from phyradgs_cl.prepare import water_polynomial
from phyradgs_cl.runtime import Runtime

PEAK = 3.0  # of the line integrals: a head's
METHODS: dict[str, dict[str, Any]] = {"fdk": {"motion": "per-row"}, "fista-tv": {"motion": "per-row", "iterations": 30}}


@dataclass(frozen=True)
class Effect:
    """What is planted, the steps that undo it, and their options."""

    planted: dict[str, float]
    steps: str
    options: dict[str, Any] = field(default_factory=dict)


EFFECTS = {
    "sparks 0.01 %": Effect({"sparks": 1e-4}, "sparks"),
    "sparks 0.1 %": Effect({"sparks": 1e-3}, "sparks"),
    "rings 1 %": Effect({"rings": 0.01}, "rings"),
    "rings 5 %": Effect({"rings": 0.05}, "rings"),
    "rings 5 %, fitted": Effect({"rings": 0.05}, "rings", {"rings": {"method": "fitted"}}),
    "drift 2 %": Effect({"drift": 0.02}, "air"),
    "scatter 0.3, fitted": Effect({"scatter": 0.3}, "scatter"),
    "scatter 0.3, stated": Effect({"scatter": 0.3}, "scatter", {"scatter": {"to_primary": 0.3}}),
    "120 kVp, water": Effect({"kvp": 120.0}, "hardening", {"hardening": {"polynomial": water_polynomial(120.0)}}),
    "120 kVp, bone": Effect({"kvp": 120.0}, "hardening", {"hardening": {"kvp": 120.0}}),
    "all": Effect(
        {"sparks": 1e-4, "rings": 0.01, "drift": 0.02, "scatter": 0.3, "kvp": 120.0},
        "sparks,scatter,air,hardening,rings",
        {"hardening": {"kvp": 120.0}},
    ),
}


def scores(rt: Runtime, scan: Scan, method: str, effect: Effect | None = None) -> float:
    """PSNR, dB, of a method on a scan, after an effect's steps."""
    before = {} if effect is None else {"steps": effect.steps, **effect.options}
    result = reconstruct(scan, method, device=rt, **METHODS[method], **before)
    return float(compare(result.volume, scan.reference)["psnr_db"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--dose", type=float, default=1e5)
    parser.add_argument("--phantoms", nargs="+", default=["jaw", "foot"], help="names, or files of volumes")
    parser.add_argument("--seed", type=int, default=0, help="of noise and of what is planted")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), choices=list(EFFECTS))
    parser.add_argument("--output", type=Path)
    parser.add_argument("--figure", type=Path, help="draw slices of the jaw into this file, and no table")
    given = parser.parse_args()
    rt, lines = Runtime(), []
    usual = {
        "size": given.size, "detector": 3 * given.size // 2, "views": given.views, "peak": PEAK, "noise": "beer",
        "dose": given.dose, "exposure_deg": 0.8 * 360 / given.views, "device": rt,
        "seed": given.seed,
    }  # fmt: skip
    if given.figure is not None:
        draw(given.figure, rt, usual)
        return
    for phantom in given.phantoms:
        clean_scan = simulate(phantom, **usual)
        clean = {method: scores(rt, clean_scan, method) for method in given.methods}
        for name in given.effects:
            effect = EFFECTS[name]
            spoilt = simulate(phantom, **usual, **effect.planted)
            for method in given.methods:
                found = {
                    "clean_prepared": scores(rt, clean_scan, method, effect),
                    "spoilt": scores(rt, spoilt, method),
                    "prepared": scores(rt, spoilt, method, effect),
                }
                line = {"effect": name, "phantom": Path(phantom).stem, "method": method, "clean": clean[method], **found}
                line["regained"] = (line["prepared"] - line["spoilt"]) / max(line["clean"] - line["spoilt"], 1e-2)
                lines.append({key: round(v, 3) if isinstance(v, float) else v for key, v in line.items()})
                print(json.dumps(lines[-1]), flush=True)
    if given.output is not None:
        facts = {"size": given.size, "views": given.views, "dose": given.dose, "seed": given.seed, "device": rt.device.name}
        given.output.write_text("".join(json.dumps(line) + "\n" for line in [facts, *lines]), encoding="utf-8")


def draw(path: Path, rt: Runtime, usual: dict[str, Any]) -> None:
    """The middle slice of the jaw by FDK: with each effect, and corrected."""
    from matplotlib.figure import Figure

    shown = [name for name in EFFECTS if name not in ("sparks 0.01 %", "rings 1 %", "drift 2 %", "120 kVp, water")]
    figure = Figure(figsize=(2 * len(shown), 4.4), layout="constrained")
    axes = figure.subplots(2, len(shown))
    for name, (above, below) in zip(shown, axes.T, strict=True):
        effect = EFFECTS[name]
        scan = simulate("jaw", **usual, **effect.planted)
        for axis, before in ((above, {}), (below, {"steps": effect.steps, **effect.options})):
            volume = reconstruct(scan, "fdk", device=rt, **METHODS["fdk"], **before).volume
            axis.imshow(volume[volume.shape[0] // 2, ::-1], cmap="gray", vmin=0, vmax=0.9 * scan.reference.max())
            axis.set_axis_off()
        above.set_title(name, fontsize=9)
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
