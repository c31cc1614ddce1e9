"""A sweep in Python: methods, motion models and numbers of views, as a table."""

import itertools
import json

from phyradgs_cl.api import compare, reconstruct, simulate

VIEWS = (15, 30)
SETTINGS = {
    "fdk": {"method": "fdk", "motion": "per-row"},
    "sirt, static": {"method": "sirt", "motion": "static", "iterations": 40},
    "sirt": {"method": "sirt", "motion": "per-row", "sub_intervals": 3, "iterations": 40},
    "fista-tv, static": {"method": "fista-tv", "motion": "static", "iterations": 30},
    "fista-tv": {"method": "fista-tv", "motion": "per-row", "sub_intervals": 3, "iterations": 30},
}

scans = {
    views: simulate("foot", size=24, detector=40, views=views, exposure_deg=360 / views, noise="tigre")
    for views in VIEWS
}
lines = []
for views, (name, options) in itertools.product(VIEWS, SETTINGS.items()):
    result = reconstruct(scans[views], **options, report=False)
    metrics = compare(result.volume, scans[views].reference)
    lines.append({"views": views, "setting": name, **metrics, "seconds": round(result.facts["seconds"], 2)})
    with open("sweep.jsonl", "a", encoding="utf-8") as file:  # line by line, so that an interrupted sweep loses nothing
        file.write(json.dumps(lines[-1]) + "\n")

print(f"{'PSNR (dB)':20}" + "".join(f"{views:>6} views" for views in VIEWS))
for name in SETTINGS:
    found = [line["psnr_db"] for line in lines if line["setting"] == name]
    print(f"{name:20}" + "".join(f"{psnr_db:12.2f}" for psnr_db in found))
