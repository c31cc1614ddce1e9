"""Makes the tables of motion and detector models, and speed from recorded runs."""

from statistics import mean
from typing import Any

from page_tables import Scores, facts_of, grouped, lines_of, markdown, table


@table("motion_models")
def motion_models() -> str:
    """Returns whole reconstructions by the motion models of the splats, as means over the volumes."""
    lines = [line for line in lines_of("motion_models_pruned.jsonl") if line["size"] == 64 and line["iterations"] == 3000]
    found = [{line["motion"]: line for line in of} for of in grouped(lines, "volume").values()]
    models = {"static": "static", "8x5": "8 × 5", "exact 0.005": "exact, bound 0.005"}
    whole = [by for by in found if all(model in by for model in models)]
    text = []
    for model, name in models.items():
        psnr, ssim = (mean(by[model][key] for by in whole) for key in ("psnr_db", "ssim"))
        gains = [by[model]["psnr_db"] - by["8x5"]["psnr_db"] for by in whole]
        least_most = "" if model == "8x5" else f"{min(gains):+.2f} to {max(gains):+.2f}"
        text.append([name, f"{psnr:.2f}", f"{ssim:.3f}", least_most])
    return markdown(["model", "PSNR, dB", "SSIM", f"gain over 8 × 5, {len(whole)} volumes"], text)


ONE_FRAME = {"static": "static", "centres": "centres", "8x5": "8 × 5", "exact": "exact"}


@table("centres_distance")
def centres_distance() -> str:
    """Returns errors of a frame of single Gaussians, by motion model and distance from the axis."""
    lines = [line for line in lines_of("centres_only.jsonl") if line.get("distance") in (0.0, 0.4, 0.8)]
    text = [
        [line["gaussians"], str(line["distance"]), *(f"{100 * line[name]:.2g} %" for name in ONE_FRAME)] for line in lines
    ]
    return markdown(["Gaussians", "distance", *ONE_FRAME.values()], text)


@table("detector_models")
def detector_models() -> str:
    """Returns the gain of each method from modelling a detector's effect: modelled PSNR, and its excess over ignoring it."""
    lines = lines_of("detector_models.jsonl")
    methods = list(dict.fromkeys(line["method"] for line in lines))
    text = []
    for (effect,), of in grouped(lines, "effect").items():
        cells = {line["method"]: line for line in of}
        of_effect = [cells.get(method) for method in methods]
        shown = [f"{x['modelled_db']:.1f} ({x['modelled_db'] - x['ignored_db']:+.2f})" if x else "" for x in of_effect]
        text.append([effect, *shown])
    return markdown(["effect", *methods], text)


@table("times_per_exposure")
def times_per_exposure() -> str:
    """Returns PSNR and time of ``fista`` by the times in an exposure, as means over the volumes with the same numbers."""
    by_volume: dict[tuple[Any, ...], dict[int, Scores]] = {}
    for one in lines_of("times_per_exposure.jsonl"):
        if one["method"] == "fista":
            key = one["size"], one["views"], one["moved_voxels"], one["volume"]
            by_volume.setdefault(key, {})[one["times"]] = one
    scans: dict[tuple[Any, ...], list[dict[int, Scores]]] = {}
    for (*scan, volume), runs in by_volume.items():
        scans.setdefault((*scan, volume == "spheres", tuple(sorted(runs))), []).append(runs)
    counts, rows = (1, 2, 3, 5, 6, 9, 17), []
    for (size, views, moved, _, made), of in sorted(scans.items()):
        cells = {n: f"{mean(runs[n]['psnr_db'] for runs in of):.2f}" for n in made}
        for n in made:
            seconds = [runs[n]["processor_s"] for runs in of if runs[n]["processor_s"]]
            cells[n] += f" ({mean(seconds):.0f} s)" if len(seconds) == len(of) else ""
        names = ", ".join(sorted(next(iter(runs.values()))["volume"].partition("_")[0] for runs in of))
        rows.append([f"{size}³, {views}", f"{moved:.1f}", names, *(cells.get(n, "") for n in counts)])
    return markdown(["voxels, views", "rim moves", "volumes", *(f"N = {n}" for n in counts)], rows)


@table("beside_rtk")
def beside_rtk() -> str:
    """Returns FDK, projector and adjoint compared with RTK's, on three processors."""
    text = []
    for processor, suffix in (("EPYC, AVX-512", ""), ("Xeon, AVX-512", "_intel"), ("EPYC, AVX2", "_zen3")):
        fdk = facts_of(f"rtk_fdk{suffix}.json")["speed"]
        rays = facts_of(f"ray_speed{suffix}.json")["beside_rtk"]
        cells = [f"{fdk[key]:.3f}" for key in ("seconds", "rtk_seconds")]
        cells += [f"{fdk[key]:.1f}" for key in ("ratio", "processor_ratio")]
        text.append([processor, "FDK", *cells])
        for step, name in (("forward", "forward projection (Joseph)"), ("adjoint", "matched backprojection (Joseph)")):
            x = rays[step]
            cells = [f"{x[who]['wall_s']:.3f}" for who in ("ours", "rtk")]
            cells += [f"{x[f'times_as_fast_{clock}']:.1f}" for clock in ("wall", "processor")]
            text.append([processor, name, *cells])
    return markdown(["processor", "operator", "ours, s", "RTK, s", "times as fast", "by processor time"], text)


@table("ray_motions")
def ray_motions() -> str:
    """Returns the cost of every motion model in passes of a scanner at rest, on two processors."""
    files = ("ray_speed.json", "ray_speed_intel.json")
    by_file = {name: facts_of(name)["by_motion"] for name in files}
    text = []
    for motion in by_file[files[1]]:
        cells = [motion]
        for times in by_file.values():
            for step in ("forward", "adjoint"):
                passes = times[motion][step]["processor_s"] / times["static"][step]["processor_s"]
                cells.append(f"{passes:.1f}")
        text.append(cells)
    return markdown(["motion", "EPYC: forward", "adjoint", "Xeon: forward", "adjoint"], text)


@table("estimates")
def estimates() -> str:
    """Returns time and memory by ``estimate`` over those of the run."""
    text = []
    for run in facts_of("estimates.json")["runs"]:
        ratio = run["ratio"]
        shares = [f"{ratio[key]:.2f}" for key in ("seconds", "host_bytes", "device_bytes")]
        text.append([run["method"], f"{run['happened']['seconds']:.1f}", *shares])
    return markdown(["method", "taken, s", "time", "host memory", "device buffers"], text)
