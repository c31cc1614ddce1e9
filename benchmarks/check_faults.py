"""Plants faults in scans of a folder of volumes and asks `phyradgs check` about them: one line of JSON per scan, resumable.

    python benchmarks/check_faults.py VOLUMES RESULTS.jsonl [--names a,b] [--size 64] [--seeds 7] [--faults none,rotation]
    python benchmarks/check_faults.py --table RESULTS.jsonl

Scans are those of benchmarks/scans.py: 25 views of the rapid protocol, TIGRE's noise at 1e4 photons and σ 10. The
last faults are planted in scans of their own: `short exposure` in one that exposes half of the time between frames, so
that twice the exposure fits the timing and only the frames can tell, and `narrow cone` with the source 100 times as far,
where a wrong sign of rotation leaves no trace and `cannot tell` is the right answer.
"""

import argparse
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scans import RAPID, append, chosen, files_of, lines_of, make_scan, read_lines

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Protocol, Scan, make_protocol
from phyradgs_cl.check import CANNOT_TELL, SUSPICIOUS, check
from phyradgs_cl.runtime import Runtime

DEAD_SHARE, DRIFT, OFFSET_PX = 0.01, 0.05, 3.0
SHORT = make_protocol("rapid", exposure_deg=7.2, readout_ratio=1.72)


def as_it_is(scan: Scan, rng: np.random.Generator) -> Scan:
    return scan


def rotation(scan: Scan, rng: np.random.Generator) -> Scan:
    """Angles with the other sign."""
    sweeps = scan.trajectory.kinematics
    turned = replace(sweeps, angle_start_rad=-sweeps.angle_start_rad, angle_end_rad=-sweeps.angle_end_rad)
    return replace(scan, trajectory=CircularOrbit(scan.geometry, turned))


def readout(scan: Scan, rng: np.random.Generator) -> Scan:
    """The first line said to be the last."""
    return replace(scan, shutter=replace(scan.shutter, direction=-scan.shutter.direction))


def offset(scan: Scan, rng: np.random.Generator) -> Scan:
    """A panel said to be three pixels from where it is, to either side."""
    shift_mm = OFFSET_PX * scan.geometry.pixel_size_mm[1] * rng.choice([-1, 1])
    geometry = replace(scan.geometry, detector_offset_mm=(0.0, shift_mm))
    return replace(scan, geometry=geometry, trajectory=CircularOrbit(geometry, scan.trajectory.kinematics))


def drift(scan: Scan, rng: np.random.Generator) -> Scan:
    """A gain that rises or falls evenly by 5 % over the scan, after the flats."""
    gain = 1 + DRIFT * rng.choice([-1, 1]) * np.arange(scan.frames) / (scan.frames - 1)
    shift = np.log(gain).astype(np.float32)[:, None, None]
    return replace(scan, projections=scan.projections - shift)


def dead(scan: Scan, rng: np.random.Generator) -> Scan:
    """1 % of the panel's pixels: half without a count (the floor of half a count), half stuck at some value."""
    p = scan.projections.copy()
    count = round(DEAD_SHARE * p[0].size)
    rows, columns = np.unravel_index(rng.choice(p[0].size, count, replace=False), p.shape[1:])
    stuck = rng.uniform(0, p.max(), count).astype(np.float32)
    stuck[: count // 2] = np.log(2e4)
    p[:, rows, columns] = stuck
    return replace(scan, projections=p)


def exposure(scan: Scan, rng: np.random.Generator) -> Scan:
    """Exposure stated twice as long, at the speed that the gantry has."""
    sweeps: FrameSweeps = scan.trajectory.kinematics
    arc = sweeps.angle_end_rad - sweeps.angle_start_rad
    longer = replace(sweeps, exposure_s=2 * sweeps.exposure_s, angle_end_rad=sweeps.angle_start_rad + 2 * arc)
    shutter = replace(scan.shutter, exposure_s=2 * scan.shutter.exposure_s)
    return replace(scan, shutter=shutter, trajectory=CircularOrbit(scan.geometry, longer))


Plant = Callable[[Scan, np.random.Generator], Scan]
# name: (what is planted, protocol, how many times the source is away, questions that should find it, right verdict)
FAULTS: dict[str, tuple[Plant, Protocol, float, tuple[str, ...], str]] = {
    "none": (as_it_is, RAPID, 1.0, (), ""),
    "rotation": (rotation, RAPID, 1.0, ("sign of rotation",), SUSPICIOUS),
    "readout": (readout, RAPID, 1.0, ("sign of readout",), SUSPICIOUS),
    "offset": (offset, RAPID, 1.0, ("centre of rotation",), SUSPICIOUS),
    "drift": (drift, RAPID, 1.0, ("gain drift",), SUSPICIOUS),
    "dead": (dead, RAPID, 1.0, ("dead pixels",), SUSPICIOUS),
    "exposure": (exposure, RAPID, 1.0, ("timing", "exposure"), SUSPICIOUS),
    "short none": (as_it_is, SHORT, 1.0, (), ""),
    "short exposure": (exposure, SHORT, 1.0, ("exposure",), SUSPICIOUS),
    "narrow none": (as_it_is, RAPID, 100.0, (), ""),
    "narrow cone": (rotation, RAPID, 100.0, ("sign of rotation",), CANNOT_TELL),
}


def run_all(arguments: argparse.Namespace) -> None:
    volumes = files_of(arguments.volumes, arguments.names, arguments.size)
    faults, results = chosen("--faults", arguments.faults, FAULTS), Path(arguments.results)
    rt = Runtime(arguments.device)
    done = {key_of(line) for line in read_lines(results)}
    for seed in (int(s) for s in arguments.seeds.split(",")):
        for name, path in volumes.items():
            scans: dict[tuple[Protocol, float], Scan] = {}
            for fault in faults:
                facts = {"volume": name, "fault": fault, "size": arguments.size, "seed": seed}
                if key_of(facts) in done:
                    continue
                plant, protocol, away, _, _ = FAULTS[fault]
                if (protocol, away) not in scans:
                    scans[protocol, away] = make_scan(rt, path, arguments.size, seed, protocol, away=away)
                scan = plant(
                    scans[protocol, away], np.random.default_rng([seed, *f"{name} {fault}".encode()])
                )
                append(results, {**facts, **run_one(rt, scan)})


def run_one(rt: Runtime, scan: Scan) -> dict[str, object]:
    started = time.perf_counter()
    found = check(scan, rt)
    return {
        "findings": [finding.facts() for finding in found.findings],
        "seconds": round(time.perf_counter() - started, 2),
        "device": rt.device.name,
        "cpu": platform.processor() or platform.machine(),
        "version": __version__,
    }


def key_of(line: dict[str, object]) -> tuple[object, ...]:
    return tuple(line[key] for key in ("volume", "fault", "size", "seed"))


def table(path: Path) -> str:
    """Markdown: a row for each planted fault, then every scan that was answered wrong."""
    lines = lines_of(path)
    text = [
        "| planted | scans | answered rightly | not | other questions suspicious |",
        "| --- | --- | --- | --- | --- |",
    ]
    wrong: list[str] = []
    for fault, (_, _, _, questions, right) in FAULTS.items():
        chosen = [line for line in lines if line["fault"] == fault]
        if not chosen:
            continue
        verdicts = [{f["question"]: f["verdict"] for f in line["findings"]} for line in chosen]
        hits = [not questions or right in {v.get(q) for q in questions} for v in verdicts]
        others = [
            [q for q, verdict in v.items() if verdict == SUSPICIOUS and q not in questions] for v in verdicts
        ]
        silent = sum(not o for o in others)
        count = (
            f"{sum(hits)} | {len(hits) - sum(hits)}"
            if questions
            else f"silent on {silent} | {len(hits) - silent}"
        )
        text.append(f"| {fault} | {len(hits)} | {count} | {sum(map(len, others))} |")
        for line, hit, other, verdict in zip(chosen, hits, others, verdicts, strict=True):
            if not hit or other:
                said = "; ".join(
                    [f"{q}: {verdict.get(q, 'not asked')}" for q in questions if not hit]
                    + [f"{q}: suspicious" for q in other]
                )
                wrong.append(f"- {fault}, {line['volume']}, seed {line['seed']}: {said}")
    clean = [line for line in lines if line["fault"] == "none"]
    unsure = sorted(
        {
            f"{line['volume']}: {f['question']}"
            for line in clean
            for f in line["findings"]
            if f["verdict"] == CANNOT_TELL
        }
    )
    text += ["", "Answered wrongly, or beside the point:", "", *(wrong or ["- none"])]
    text += ["", f"`cannot tell` on clean scans: {', '.join(unsure) or 'none'}"]
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("volumes", help="folder of volumes")
    parser.add_argument("results", nargs="?", help="JSON lines, appended to")
    parser.add_argument("--names", default="", help="comma-separated; all in the folder by default")
    parser.add_argument("--faults", default=",".join(FAULTS))
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--seeds", default="7")
    parser.add_argument("--device", default=None)
    parser.add_argument(
        "--table", action="store_true", help="print the table of the results file given as VOLUMES"
    )
    arguments = parser.parse_args()
    if arguments.table:
        print(table(Path(arguments.volumes)))
    elif arguments.results is None:
        parser.error("the results file is missing")
    else:
        run_all(arguments)


if __name__ == "__main__":
    main()
