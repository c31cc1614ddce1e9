"""Fills the tables of docs/results/*.md and docs/scanner.md from recorded runs: python docs/make_results.py [--check]

A table is between ``<!-- table: NAME -->`` and ``<!-- end of table -->``; NAME is a key of ``TABLES``. With ``--check``
nothing is written, and the exit status is 1 where a page differs from its data."""

import csv
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from operator import itemgetter
from pathlib import Path
from statistics import mean, stdev
from typing import Any

BOX_MM = 2.0  # of the volumes that breathe
RESULTS = Path(__file__).resolve().parent / "results"
BLOCK = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end of table -->)", re.S)
CENTRES = "PhyRadGS centres only (as GS-on-the-Move)"
DEFAULT = "**`fista`, the default**"
METHODS = (
    # Label of the page; rows with the motion ignored, with the motion known, and of the still scan.
    ("FDK", "FDK", "FDK per-row", "FDK"),
    ("SART", "SART", "SART per-row", "SART"),
    ("OS-SART", "OS-SART", "OS-SART per-row", "OS-SART"),
    ("SIRT", "SIRT", "SIRT per-row", "SIRT"),
    ("CGLS", "CGLS", "CGLS per-row", "CGLS"),
    ("ASD-POCS", "ASD-POCS", "ASD-POCS per-row", "ASD-POCS"),
    ("FISTA-TV", "FISTA-TV", "FISTA-TV per-row", "FISTA-TV"),
    ("`fista --prior dct`, on one grid", "", "FISTA with DCT on one grid per-row", "FISTA with DCT on one grid"),
    ("`fista --prior dct`", "", "FISTA with DCT per-row", "FISTA with DCT"),
    (DEFAULT, "", "FISTA with ridge per-row", "FISTA with ridge"),
    ("`fused` (until 0.2), its voxels with `dct`", "", "Fused exact in time", "Fused"),
    ("R2-Gaussian", "R2-Gaussian", "R2-Gaussian w/ ST", "R2-Gaussian"),
    ("PhyRadGS, 8 × 5 (the paper's)", "PhyRadGS w/o ST", "PhyRadGS", "PhyRadGS w/o ST"),
    ("PhyRadGS, exact in time", "PhyRadGS w/o ST", "PhyRadGS exact in time", "PhyRadGS w/o ST"),
    (CENTRES, "PhyRadGS w/o ST", CENTRES, "PhyRadGS w/o ST"),
)
Row = dict[str, str]
Scores = dict[str, Any]


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def lines_of(name: str) -> list[dict[str, Any]]:
    """Returns the lines of a JSONL file in docs/results."""
    return [json.loads(line) for line in (RESULTS / name).read_text(encoding="utf-8").splitlines()]


def rows_of(name: str) -> dict[tuple[str, str, str], Row]:
    """Returns the rows of a benchmark's CSV by protocol, row and acquisition."""
    with open(RESULTS / name, encoding="utf-8") as file:
        return {(row["protocol"], row["row"], row["acquisition"]): row for row in csv.DictReader(file)}


def quality(name: str, protocol: str, with_seconds: bool = False) -> str:
    """Returns PSNR and SSIM of every method: motion ignored, motion known, and for a scan that stops at each projection."""
    rows = rows_of(name)
    text = []
    for label, ignored, known, still in METHODS:
        if label == DEFAULT:
            fly, at_rest = with_prior("ridge", rows[protocol, "FISTA with DCT per-row", "fly-scan"])
            static = rows.get((protocol, still, "fly-scan"))
            gain = f"{float(fly.split()[0]) - number(static):+.2f}" if static else "–"
            text.append([label, both(static), fly, gain, at_rest, *(["–"] if with_seconds else [])])
            continue
        cells = [rows.get((protocol, ignored, "fly-scan")), rows.get((protocol, known, "fly-scan"))]
        if cells[1] is None:
            continue
        comparable = cells[0] is not None and cells[0]["volumes"] == cells[1]["volumes"]
        gain = f"{number(cells[1]) - number(cells[0]):+.2f}" if comparable else "–"
        bound = rows.get((protocol, still, "stop-and-shoot"))
        seconds = " / ".join(seconds_of(cell) for cell in cells)
        text.append([label, *(both(cell) for cell in cells), gain, both(bound), *([seconds] if with_seconds else [])])
    heads = ["method", "motion ignored", "motion known", "gain", "stop-and-shoot"]
    table = markdown([*heads, "processor s ignored / known"] if with_seconds else heads, text)
    spreads_db = [float(row["psnr_db_spread"]) for key, row in rows.items() if key[0] == protocol and row["psnr_db_spread"]]
    return table + (f"\nStandard deviation over seeds: at most {max(spreads_db):.2f} dB.\n" if spreads_db else "")


def with_prior(prior: str, like: Row) -> list[str]:
    """Returns PSNR and SSIM of ``fista`` with another prior, on a fly-scan and on one that stops."""
    views, cells = {"rapid": 25, "standard": 50}[like["protocol"]], []
    for kind in ("fly", "still"):
        by_volume: dict[str, list[Scores]] = {}
        for (volume, _), by_prior in prior_runs()[kind, "volumes", views, 10000, int(like["voxels"])].items():
            by_volume.setdefault(volume, []).append(by_prior[prior])
        if len(by_volume) != int(like["volumes"]):
            raise SystemExit(f"priors.jsonl: {kind}, {views} views: {len(by_volume)} volumes; expected {like['volumes']}")
        psnr, ssim = (mean(mean(x[name] for x in of) for of in by_volume.values()) for name in ("psnr_db", "ssim"))
        cells.append(f"{psnr:.2f} / {ssim:.3f}")
    return cells


def number(row: Row, name: str = "psnr_db") -> float:
    """Returns a number of a CSV's row."""
    return float(row[name])


def both(row: Row | None) -> str:
    """Returns PSNR and SSIM as the pages print them."""
    if row is None:
        return "–"
    few = "†" if row["volumes"] == "2" and row["size"] == "M" else ""
    return f"{number(row):.2f} / {number(row, 'ssim'):.3f}{few}"


def seconds_of(row: Row | None) -> str:
    """Returns processor seconds of a row."""
    return f"{float(row['processor_s']):.0f}" if row is not None and row["processor_s"] else "–"


def strips() -> str:
    """Returns Table 2 of the paper: PhyRadGS over strips and sub-intervals."""
    rows = [row for key, row in rows_of("table2_S.csv").items() if key[0] == "rapid" and key[2] == "fly-scan"]
    names = {"PhyRadGS w/o ST": "static"}
    cells = [
        [names.get(row["row"], row["row"]), f"{number(row):.2f}", f"{number(row, 'ssim'):.3f}", row["paper_psnr_db"] or "–"]
        for row in rows
    ]
    return markdown(["strips M, sub-intervals N", "PSNR (dB)", "SSIM", "the paper's PSNR"], cells)


def phantom() -> str:
    """Returns the paper's sphere phantom: PSNR, shape and density of its beads."""
    rows = rows_of("phantom_M.csv")
    text = []
    for label, ignored, known, _ in METHODS:
        if label in ("SART", "OS-SART", "SIRT", "CGLS"):  # these are in the CSV file
            continue
        for kind, name in (("ignored", ignored), ("known", known)):
            row = rows.get(("rapid", name, "fly-scan"))
            if row is None or (label.startswith(("PhyRadGS, exact", CENTRES)) and kind == "ignored"):
                continue
            shape = [f"{100 * number(row, 'roundness'):.1f}", f"{number(row, 'centre_shift_mm'):.2f}"]
            shape += [f"{number(row, 'edge_rise_mm'):.2f}", f"{100 * number(row, 'bias_balls'):.1f}"]
            pseudo = f"{number(row, 'psnr_db_pseudo'):.2f}"
            text.append([label, kind, pseudo, row["paper_psnr_db"] or "–", f"{number(row):.2f}", *shape])
    heads = ["method", "motion", "PSNR to pseudo-truth", "the paper's", "PSNR to truth", "out of round, %", "shift, mm"]
    return markdown([*heads, "rise, mm", "bias, %"], text)


def motion_models() -> str:
    """Returns whole reconstructions by the motion models of the splats, as means over the volumes."""
    lines = [line for line in lines_of("motion_models_pruned.jsonl") if line["size"] == 64 and line["iterations"] == 3000]
    found: dict[str, dict[str, Any]] = {}
    for line in lines:
        found.setdefault(line["volume"], {})[line["motion"]] = line
    models = {"static": "static", "8x5": "8 × 5", "exact 0.005": "exact, bound 0.005"}
    whole = [by for by in found.values() if all(model in by for model in models)]
    text = []
    for model, name in models.items():
        psnr, ssim = (mean(by[model][key] for by in whole) for key in ("psnr_db", "ssim"))
        gains = [by[model]["psnr_db"] - by["8x5"]["psnr_db"] for by in whole]
        least_most = "" if model == "8x5" else f"{min(gains):+.2f} to {max(gains):+.2f}"
        text.append([name, f"{psnr:.2f}", f"{ssim:.3f}", least_most])
    return markdown(["model", "PSNR, dB", "SSIM", f"gain over 8 × 5, {len(whole)} volumes"], text)


ONE_FRAME = {"static": "static", "centres": "centres", "8x5": "8 × 5", "exact": "exact"}


def centres_distance() -> str:
    """Returns errors of a frame of single Gaussians, by motion model and distance from the axis."""
    lines = [line for line in lines_of("centres_only.jsonl") if "gaussians" in line]
    text = [
        [line["gaussians"], str(line["distance"]), *(f"{100 * line[name]:.2g} %" for name in ONE_FRAME)] for line in lines
    ]
    return markdown(["Gaussians", "distance", *ONE_FRAME.values()], text)


def centres_object() -> str:
    """Returns errors of a frame of whole objects, by motion model, from the least to the largest."""
    lines = [line for line in lines_of("centres_only.jsonl") if "volume" in line]
    text = []
    for protocol in ("rapid", "standard"):
        errors = {name: [100 * line[name] for line in lines if line["protocol"] == protocol] for name in ONE_FRAME}
        text.append([protocol, *(f"{min(of):.2g}–{max(of):.2g} %" for of in errors.values())])
    return markdown(["protocol", *ONE_FRAME.values()], text)


def detector_models() -> str:
    """Returns the gain of each method from modelling a detector's effect: modelled PSNR, and its excess over ignoring it."""
    lines = lines_of("detector_models.jsonl")
    methods = list(dict.fromkeys(line["method"] for line in lines))
    effects = list(dict.fromkeys(line["effect"] for line in lines))
    cell = {(line["effect"], line["method"]): line for line in lines}
    text = []
    for effect in effects:
        of_effect = [cell.get((effect, method)) for method in methods]
        shown = [f"{x['modelled_db']:.1f} ({x['modelled_db'] - x['ignored_db']:+.2f})" if x else "" for x in of_effect]
        text.append([effect, *shown])
    return markdown(["effect", *methods], text)


def sweep(name: str, held_out: bool) -> str:
    """Returns PSNR with the default of an option, and with the best one factor for all volumes, as means over volumes."""
    scans: dict[tuple[Any, ...], dict[str, dict[float, dict[str, Any]]]] = {}
    for line in lines_of(name):
        key = (line["kind"], line["views"], int(line["dose"]), line["size"], line["pixels"])
        scans.setdefault(key, {}).setdefault(line["volume"], {})[line["factor"]] = line
    text = []
    for (kind, views, dose, size, pixels), volumes in sorted(scans.items()):
        factors = sorted(set.union(*(set(by) for by in volumes.values())))
        volumes = {name: by for name, by in volumes.items() if len(by) == len(factors)}  # a sweep may be unfinished
        of_factor = {factor: mean(by[factor]["psnr_db"] for by in volumes.values()) for factor in factors}
        best = max(of_factor, key=of_factor.__getitem__)
        cells = [kind, str(views), str(dose), f"{size}³, {pixels}²", f"{of_factor[1.0]:.2f}"]
        cells.append(f"{of_factor[best]:.2f} (×{best:g})")
        if best == 1.0 and not held_out:
            continue
        if held_out:
            least = [min(by.values(), key=lambda line: line["holdout_rms"])["psnr_db"] for by in volumes.values()]
            cells.append(f"{mean(least):.2f}")
        text.append(cells)
    heads = ["scan", "views", "photons", "voxels, pixels", "default", "best factor for all"]
    if held_out:
        return markdown([*heads, "least held-out error"], text)
    others = len(scans) - len(text)
    return markdown(heads, text) + f"\nOf the other {others} kinds of scans the default is the best factor.\n"


@cache
def prior_runs() -> dict[tuple[Any, ...], dict[tuple[str, int], dict[str, Scores]]]:
    """Returns the runs of ``priors.jsonl`` by scan (kind, object, views, photons, voxels), volume and seed, and prior."""
    scans: dict[tuple[Any, ...], dict[tuple[str, int], dict[str, Scores]]] = {}
    for line in lines_of("priors.jsonl"):
        of = line["volume"] if line["volume"] == "spheres" else "volumes"
        key = line["kind"], of, line["views"], int(line["dose"]), line["size"]
        scans.setdefault(key, {}).setdefault((line["volume"], line["seed"]), {})[line["prior"]] = line
    return scans


def ridge() -> str:
    """Returns PSNR and SSIM with the priors dct and ridge. ±: standard deviation over seeds of the mean gain."""
    text = []
    for (kind, of, views, dose, size), runs in sorted(prior_runs().items(), reverse=True):
        pairs = {key: by for key, by in runs.items() if {"dct", "ridge"} <= set(by)}
        if not pairs:
            continue
        names = sorted({name.partition("_")[0] for name, _ in pairs})
        objects = of if of == "spheres" else f"{len(names)} volumes" if len(names) > 3 else ", ".join(names)
        cells = [f"{kind}, {objects}", str(views), str(dose), f"{size}³"]
        for prior in ("dct", "ridge"):
            psnr, ssim = (mean(by[prior][metric] for by in pairs.values()) for metric in ("psnr_db", "ssim"))
            cells.append(f"{psnr:.2f} / {ssim:.4f}")
        gains = {key: by["ridge"]["psnr_db"] - by["dct"]["psnr_db"] for key, by in pairs.items()}
        by_seed = [mean(gain for (_, of), gain in gains.items() if of == seed) for seed in {seed for _, seed in gains}]
        spread = f" ± {stdev(by_seed):.2f}, {len(by_seed)} seeds" if len(by_seed) > 1 else ""
        text.append([*cells, f"{mean(gains.values()):+.2f}{spread}", f"{min(gains.values()):+.2f}"])
    return markdown(["scan", "views", "photons", "voxels", "`dct`", "`ridge`", "mean gain", "least"], text)


def beside_rtk() -> str:
    """Returns FDK, projector and adjoint compared with RTK's, on two processors."""
    text = []
    for processor, suffix in (("AMD EPYC", ""), ("Intel Xeon", "_intel")):
        fdk = json.loads((RESULTS / f"rtk_fdk{suffix}.json").read_text())["speed"]
        rays = json.loads((RESULTS / f"ray_speed{suffix}.json").read_text())["beside_rtk"]
        cells = [f"{fdk[key]:.3f}" for key in ("seconds", "rtk_seconds")]
        cells += [f"{fdk[key]:.1f}" for key in ("ratio", "processor_ratio")]
        text.append([processor, "FDK", *cells])
        for step, name in (("forward", "forward projection (Joseph)"), ("adjoint", "matched backprojection (Joseph)")):
            x = rays[step]
            cells = [f"{x[who]['wall_s']:.3f}" for who in ("ours", "rtk")]
            cells += [f"{x[f'times_as_fast_{clock}']:.1f}" for clock in ("wall", "processor")]
            text.append([processor, name, *cells])
    return markdown(["processor", "operator", "ours, s", "RTK, s", "times as fast", "by processor time"], text)


def ray_motions() -> str:
    """Returns the cost of every motion model in passes of a scanner at rest, on two processors."""
    files = ("ray_speed.json", "ray_speed_intel.json")
    by_file = {name: json.loads((RESULTS / name).read_text())["by_motion"] for name in files}
    text = []
    for motion in by_file[files[1]]:
        cells = [motion]
        for times in by_file.values():
            for step in ("forward", "adjoint"):
                passes = times[motion][step]["processor_s"] / times["static"][step]["processor_s"]
                cells.append(f"{passes:.1f}")
        text.append(cells)
    return markdown(["motion", "EPYC: forward", "adjoint", "Xeon: forward", "adjoint"], text)


def estimates() -> str:
    """Returns time and memory by ``estimate`` over those of the run."""
    text = []
    for run in json.loads((RESULTS / "estimates.json").read_text())["runs"]:
        ratio = run["ratio"]
        shares = [f"{ratio[key]:.2f}" for key in ("seconds", "host_bytes", "device_bytes")]
        text.append([run["method"], f"{run['happened']['seconds']:.1f}", *shares])
    return markdown(["method", "taken, s", "time", "host memory", "device buffers"], text)


def prepared() -> str:
    """Returns the decibels that an effect costs, and the percentage that ``prepare`` regains, by effect and size.

    Both are ranges from the least to the largest of all volumes."""
    cells: dict[tuple[str, int], dict[str, list[dict[str, Any]]]] = {}
    for line in _prepared_lines():
        by_method = cells.setdefault((line["effect"], line["size"]), {})
        by_method.setdefault(line["method"], []).append(line)
    text = []
    for (effect, size), by_method in sorted(cells.items()):
        volumes = len({line["phantom"] for lines in by_method.values() for line in lines})
        shown = [_losses(by_method.get(method, [])) for method in PREPARED_METHODS]
        text.append([effect, f"{size}³", str(volumes), *shown])
    return markdown(["effect", "voxels", "volumes", *PREPARED_METHODS], text)


PREPARED_METHODS = ("fdk", "fista-tv", "phyradgs")


def _prepared_lines() -> list[dict[str, Any]]:
    """Returns the lines of all runs of ``prepare``, each with the size of its volume."""
    found = []
    for name in ("prepare", "prepare_volumes", "prepare_fresh", "prepare_64"):
        head, *lines = lines_of(f"{name}.jsonl")
        found += [line | {"size": head["size"]} for line in lines if "regained" in line]
    return [line for line in found if not line["effect"].startswith("a third")]


def _losses(lines: Sequence[dict[str, Any]]) -> str:
    """Returns the loss in dB and the part of it that returns. The part of a loss below 0.1 dB means nothing."""
    if not lines:
        return ""
    losses_db = [line["clean"] - line["spoilt"] for line in lines]
    parts = [100 * line["regained"] for line, lost_db in zip(lines, losses_db, strict=True) if lost_db > 0.1]
    return _range(losses_db, ".2f") + (f"; {_range(parts, '.0f')} %" if parts else "")


def _range(values: Sequence[float], form: str) -> str:
    least, most = (f"{value:{form}}" for value in (min(values), max(values)))
    return least if least == most else f"{least} to {most}" if min(values) < 0 else f"{least}–{most}"


def clean_scans() -> str:
    """Returns what the usual steps change in clean scans, and the part of rings that returns."""
    text = []
    lines = lines_of("prepare_clean.jsonl")
    for method, views in sorted({(line["method"], line["views"]) for line in lines}):
        cell = [line for line in lines if (line["method"], line["views"]) == (method, views)]
        clean = [line for line in cell if "lost_db" in line]
        changed = sum(not line["unchanged"] for line in clean)
        rings = [[line["regained"] for line in cell if line["steps"] == f"rings {spread}"] for spread in (0.01, 0.02, 0.05)]
        ranges = [f"{100 * min(parts):.0f}–{100 * max(parts):.0f} %" if parts else "" for parts in rings]
        lost = f"{changed} of {len(clean)}, {max((line['lost_db'] for line in clean), default=0):.3f} dB"
        text.append([method, str(views), str(len({line["phantom"] for line in cell})), lost, *ranges])
    heads = ["method", "views", "volumes", "clean: changed, most lost", "rings of 1 %", "2 %", "5 %"]
    return markdown(heads, text)


def stripes() -> str:
    """Returns PSNR with stripes, and after steps of ``prepare``, at the most views. Rows "none" are the clean scan."""
    cells: dict[tuple[str, str], dict[str, float]] = {}
    lines = lines_of("stripes.jsonl")
    views = max(line["views"] for line in lines)
    for line in lines:
        if line["views"] == views:
            cells.setdefault((line["stripes"], line["object"]), {})[line["steps"]] = line["psnr_db"]
    steps = ["", "dead,rings", "stripes", "dead,rings,stripes", "every column", "algotom", "algotom, narrow"]
    text = [[*key, *(f"{by_steps[name]:.2f}" for name in steps)] for key, by_steps in cells.items()]
    titles = ["no step", *(f"`{name}`" for name in steps[1:4]), "`stripes`, `ratio=0`", *steps[5:]]
    return markdown(["stripes", "object", *titles], text)


def calibrate_lines() -> list[dict[str, Any]]:
    """Returns the recorded calibrations of every case on its finest grid."""
    lines = lines_of("calibrate.jsonl")
    finest = {line["case"]: max(other["size"] for other in lines if other["case"] == line["case"]) for line in lines}
    return [line for line in lines if line["size"] == finest[line["case"]]]


def calibrated_parameters() -> str:
    """Returns the worst error of every parameter with two runs or more, the stated σ, and how often 2 σ held the truth."""
    cells: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for line in calibrate_lines():
        for one in line["parameters"]:
            if one.get("error") is not None:
                key = (line["case"], line["size"], one["name"], one["unit"])
                cells.setdefault(key, []).append(one)
    text = []
    for (case, size, name, unit), found in cells.items():
        if len(found) < 2:
            continue
        worst = max(abs(one["error"]) for one in found)
        inside = sum(abs(one["z"]) <= 2 for one in found)
        sigma = mean(one["deviation"] for one in found)
        text.append([case, f"{size}³", name, f"{worst:.2g} {unit}", f"{sigma:.2g}", f"{inside}/{len(found)}"])
    return markdown(["case", "voxels", "parameter", "worst error", "σ stated", "within 2 σ"], text)


def calibrated_psnr() -> str:
    """Returns PSNR with the stated, the calibrated and the right geometry."""
    cells: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for line in calibrate_lines():
        if "stated" in line.get("psnr_db", {}) and not line["case"].startswith("draw"):
            cells.setdefault((line["case"], f"{line['size']}, {line['views']}"), []).append(line["psnr_db"])
    text = []
    for (case, size), found in cells.items():
        means = [f"{mean(one[key] for one in found):.2f}" for key in ("stated", "calibrated", "right")]
        worst = min(one["calibrated"] - one["right"] for one in found)
        text.append([case, size, *means, f"{worst:+.3f}", str(len(found))])
    return markdown(["case", "voxels, views", "stated", "calibrated", "right", "worst difference", "runs"], text)


def fbp_peers() -> str:
    """Returns filtered backprojection compared with its peers: differences, PSNR, seconds."""
    found = json.loads((RESULTS / "fbp_peers.json").read_text(encoding="utf-8"))
    rows = []
    for name in ("ours", "skimage", "astra", "silx"):
        one, times = found["differences"][name], found["times"][name]
        off = f"{100 * one['relative_rms']:.2g} %" if "relative_rms" in one else ""
        label = {"ours": "**`fbp`**", "skimage": "scikit-image", "astra": "ASTRA", "silx": "silx"}[name]
        rows.append([label, off, f"{one['psnr_db']:.2f}", f"{times['wall_s']:.1f}", f"{times['processor_s']:.1f}"])
    table = markdown(["", "difference", "PSNR, dB", "wall, s", "processor, s"], rows)
    wall, processor = (found["fastest_over_ours"][key] for key in ("wall_s", "processor_s"))
    size = f"{found['columns']} columns, {found['views']} views, {found['rows']} rows"
    faster = f"{wall:.1f} times as fast as the fastest (processor {processor:.1f})"
    return f"{table}\n{size}: {faster}; {found['device'].removeprefix('pthread-')}.\n"


def parallel_fly() -> str:
    """Returns PSNR and modulation at rim and centre of parallel fly-scans: a row per scan, a column per method."""
    cells: dict[tuple[Any, ...], dict[tuple[str, str], str]] = {}
    for one in lines_of("parallel_fly.jsonl"):
        scan = cells.setdefault((one["views"], one["blur_px"], one["dose"]), {})
        scan[one["method"], one["motion"]] = f"{one['psnr_db']:.1f}, {one['rim']:.2f}, {one['centre']:.2f}"
    columns = [("fbp", "ignored"), ("fbp", "deblurred"), ("fbp", "deblurred ten times")]
    columns += [("fista", "ignored"), ("fista", "known")]
    text = [
        [str(views), f"{blur:g}", f"{dose:g}", *(by.get(column, "–") for column in columns)]
        for (views, blur, dose), by in sorted(cells.items())
        if (views < 1800 or dose > 1e4) and (views == 180 or blur > 1)
    ]
    labels = {"deblurred": "`deblur=0.03`", "deblurred ten times": "`deblur=0.003`"}
    heads = (f"`{method}`, {labels.get(motion, motion)}" for method, motion in columns)
    return markdown(["views", "blur", "photons", *heads], text)


def fan_fly() -> str:
    """Returns NMSE of a fan beam's fly-scan."""
    rows = [
        [f"{one['side']}²", f"`{one['method']}`", one["model"]]
        + [f"{one['nmse']:.4f}", f"{one['best']:.4f} ({one['best_at']})"]
        for one in lines_of("fan_fly.jsonl")
    ]
    return markdown(["voxels", "method", "motion", "NMSE", "smallest (pass)"], rows)


def moving_rtk() -> str:
    """Returns RTK's own test of motion-compensated FDK, from its files."""
    rows = [
        [one["program"], f"{one['mean_error']:.4f}", f"{one['psnr_db']:.2f}", f"{one['near_psnr_db']:.2f}"]
        for one in lines_of("moving.jsonl") if one["case"] == "own test"
    ]
    (same,) = (one for one in lines_of("moving.jsonl") if one["case"] == "same field")
    table = markdown(["", "mean error", "PSNR, dB", "PSNR within 20 mm, dB"], rows)
    ours_s, rtk_s = same["seconds"], same["rtk_seconds"]
    faster = f"{rtk_s / ours_s:.1f} times as fast ({ours_s:.2f} s, RTK {rtk_s:.2f} s)"
    off = f"at most {same['largest_difference']:.1e} of the peak apart"
    return f"{table}\nOn the same field: {off}; {faster} of processor time.\n"


def parallel_memory() -> str:
    """Returns the memory of parallel scans within a limit."""
    rows = [
        [f"`{one['method']}`", f"{one['columns']} × {one['rows']} × {one['views']}", one["limit"]]
        + [f"{one[key] / 2**30:.2f} GiB" for key in ("buffer_bytes", "host_bytes")] + [str(one["processor_s"])]
        for one in lines_of("parallel_memory.jsonl")
    ]
    return markdown(["method", "columns × rows × views", "limit", "buffers", "resident", "processor, s"], rows)


def times_per_exposure() -> str:
    """Returns PSNR and time of ``per-row`` by the times in an exposure, as means over the volumes with the same numbers."""
    by_volume: dict[tuple[Any, ...], dict[int, dict[str, Any]]] = {}
    for one in lines_of("times_per_exposure.jsonl"):
        key = one["size"], one["views"], one["moved_voxels"], one["method"], one["volume"]
        by_volume.setdefault(key, {})[one["times"]] = one
    scans: dict[tuple[Any, ...], list[dict[int, dict[str, Any]]]] = {}
    for (*scan, volume), runs in by_volume.items():
        scans.setdefault((*scan, volume == "spheres", tuple(sorted(runs))), []).append(runs)
    counts, rows = (1, 2, 3, 5, 6, 9, 17), []
    for (size, views, moved, method, _, made), of in sorted(scans.items()):
        cells = {n: f"{mean(runs[n]['psnr_db'] for runs in of):.2f}" for n in made}
        for n in made:
            seconds = [runs[n]["processor_s"] for runs in of if runs[n]["processor_s"]]
            cells[n] += f" ({mean(seconds):.0f} s)" if len(seconds) == len(of) else ""
        names = ", ".join(sorted(next(iter(runs.values()))["volume"].partition("_")[0] for runs in of))
        rows.append([f"{size}³, {views}", f"{moved:.1f}", names, f"`{method}`", *(cells.get(n, "") for n in counts)])
    return markdown(["voxels, views", "rim moves", "volumes", "method", *(f"N = {n}" for n in counts)], rows)


def moving_known() -> str:
    """Returns breathing volumes of 64³ by ``fista``, at rest and with the known field."""
    by_scan: dict[tuple[int, str], dict[str, dict[str, Any]]] = {}
    for one in lines_of("moving.jsonl"):
        if one["case"] in ("rest", "known"):
            by_scan.setdefault((one["views"], one["volume"]), {})[one["case"]] = one
    rows: list[list[str]] = []
    losses_db: dict[int, list[float]] = {}
    for (views, volume), of in sorted(by_scan.items()):
        if "known" not in of:
            continue
        scores = [f"{of[case]['psnr_db']:.2f}/{of[case]['ssim']:.3f}" for case in ("rest", "known")]
        loss_db = of["rest"]["psnr_db"] - of["known"]["psnr_db"]
        losses_db.setdefault(views, []).append(loss_db)
        times = of["known"]["seconds"] / of["rest"]["seconds"]
        rows.append([volume, str(views), *scores, f"{loss_db:.2f}", f"{times:.1f}"])
    heads = ["volume", "views", "at rest", "known field", "loss, dB", "time, times at rest"]
    means = ", ".join(f"{mean(of_views):.2f} dB from {views} views" for views, of_views in losses_db.items())
    return markdown(heads, rows) + f"\nThe mean loss is {means}.\n"


def moving_unknown(motion: str, size: int) -> str:
    """Returns moving volumes of size³ voxels as if they rested, and with the field of ``moving``, and the mean gain."""
    rows: list[list[str]] = []
    gains_db: dict[int, list[float]] = {}
    periods_s = []
    found = (one for one in lines_of("moving.jsonl") if one["case"] == "unknown" and one["size"] == size)
    for one in sorted((one for one in found if one.get("motion", "breathing") == motion), key=itemgetter("views", "volume")):
        gain_db = one["mean_psnr_db"] - one["static_mean_psnr_db"]
        gains_db.setdefault(one["views"], []).append(gain_db)
        periods_s.append(one["period_s"])
        scores = [f"{one[case + 'mean_psnr_db']:.2f}/{one[case + 'mean_ssim']:.3f}" for case in ("static_", "")]
        voxels = [one[key] * size / BOX_MM for key in ("mean_motion_error_mm", "p95_motion_error_mm")]
        row = [one["volume"], str(one["views"]), *scores, f"{gain_db:+.2f}", f"{voxels[0]:.2f} ({voxels[1]:.2f})"]
        rows.append([*row, f"{one['seconds']:.0f}", f"{one['seconds'] / one['static_seconds']:.1f}"])
    heads = ["volume", "views", "as if at rest", "`moving`", "gain, dB", "field wrong by, voxels", "`moving`, s"]
    means = ", ".join(f"{mean(of):.2f} dB (least {min(of):.2f}) from {views} views" for views, of in gains_db.items())
    periods = f"{min(periods_s):.2f} to {max(periods_s):.2f} s" if all(periods_s) else "none"
    return markdown([*heads, "times at rest"], rows) + f"\nThe mean gain is {means}. Periods found: {periods}.\n"


def moving_insert() -> str:
    """Returns the centre of a ball in a breathing body: with the true field, the motion ignored, and a field found."""
    rows = []
    for one in lines_of("moving.jsonl"):
        if one["case"] == "insert":
            pairs = [
                [f"{one[key]:.4f}", f"{10 * one[key] / one['moved_mm']:.2f}"] if key in one else ["–", "–"]
                for key in ("off_mm", "states_off_mm")
            ]
            rows.append([one["motion"], *pairs[0], *pairs[1]])
    heads = ["field", "reference off by, mm", "of 10 mm", "states off by, mm", "of 10 mm"]
    return markdown(heads, rows)


def moving_mace4d() -> str:
    """Returns the rack and pinion of mbirtorch's demonstration, by its MACE4D and by ``moving``."""
    rows = [
        [one["program"], f"{one['mean_psnr_db']:.2f}", f"{one['least_psnr_db']:.2f}", f"{one['mean_ssim']:.3f}"]
        + [f"{one['seconds']:.1f}"]
        for one in lines_of("moving.jsonl") if one["case"] == "rack and pinion"
    ]
    return markdown(["", "mean PSNR, dB", "least PSNR, dB", "mean SSIM", "processor, s"], rows)


def doubt() -> str:
    """Returns the coverage of error bars by kind of scan and method: means over volumes, with the least and the largest."""
    scans: dict[tuple[Any, ...], list[Scores]] = {}
    for one in lines_of("doubt.jsonl"):
        kind = "fly" if one["kind"] == "fly" else "at rest"
        scans.setdefault((one["size"], one["method"], kind, one["views"], one["dose"]), []).append(one)

    def span(of: list[Scores], name: str) -> str:
        values = [one[name] for one in of if name in one]
        if len(values) < 2:
            return f"{values[0]:.2f}" if values else "–"
        return f"{mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"

    places = ("air", "soft", "bone", "edges")
    rows = [
        [f"{size}³", f"`{method}`", f"{kind}, {views}, {dose:g}", str(len(of)), span(of, "object_68"), span(of, "object_95")]
        + [", ".join(f"{mean(x):.2f}" if (x := [one[f"{p}_68"] for one in of if f"{p}_68" in one]) else "–" for p in places)]
        + [span(of, "rank"), f"{mean(one['bar_over_constant'] for one in of):.2f}"]
        for (size, method, kind, views, dose), of in scans.items()
    ]
    heads = ["voxels", "method", "scan, views, photons", "volumes", "within σ", "within the 95 % bar"]
    heads += ["air, soft, bone, edges within σ", "rank correlation", "mean 95 % bar over a constant one"]
    return markdown(heads, rows)


def turning() -> str:
    """Returns PSNR by frames, arc of an exposure and readout: means over volumes and seeds, motion known and ignored."""
    cells: dict[tuple[int, float], dict[tuple[float, str], list[float]]] = {}
    for one in lines_of("turning.jsonl"):
        scan = cells.setdefault((one["frames"], one["arc_deg"]), {})
        scan.setdefault((one["readout_ratio"], one["motion"]), []).append(one["psnr_db"])
    whole = max(len(values) for by in cells.values() for values in by.values())
    cells = {key: kept for key, by in cells.items() if (kept := {k: v for k, v in by.items() if len(v) == whole})}
    columns = [(ratio, motion) for ratio in (0, 0.86, 4) for motion in ("per-row", "static")]
    rows = [
        [str(frames), f"{arc:g}°", *(f"{mean(by[column]):.2f}" if column in by else "" for column in columns)]
        for (frames, arc), by in sorted(cells.items())
    ]
    gains = [
        stdev(known - ignored for known, ignored in zip(by[ratio, "per-row"], by[ratio, "static"], strict=True))
        for by in cells.values() for ratio in (0, 0.86, 4) if (ratio, "static") in by and (ratio, "per-row") in by
    ]  # fmt: skip
    heads = [f"readout {ratio:g}, {motion}" for ratio in (0, 0.86, 4) for motion in ("known", "ignored")]
    spread_db = f"The gain of knowing the motion deviates by at most {max(gains):.2f} dB between volumes."
    return markdown(["frames", "exposure", *heads], rows) + f"\n{spread_db}\n"


TABLES: dict[str, Callable[[], str]] = {
    "table1_S_rapid": lambda: quality("table1_S.csv", "rapid", with_seconds=True),
    "table1_S_standard": lambda: quality("table1_S.csv", "standard"),
    "table1_M_rapid": lambda: quality("table1_M.csv", "rapid"),
    "table2_S": strips,
    "phantom_M": phantom,
    "motion_models": motion_models,
    "centres_distance": centres_distance,
    "centres_object": centres_object,
    "detector_models": detector_models,
    "prior_weight": lambda: sweep("prior_weight.jsonl", held_out=False),
    "passes": lambda: sweep("passes.jsonl", held_out=True),
    "ridge": ridge,
    "beside_rtk": beside_rtk,
    "ray_motions": ray_motions,
    "times_per_exposure": times_per_exposure,
    "estimates": estimates,
    "prepare": prepared,
    "prepare_clean": clean_scans,
    "stripes": stripes,
    "calibrated_parameters": calibrated_parameters,
    "calibrated_psnr": calibrated_psnr,
    "fbp_peers": fbp_peers,
    "parallel_fly": parallel_fly,
    "fan_fly": fan_fly,
    "parallel_memory": parallel_memory,
    "moving_rtk": moving_rtk,
    "moving_known": moving_known,
    "moving_insert": moving_insert,
    "moving_unknown": lambda: moving_unknown("breathing", 64),
    "moving_drying": lambda: moving_unknown("drying", 32),
    "moving_mace4d": moving_mace4d,
    "turning": turning,
    "doubt": doubt,
}


def filled(text: str) -> str:
    """Returns a page with its tables made from the data."""
    return BLOCK.sub(lambda block: block[1] + TABLES[block[2]]() + block[3], text)


def main() -> None:
    differ = []
    for page in [*sorted(RESULTS.glob("*.md")), RESULTS.parent / "scanner.md"]:
        before = page.read_text(encoding="utf-8")
        after = filled(before)
        if after != before:
            differ.append(page.name)
            if "--check" not in sys.argv:
                page.write_text(after, encoding="utf-8")
    print("pages that differ from their data:" if "--check" in sys.argv else "pages written:", ", ".join(differ) or "none")
    sys.exit(bool(differ) and "--check" in sys.argv)


if __name__ == "__main__":
    main()
