"""Makes the tables of moving objects from recorded runs."""

from statistics import mean

from page_tables import Scores, grouped, lines_of, markdown, span, table

BOX_MM = 2.0  # of the volumes that breathe


@table("moving_rtk")
def moving_rtk() -> str:
    """Returns RTK's own test of motion-compensated FDK, from its files."""
    cases = grouped(lines_of("moving.jsonl"), "case")
    rows = [
        [one["program"], f"{one['mean_error']:.4f}", f"{one['psnr_db']:.2f}", f"{one['near_psnr_db']:.2f}"]
        for one in cases["own test",]
    ]
    (same,) = cases["same field",]
    table = markdown(["", "mean error", "PSNR, dB", "PSNR within 20 mm, dB"], rows)
    ours_s, rtk_s = same["seconds"], same["rtk_seconds"]
    faster = f"{rtk_s / ours_s:.1f} times as fast ({ours_s:.2f} s, RTK {rtk_s:.2f} s)"
    off = f"at most {same['largest_difference']:.1e} of the peak apart"
    return f"{table}\nOn the same field: {off}; {faster} of processor time.\n"


@table("moving_known")
def moving_known() -> str:
    """Returns breathing volumes of 64³ by ``fista``, at rest and with the known field: means over volumes."""
    cases = grouped(lines_of("moving.jsonl"), "case")
    rest = {(one["views"], one["volume"]): one for one in cases["rest",]}
    rows = []
    for (views,), known in sorted(grouped(cases["known",], "views").items()):
        still = [rest[views, one["volume"]] for one in known]
        losses_db = [a["psnr_db"] - b["psnr_db"] for a, b in zip(still, known, strict=True)]
        times = [b["seconds"] / a["seconds"] for a, b in zip(still, known, strict=True)]
        scores = [_scores(still), _scores(known)]
        rows.append([str(views), str(len(known)), *scores, _mean_and_span(losses_db), span(times, ".1f")])
    heads = ["views", "volumes", "at rest", "known field", "loss, dB", "time, times at rest"]
    return markdown(heads, rows)


@table("moving_unknown", "breathing", 64)
@table("moving_drying", "drying", 32)
def moving_unknown(motion: str, size: int) -> str:
    """Returns moving volumes of size³ voxels as if they rested, and with the field of ``moving``: means over volumes."""
    found = [one for one in grouped(lines_of("moving.jsonl"), "case")["unknown",] if one["size"] == size]
    found = [one for one in found if one.get("motion", "breathing") == motion]
    rows = []
    for (views,), of in sorted(grouped(found, "views").items()):
        gains_db = [one["mean_psnr_db"] - one["static_mean_psnr_db"] for one in of]
        off, off_95 = ([one[f"{key}_motion_error_mm"] * size / BOX_MM for one in of] for key in ("mean", "p95"))
        row = [str(views), str(len(of)), _scores(of, "static_mean_"), _scores(of, "mean_"), _mean_and_span(gains_db)]
        times = span([one["seconds"] / one["static_seconds"] for one in of], ".1f")
        rows.append([*row, _mean_and_span(off), f"{mean(off_95):.2f}", times])
    periods_s = [one["period_s"] for one in found]
    periods = span(periods_s, ".2f") + " s" if all(periods_s) else "none"
    heads = ["views", "volumes", "as if at rest", "`moving`", "gain, dB", "field wrong by, voxels", "95 %"]
    return markdown([*heads, "time, times at rest"], rows) + f"\nPeriods found: {periods}.\n"


def _scores(of: list[Scores], prefix: str = "") -> str:
    """Returns mean PSNR and SSIM of runs."""
    psnr_db, ssim = (mean(one[prefix + name] for one in of) for name in ("psnr_db", "ssim"))
    return f"{psnr_db:.2f}/{ssim:.3f}"


def _mean_and_span(values: list[float]) -> str:
    return f"{mean(values):.2f} ({span(values, '.2f')})"


@table("moving_insert")
def moving_insert() -> str:
    """Returns the centre of a ball in a breathing body: with the true field, the motion ignored, and a field found."""
    rows = []
    for one in grouped(lines_of("moving.jsonl"), "case")["insert",]:
        pairs = [
            [f"{one[key]:.4f}", f"{10 * one[key] / one['moved_mm']:.2f}"] if key in one else ["–", "–"]
            for key in ("off_mm", "states_off_mm")
        ]
        rows.append([one["motion"], *pairs[0], *pairs[1]])
    heads = ["field", "reference off by, mm", "of 10 mm", "states off by, mm", "of 10 mm"]
    return markdown(heads, rows)


@table("moving_mace4d")
def moving_mace4d() -> str:
    """Returns the rack and pinion of mbirtorch's demonstration, by its MACE4D and by ``moving``."""
    rows = [
        [one["program"], f"{one['mean_psnr_db']:.2f}", f"{one['least_psnr_db']:.2f}", f"{one['mean_ssim']:.3f}"]
        + [f"{one['seconds']:.1f}"]
        for one in grouped(lines_of("moving.jsonl"), "case")["rack and pinion",]
    ]
    return markdown(["", "mean PSNR, dB", "least PSNR, dB", "mean SSIM", "processor, s"], rows)
