"""Makes the tables of preparation, calibration and parallel beams from recorded runs."""

from collections.abc import Sequence
from statistics import mean

from page_tables import Scores, facts_of, grouped, lines_of, markdown, span, table


@table("prepare")
def prepared() -> str:
    """Returns the decibels that an effect costs, and the percentage that ``prepare`` regains, by effect and size.

    Both are ranges from the least to the largest of all volumes."""
    methods = ("fdk", "fista-tv", "phyradgs")
    text = []
    for (effect, size), lines in sorted(grouped(_prepared_lines(), "effect", "size").items()):
        by_method = grouped(lines, "method")
        volumes = len(grouped(lines, "phantom"))
        shown = [_losses(by_method.get((method,), [])) for method in methods]
        text.append([effect, f"{size}³", str(volumes), *shown])
    return markdown(["effect", "voxels", "volumes", *methods], text)


def _prepared_lines() -> list[Scores]:
    """Returns the lines of all runs of ``prepare``, each with the size of its volume."""
    found = []
    for name in ("prepare", "prepare_volumes", "prepare_fresh", "prepare_64"):
        head, *lines = lines_of(f"{name}.jsonl")
        found += [line | {"size": head["size"]} for line in lines if "regained" in line]
    return [line for line in found if not line["effect"].startswith("a third")]


def _losses(lines: Sequence[Scores]) -> str:
    """Returns the loss in dB and the part of it that returns. The part of a loss below 0.1 dB means nothing."""
    if not lines:
        return ""
    losses_db = [line["clean"] - line["spoilt"] for line in lines]
    parts = [100 * line["regained"] for line, lost_db in zip(lines, losses_db, strict=True) if lost_db > 0.1]
    return span(losses_db, ".2f") + (f"; {span(parts, '.0f')} %" if parts else "")


@table("prepare_clean")
def clean_scans() -> str:
    """Returns the part of rings that returns, and below the table what the usual steps change in clean scans."""
    lines = lines_of("prepare_clean.jsonl")
    text = []
    for (method, views), cell in sorted(grouped(lines, "method", "views").items()):
        by_step = grouped((line for line in cell if "regained" in line), "steps")
        rings = [[100 * line["regained"] for line in by_step.get((f"rings {spread}",), [])] for spread in (0.01, 0.02, 0.05)]
        if any(rings):
            text.append([method, str(views), *(f"{span(parts, '.0f')} %" for parts in rings)])
    clean = [line for line in lines if "lost_db" in line]
    changed = [line for line in clean if not line["unchanged"]]
    views = ", ".join(str(views) for (views,) in sorted(grouped(changed, "views")))
    lost = f"all from {views} views, by at most {max(line['lost_db'] for line in changed):.3f} dB"
    table = markdown(["method", "views", "rings of 1 %", "2 %", "5 %"], text)
    return f"{table}\nOf {len(clean)} clean scans {len(changed)} change, {lost}.\n"


@table("stripes")
def stripes() -> str:
    """Returns PSNR with stripes, and after steps of ``prepare``, at the most views. Rows "none" are the clean scan."""
    lines = lines_of("stripes.jsonl")
    views = max(line["views"] for line in lines)
    steps = ["", "dead,rings", "stripes", "dead,rings,stripes", "every column", "algotom", "algotom, narrow"]
    text = []
    for key, of in grouped((line for line in lines if line["views"] == views), "stripes", "object").items():
        psnr_db = {line["steps"]: f"{line['psnr_db']:.2f}" for line in of}
        text.append([*key, *(psnr_db[name] for name in steps)])
    titles = ["no step", *(f"`{name}`" for name in steps[1:4]), "`stripes`, `ratio=0`", *steps[5:]]
    return markdown(["stripes", "object", *titles], text)


def calibrate_lines() -> list[Scores]:
    """Returns the recorded calibrations of every case on its finest grid."""
    lines = lines_of("calibrate.jsonl")
    finest = {line["case"]: max(other["size"] for other in lines if other["case"] == line["case"]) for line in lines}
    return [line for line in lines if line["size"] == finest[line["case"]]]


@table("calibrated_parameters")
def calibrated_parameters() -> str:
    """Returns the worst error of every parameter with two runs or more, the stated σ, and how often 2 σ held the truth."""
    found = [
        {**one, "case": line["case"], "size": line["size"]}
        for line in calibrate_lines() for one in line["parameters"] if one.get("error") is not None
    ]  # fmt: skip
    text = []
    for (case, size, name, unit), of in grouped(found, "case", "size", "name", "unit").items():
        if len(of) > 1 and case != "right":  # with nothing planted errors are those of the case panel
            worst = max(abs(one["error"]) for one in of)
            inside = sum(abs(one["z"]) <= 2 for one in of)
            sigma = mean(one["deviation"] for one in of)
            text.append([case, f"{size}³", name, f"{worst:.2g} {unit}", f"{sigma:.2g}", f"{inside}/{len(of)}"])
    return markdown(["case", "voxels", "parameter", "worst error", "σ stated", "within 2 σ"], text)


@table("calibrated_psnr")
def calibrated_psnr() -> str:
    """Returns PSNR with the stated, the calibrated and the right geometry."""
    text = []
    for (case, size, views), of in grouped(calibrate_lines(), "case", "size", "views").items():
        found = [line["psnr_db"] for line in of if "stated" in line.get("psnr_db", {})]
        if not found or case.startswith("draw"):
            continue
        means = [f"{mean(one[key] for one in found):.2f}" for key in ("stated", "calibrated", "right")]
        worst = min(one["calibrated"] - one["right"] for one in found)
        text.append([case, f"{size}, {views}", *means, f"{worst:+.3f}", str(len(found))])
    return markdown(["case", "voxels, views", "stated", "calibrated", "right", "worst difference", "runs"], text)


@table("fbp_peers")
def fbp_peers() -> str:
    """Returns filtered backprojection compared with its peers: differences, PSNR, seconds."""
    found = facts_of("fbp_peers.json")
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


@table("parallel_fly")
def parallel_fly() -> str:
    """Returns PSNR and modulation at rim and centre of parallel fly-scans: a row per scan, a column per method."""
    columns = [("fbp", "ignored"), ("fbp", "deblurred"), ("fbp", "deblurred ten times")]
    columns += [("fista", "ignored"), ("fista", "known")]
    text = []
    for (views, blur, dose), of in sorted(grouped(lines_of("parallel_fly.jsonl"), "views", "blur_px", "dose").items()):
        if (views < 1800 or dose > 1e4) and (views == 180 or blur > 1):
            by = {(x["method"], x["motion"]): f"{x['psnr_db']:.1f}, {x['rim']:.2f}, {x['centre']:.2f}" for x in of}
            text.append([str(views), f"{blur:g}", f"{dose:g}", *(by.get(column, "–") for column in columns)])
    labels = {"deblurred": "`deblur=0.03`", "deblurred ten times": "`deblur=0.003`"}
    heads = (f"`{method}`, {labels.get(motion, motion)}" for method, motion in columns)
    return markdown(["views", "blur", "photons", *heads], text)


@table("fan_fly")
def fan_fly() -> str:
    """Returns NMSE of a fan beam's fly-scan: a row per method, a column per size and way to average."""
    sizes = (175, 350, 700)
    rows = []
    for (method, model), of in grouped(lines_of("fan_fly.jsonl"), "method", "model").items():
        nmse = {one["side"]: f"{one['nmse']:.4f}" for one in of}
        rows.append([f"`{method}`", model, *(nmse[side] for side in sizes)])
    return markdown(["method", "motion", *(f"{side}²" for side in sizes)], rows)


@table("parallel_memory")
def parallel_memory() -> str:
    """Returns the memory of parallel scans within a limit."""
    rows = [
        [f"`{one['method']}`", f"{one['columns']} × {one['rows']} × {one['views']}", one["limit"]]
        + [f"{one[key] / 2**30:.2f} GiB" for key in ("buffer_bytes", "host_bytes")] + [str(one["processor_s"])]
        for one in lines_of("parallel_memory.jsonl")
    ]
    return markdown(["method", "columns × rows × views", "limit", "buffers", "resident", "processor, s"], rows)
