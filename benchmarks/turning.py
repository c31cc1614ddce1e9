"""Measures quality by number of frames, arc of an exposure and readout, at equal dose.

    python benchmarks/turning.py VOLUMES RESULTS.jsonl --names bonsai,engine
    python docs/make_results.py      # the table in docs/scanner.md

All scans of a volume are one turn with the same photons in all. A line has the PSNR in dB of the default method on one scan,
with the motion known or ignored. ``arcs``: frames with the arc of an exposure in degrees; where frames
times arc is less than 360, the beam is pulsed. Runs in the file are not made again."""

from scans import append, files_of, read_lines, runs_parser

from phyradgs_cl.api import compare, reconstruct, simulate
from phyradgs_cl.runtime import Runtime

PHOTONS = 25 * 1e4  # per pixel, over all frames
FULL = [(25, 14.4), (50, 7.2), (100, 3.6)]  # frames and degrees of an exposure that fill a turn
PULSED = [(25, 7.2), (25, 3.6), (25, 1.8), (50, 3.6), (50, 1.8), (100, 1.8)]
SCANS = [(*pair, ratio) for ratio in (0.0, 0.86, 4.0) for pair in FULL] + [(*pair, 0.0) for pair in PULSED]
SCANS += [(200, 1.8, 0.0), (400, 0.9, 0.0)]


def main() -> None:
    given = runs_parser(__doc__).parse_args()
    rt = Runtime(given.device)
    there = read_lines(given.results)
    files = files_of(given.volumes, given.names, 64)
    runs = [(*scan, name, seed) for scan in SCANS for name in files for seed in given.seeds]
    for frames, arc_deg, ratio, name, seed in runs:
        key = {"volume": name, "seed": seed, "frames": frames, "arc_deg": arc_deg, "readout_ratio": ratio}
        made = [line["motion"] for line in there if key.items() <= line.items()]
        left = [motion for motion in ("per-row", "static") if motion not in made]
        if not left:
            continue
        scan = simulate(
            files[name], views=frames, exposure_deg=arc_deg, readout_ratio=ratio, size=64, detector=128, noise="tigre",
            dose=PHOTONS / frames, seed=seed, device=rt,
        )  # fmt: skip
        for motion in left:
            volume = reconstruct(scan, motion=motion, device=rt, report=False).volume
            append(given.results, {**key, "motion": motion, "psnr_db": compare(volume, scan.reference)["psnr_db"]})


if __name__ == "__main__":
    main()
