"""Makes the tables of quality by method, settings and error bars from recorded runs."""

from functools import cache
from statistics import mean, stdev
from typing import Any

from page_tables import Row, Scores, lines_of, markdown, rows_of, table

DEFAULT = "**`fista`, the default**"
METHODS = (
    # Label of the page; rows with the motion ignored, with the motion known, and of the still scan.
    *((name, name, f"{name} per-row", name) for name in ("FDK", "SART", "OS-SART", "SIRT", "CGLS", "ASD-POCS", "FISTA-TV")),
    ("`fista --prior dct`, on one grid", "", "FISTA with DCT on one grid per-row", "FISTA with DCT on one grid"),
    ("`fista --prior dct`", "", "FISTA with DCT per-row", "FISTA with DCT"),
    (DEFAULT, "", "FISTA with ridge per-row", "FISTA with ridge"),
    ("R2-Gaussian", "R2-Gaussian", "R2-Gaussian w/ ST", "R2-Gaussian"),
    ("PhyRadGS, 8 × 5 (the paper's)", "PhyRadGS w/o ST", "PhyRadGS", "PhyRadGS w/o ST"),
    ("PhyRadGS, exact in time", "PhyRadGS w/o ST", "PhyRadGS exact in time", "PhyRadGS w/o ST"),
)


@table("table1_S_rapid", "table1_S.csv", "rapid", True)
@table("table1_S_standard", "table1_S.csv", "standard")
@table("table1_M_rapid", "table1_M.csv", "rapid")
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


@table("table2_S")
def strips() -> str:
    """Returns Table 2 of the paper: PhyRadGS over strips and sub-intervals."""
    rows = [row for key, row in rows_of("table2_S.csv").items() if key[0] == "rapid" and key[2] == "fly-scan"]
    names = {"PhyRadGS w/o ST": "static"}
    cells = [
        [names.get(row["row"], row["row"]), f"{number(row):.2f}", f"{number(row, 'ssim'):.3f}", row["paper_psnr_db"] or "–"]
        for row in rows
    ]
    return markdown(["strips M, sub-intervals N", "PSNR (dB)", "SSIM", "the paper's PSNR"], cells)


@table("phantom_M")
def phantom() -> str:
    """Returns the paper's sphere phantom: PSNR, shape and density of its beads."""
    rows = rows_of("phantom_M.csv")
    text = []
    for label, ignored, known, _ in METHODS:
        if label in ("SART", "OS-SART", "SIRT", "CGLS"):  # these are in the CSV file
            continue
        for kind, name in (("ignored", ignored), ("known", known)):
            row = rows.get(("rapid", name, "fly-scan"))
            if row is None or (label.startswith("PhyRadGS, exact") and kind == "ignored"):
                continue
            shape = [f"{100 * number(row, 'roundness'):.1f}", f"{number(row, 'centre_shift_mm'):.2f}"]
            shape += [f"{number(row, 'edge_rise_mm'):.2f}", f"{100 * number(row, 'bias_balls'):.1f}"]
            pseudo = f"{number(row, 'psnr_db_pseudo'):.2f}"
            text.append([label, kind, pseudo, row["paper_psnr_db"] or "–", f"{number(row):.2f}", *shape])
    heads = ["method", "motion", "PSNR to pseudo-truth", "the paper's", "PSNR to truth", "out of round, %", "shift, mm"]
    return markdown([*heads, "rise, mm", "bias, %"], text)


@cache
def prior_runs() -> dict[tuple[Any, ...], dict[tuple[str, int], dict[str, Scores]]]:
    """Returns the runs of ``priors.jsonl`` by scan (kind, object, views, photons, voxels), volume and seed, and prior."""
    scans: dict[tuple[Any, ...], dict[tuple[str, int], dict[str, Scores]]] = {}
    for line in lines_of("priors.jsonl"):
        of = line["volume"] if line["volume"] == "spheres" else "volumes"
        key = line["kind"], of, line["views"], int(line["dose"]), line["size"]
        scans.setdefault(key, {}).setdefault((line["volume"], line["seed"]), {})[line["prior"]] = line
    return scans


@table("ridge")
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


@table("prior_weight")
def prior_weight() -> str:
    """Returns PSNR with the default weight, and with the best one factor for all volumes, as means over volumes."""
    scans: dict[tuple[Any, ...], dict[str, dict[float, dict[str, Any]]]] = {}
    for line in lines_of("prior_weight.jsonl"):
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
        if best != 1.0:
            text.append(cells)
    heads = ["scan", "views", "photons", "voxels, pixels", "default", "best factor for all"]
    others = len(scans) - len(text)
    return markdown(heads, text) + f"\nOf the other {others} kinds of scans the default is the best factor.\n"


@table("doubt")
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


@table("turning")
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
