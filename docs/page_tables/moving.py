"""Makes the tables of moving objects from recorded runs."""

from operator import itemgetter
from statistics import mean
from typing import Any

from page_tables import lines_of, markdown, table

BOX_MM = 2.0  # of the volumes that breathe


@table("moving_rtk")
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


@table("moving_known")
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


@table("moving_unknown", "breathing", 64)
@table("moving_drying", "drying", 32)
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


@table("moving_insert")
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


@table("moving_mace4d")
def moving_mace4d() -> str:
    """Returns the rack and pinion of mbirtorch's demonstration, by its MACE4D and by ``moving``."""
    rows = [
        [one["program"], f"{one['mean_psnr_db']:.2f}", f"{one['least_psnr_db']:.2f}", f"{one['mean_ssim']:.3f}"]
        + [f"{one['seconds']:.1f}"]
        for one in lines_of("moving.jsonl") if one["case"] == "rack and pinion"
    ]
    return markdown(["", "mean PSNR, dB", "least PSNR, dB", "mean SSIM", "processor, s"], rows)
