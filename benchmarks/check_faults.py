"""Plants faults in scans of a folder's volumes, and counts which of them `phyradgs check` finds.

    python benchmarks/check_faults.py VOLUMES RESULTS.jsonl [--names a,b] [--size 64] [--seeds 7] [--faults none,rotation]
    python benchmarks/check_faults.py VOLUMES RESULTS.jsonl --table

It writes one line of JSON per scan, and continues where it stopped. Scans are those of benchmarks/scans.py: 25 views of the
rapid protocol, with TIGRE's noise at 1e4 photons and σ 10. Four faults need other scans:

- `short exposure`: the exposure is half of the time between frames. Twice the exposure then fits the timing, and only the
  frames show the fault.
- `narrow cone`: the source is 100 times as far. A wrong sign of rotation leaves no trace, and `cannot tell` is right.
- `... aside`: the panel's middle is off the axis by 8 % of its width, and the scan states it correctly.
- `half turn`: the views cover 180° and the fan.

Scans with wrong sizes, distances or images have the grid that an import would give them."""

import argparse
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scans import RAPID, append, chosen, files_of, lines_of, make_scan, read_lines, runs_parser

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Protocol, Scan, make_protocol
from phyradgs_cl.acquisition.geometry import default_grid
from phyradgs_cl.check import CANNOT_TELL, SUSPICIOUS, check
from phyradgs_cl.runtime import Runtime

DEAD_SHARE, DRIFT, OFFSET_PX = 0.01, 0.05, 3.0
ASIDE = 0.08
SHORT = make_protocol("rapid", exposure_deg=7.2, readout_ratio=1.72)
DENSE = make_protocol("rapid", views=50, exposure_deg=7.2)
Plant = Callable[[Scan, np.random.Generator], Scan]


def as_it_is(scan: Scan, rng: np.random.Generator) -> Scan:
    return scan


def rotation(scan: Scan, rng: np.random.Generator) -> Scan:
    """Plants angles with the other sign."""
    sweeps = scan.trajectory.kinematics
    turned = replace(sweeps, angle_start_rad=-sweeps.angle_start_rad, angle_end_rad=-sweeps.angle_end_rad)
    return replace(scan, trajectory=CircularOrbit(scan.geometry, turned))


def readout(scan: Scan, rng: np.random.Generator) -> Scan:
    """Plants the opposite readout direction."""
    return replace(scan, shutter=replace(scan.shutter, direction=-scan.shutter.direction))


def offset(scan: Scan, rng: np.random.Generator) -> Scan:
    """Plants a panel offset that is wrong by three pixels, to either side."""
    shift_mm = OFFSET_PX * scan.geometry.pixel_size_mm[1] * rng.choice([-1, 1])
    geometry = replace(scan.geometry, detector_offset_mm=(0.0, shift_mm))
    return replace(scan, geometry=geometry, trajectory=CircularOrbit(geometry, scan.trajectory.kinematics))


def drift(scan: Scan, rng: np.random.Generator) -> Scan:
    """Plants a gain that rises or falls evenly by 5 % over the scan, after the flats."""
    gain = 1 + DRIFT * rng.choice([-1, 1]) * np.arange(scan.frames) / (scan.frames - 1)
    shift = np.log(gain).astype(np.float32)[:, None, None]
    return replace(scan, projections=scan.projections - shift)


def dead(scan: Scan, rng: np.random.Generator) -> Scan:
    """Plants faults in 1 % of the panel's pixels: half have no count (the floor of half a count), half repeat some value."""
    p = scan.projections.copy()
    count = round(DEAD_SHARE * p[0].size)
    rows, columns = np.unravel_index(rng.choice(p[0].size, count, replace=False), p.shape[1:])
    stuck = rng.uniform(0, p.max(), count).astype(np.float32)
    stuck[: count // 2] = np.log(2e4)
    p[:, rows, columns] = stuck
    return replace(scan, projections=p)


def exposure(scan: Scan, rng: np.random.Generator) -> Scan:
    """Plants a stated exposure twice as long as the true one. The gantry's speed is right."""
    sweeps: FrameSweeps = scan.trajectory.kinematics
    arc = sweeps.angle_end_rad - sweeps.angle_start_rad
    longer = replace(sweeps, exposure_s=2 * sweeps.exposure_s, angle_end_rad=sweeps.angle_start_rad + 2 * arc)
    shutter = replace(scan.shutter, exposure_s=2 * scan.shutter.exposure_s)
    return replace(scan, shutter=shutter, trajectory=CircularOrbit(scan.geometry, longer))


def stated(scan: Scan, **changes: object) -> Scan:
    """Returns the same frames with another geometry stated, and with the grid that an import makes of it."""
    geometry = replace(scan.geometry, **changes)
    orbit = CircularOrbit(geometry, scan.trajectory.kinematics)
    return replace(scan, geometry=geometry, trajectory=orbit, grid=default_grid(geometry), reference=None)


def pixels(factor: float) -> Plant:
    """Plants pixel sizes of ``factor`` times their true size. The stated offset in mm is right."""
    return lambda scan, rng: stated(scan, pixel_size_mm=tuple(factor * p for p in scan.geometry.pixel_size_mm))


def distances(factor: float) -> Plant:
    """Plants distances of ``factor`` times their true values."""
    names = ("source_to_axis_mm", "source_to_detector_mm")
    return lambda scan, rng: stated(scan, **{name: factor * getattr(scan.geometry, name) for name in names})


def images(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Plants one change of all frames, such as a mirror image."""
    return lambda scan, rng: stated(replace(scan, projections=np.ascontiguousarray(change(scan.projections))))


def of_half_turn(scan: Scan) -> Scan:
    """Returns the scan with only the frames of 180° and the fan."""
    geometry = scan.geometry
    fan_rad = 2 * np.arctan2(geometry.detector_shape[1] * geometry.pixel_size_mm[1] / 2, geometry.source_to_detector_mm)
    sweeps: FrameSweeps = scan.trajectory.kinematics
    last = int(np.searchsorted(sweeps.angle_start_rad - sweeps.angle_start_rad[0], np.pi + fan_rad)) + 1
    part = {name: getattr(sweeps, name)[:last] for name in ("start_s", "angle_start_rad", "angle_end_rad")}
    orbit = CircularOrbit(geometry, replace(sweeps, **part))
    return replace(
        scan, projections=scan.projections[:last], trajectory=orbit, frame_start_s=scan.frame_start_s[:last]
    )


def half_turn_offset(scan: Scan, rng: np.random.Generator) -> Scan:
    return offset(of_half_turn(scan), rng)


CENTRE, SIGN, READOUT, SAME = "centre of rotation", "sign of rotation", "sign of readout", "consistency"

EITHER = (SUSPICIOUS, CANNOT_TELL)  # a narrow cone does not show the fault


@dataclass(frozen=True)
class Fault:
    """A fault and the scan in which it is planted. One of ``questions`` should have one of the ``right`` verdicts, and the
    first suspicious answer should say ``says``. aside: the true offset of the panel over its width."""

    plant: Plant = as_it_is
    questions: tuple[str, ...] = ()
    right: tuple[str, ...] = (SUSPICIOUS,)
    says: str = ""
    protocol: Protocol = RAPID
    away: float = 1.0
    aside: float = 0.0


FAULTS: dict[str, Fault] = {
    "none": Fault(),
    "rotation": Fault(rotation, (SIGN,)),
    "readout": Fault(readout, (READOUT,)),
    "offset": Fault(offset, (CENTRE,)),
    "drift": Fault(drift, ("gain drift",)),
    "dead": Fault(dead, ("dead pixels",)),
    "exposure": Fault(exposure, ("timing", "exposure")),
    "short none": Fault(protocol=SHORT),
    "short exposure": Fault(exposure, ("exposure",), protocol=SHORT),
    "narrow none": Fault(away=100.0),
    "narrow cone": Fault(rotation, (SIGN,), (CANNOT_TELL,), away=100.0),
    "half turn none": Fault(lambda scan, rng: of_half_turn(scan), protocol=DENSE),
    "half turn offset": Fault(half_turn_offset, (CENTRE,), protocol=DENSE),
    "none aside": Fault(aside=ASIDE),
}
WHOLE = {
    "pixels x 0.1": Fault(pixels(0.1), (SAME,), says="pixel sizes 10 times"),
    "pixels x 0.001": Fault(pixels(0.001), (SAME,), says="pixel sizes 1000 times"),
    "pixels x 1000": Fault(pixels(1000.0), (SAME,), says="pixel sizes 0.001 times"),
    "distances x 0.1": Fault(distances(0.1), (SAME,), says="distances 10 times"),
    "distances x 0.001": Fault(distances(0.001), (SAME,), says="distances 1000 times"),
    "distances x 10": Fault(distances(10.0), (SAME,), says="distances 0.1 times"),
    "transposed": Fault(images(lambda p: p.swapaxes(1, 2)), (SAME,), says="cause not found"),
    "mirrored in u": Fault(images(lambda p: p[:, :, ::-1]), (SAME, SIGN), says="mirrored in u"),
    "mirrored in v": Fault(images(lambda p: p[:, ::-1]), (SAME, READOUT), EITHER, "mirrored in v"),
}
for name, fault in WHOLE.items():
    FAULTS |= {name: fault, f"{name} aside": replace(fault, aside=ASIDE)}


def run_all(arguments: argparse.Namespace) -> None:
    volumes = files_of(arguments.volumes, arguments.names, arguments.size)
    faults, results = chosen("--faults", arguments.faults, FAULTS), arguments.results
    rt = Runtime(arguments.device)
    done = {key_of(line) for line in read_lines(results)}
    for seed in arguments.seeds:
        for name, path in volumes.items():
            scans: dict[tuple[Protocol, float, float], Scan] = {}
            for fault in faults:
                facts = {"volume": name, "fault": fault, "size": arguments.size, "seed": seed}
                if key_of(facts) in done:
                    continue
                planted = FAULTS[fault]
                key = planted.protocol, planted.away, planted.aside
                if key not in scans:
                    scans[key] = make_scan(rt, path, arguments.size, seed, *key)
                scan = planted.plant(scans[key], np.random.default_rng([seed, *f"{name} {fault}".encode()]))
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


def is_right(planted: Fault, findings: list[dict[str, object]]) -> bool:
    """Returns whether a question that should find the fault does, and the first suspicious answer names the right cause."""
    if not planted.questions:
        return True
    answered = any(f["question"] in planted.questions and f["verdict"] in planted.right for f in findings)
    alarms = [f"{f['text']} -> {f['advice']}" for f in findings if f["verdict"] == SUSPICIOUS]
    return answered and (not alarms or planted.says in alarms[0])


def table(path: Path) -> str:
    """Returns a Markdown table with a row for each planted fault, then every scan with a wrong answer."""
    lines = lines_of(path)
    text = ["| planted | scans | answered rightly | other questions suspicious |", "| --- | --- | --- | --- |"]
    wrong: list[str] = []
    for name, fault in FAULTS.items():
        planted = [line for line in lines if line["fault"] == name]
        if not planted:
            continue
        hits = [is_right(fault, line["findings"]) for line in planted]
        verdicts = [{f["question"]: f["verdict"] for f in line["findings"]} for line in planted]
        others = [[q for q, v in said.items() if v == SUSPICIOUS and q not in fault.questions] for said in verdicts]
        rightly = sum(hits) if fault.questions else f"silent on {sum(not other for other in others)}"
        text.append(f"| {name} | {len(hits)} | {rightly} | {sum(map(len, others))} |")
        for line, hit, other, said in zip(planted, hits, others, verdicts, strict=True):
            answers = [] if hit else [f"{q}: {said.get(q, 'not asked')}" for q in fault.questions]
            if answers or other:
                facts = "; ".join([*answers, *(f"{q}: suspicious" for q in other)])
                wrong.append(f"- {name}, {line['volume']}, seed {line['seed']}: {facts}")
    return "\n".join([*text, "", "Answered wrongly, or beside the point:", "", *(wrong or ["- none"])])


def main() -> None:
    parser = runs_parser(__doc__, seeds="7")
    parser.add_argument("--faults", default=",".join(FAULTS))
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--table", action="store_true", help="print the table of the results, run nothing")
    asked = parser.parse_args()
    if not asked.table:
        run_all(asked)
    print(table(asked.results))


if __name__ == "__main__":
    main()
