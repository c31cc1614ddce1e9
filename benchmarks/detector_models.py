"""Measures the gain from modelling the detector: every effect modelled and ignored, several methods, means over seeds.

    python benchmarks/detector_models.py RESULTS.jsonl [--names shepp-logan] [--effects lag,pulse] [--seeds 0]

Scans are rapid fly-scans: 25 frames of 14.4 degrees, read by rows, 48³ voxels, 72² pixels. Counts are of 1e5 photons with
electronic noise of 10, unless an effect has others. Iterative methods take every line at its own 5 times. phyradgs is exact
in time, or has micro-views (8x5) where named so. There is one line per run, and the command continues where it stopped.

Effects: intensity (peak line integral 4 and 6; ignored: line integrals are averaged), pulse (all lines share one flash;
ignored: the beam is always on), lag (0.1 and 0.3; ignored: not undone), low-dose (300 photons; modelled: pixels are
weighted by their transmission)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from scans import append, read_lines, results_parser

from phyradgs_cl.acquisition import ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import Preprocessing, RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import Scene, SimulationOptions, phantom_scene, simulate

VOXELS, PIXELS, SUB_INTERVALS = 48, 72, 5
PULSE = (0.86, 0.14)  # the pulse that all lines of the rapid protocol share
ITERATIONS = {
    "sart": 10, "os-sart": 15, "sirt": 60, "cgls": 12, "asd-pocs": 10, "fista-tv": 50,
    "phyradgs": 2000, "phyradgs micro-views": 2000,
}  # fmt: skip
ALL = tuple(ITERATIONS)
GEOMETRY = ConeGeometry(5.0, 7.0, (PIXELS, PIXELS), (4.0 / PIXELS, 4.0 / PIXELS))

Row = dict[str, object]


@dataclass(frozen=True)
class Effect:
    """One effect: the scan that has it, and the options of the runs that model it and that ignore it."""

    name: str
    methods: tuple[str, ...]
    simulation: dict[str, object] = field(default_factory=dict)
    modelled: dict[str, object] = field(default_factory=dict)
    ignored: dict[str, object] = field(default_factory=dict)
    pulse: tuple[float, float] | None = None
    forget: Callable[[Scan], Scan] = lambda scan: scan  # the scan file's statement without knowledge of the effect


def always_on(scan: Scan) -> Scan:
    return replace(scan, shutter=replace(scan.shutter, pulse_s=None))


def effects() -> list[Effect]:
    found = [
        Effect(f"intensity, peak {peak:g}", ALL, {"peak": peak}, {}, {"detector_model": "log"})
        for peak in (4.0, 6.0)
    ]
    few = ("sart", "fista-tv", "phyradgs")
    found.append(Effect("pulse, one flash", few, pulse=PULSE, forget=always_on))
    found += [
        Effect(f"lag {lag:g}", (*few, "sirt"), {"lag": lag}, {}, {"ignore_lag": True}) for lag in (0.1, 0.3)
    ]
    low = {"dose": 300.0, "electronic_noise": 1.0}
    found.append(Effect("low-dose weights", ("fista-tv",), low, {"transmission_weights": True}))
    return found


def scene_of(rt: Runtime, name: str) -> Scene:
    return phantom_scene(rt, name, GEOMETRY, Grid.cube(VOXELS, 2.0), VOXELS, "rows", 0)


def scan_of(scene: Scene, effect: Effect, seed: int) -> Scan:
    usual = {"peak": 4.0, "dose": 1e5, "electronic_noise": 10.0}
    options = SimulationOptions(
        protocol=make_protocol("rapid", pulse=effect.pulse),
        detector_model="intensity",
        noise="beer",
        seed=seed,
        **{**usual, **effect.simulation},
    )
    return simulate(scene.source, GEOMETRY, scene.grid, options, reference=scene.reference)


def psnr_db(rt: Runtime, scan: Scan, method: str, told: dict[str, object], seed: int) -> float:
    name, _, motion = method.partition(" ")
    changes = {"iterations": ITERATIONS[method], **told}
    before = Preprocessing(ignore_lag=bool(changes.pop("ignore_lag", False)))
    if name == "phyradgs":
        changes["motion"] = motion or "exact"
    else:
        changes |= {"motion": "per-row", "sub_intervals": SUB_INTERVALS}
    result = reconstruct(scan, RunPlan(name, method_options(name, None, changes), seed=seed, preprocessing=before), rt)
    return compare(result.volume, scan.reference)["psnr_db"]


def rows(rt: Runtime, name: str, seed: int, wanted: tuple[str, ...], done: set[tuple]) -> Iterator[Row]:
    for effect in effects():
        missing = [m for m in effect.methods if (name, effect.name, m, seed) not in done]
        if not missing or not effect.name.startswith(wanted):
            continue
        scan = scan_of(scene_of(rt, name), effect, seed)
        unaware = effect.forget(scan)
        for method in missing:
            modelled = psnr_db(rt, scan, method, effect.modelled, seed)
            ignored = psnr_db(rt, unaware, method, effect.ignored, seed)
            yield {
                "object": name,
                "effect": effect.name,
                "method": method,
                "seed": seed,
                "modelled_db": round(modelled, 3),
                "ignored_db": round(ignored, 3),
            }


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--names", default="shepp-logan", help="phantoms, with commas")
    parser.add_argument("--effects", default="", help="beginnings of the effects' names, with commas")
    parser.add_argument("--seeds", default="0")
    arguments = parser.parse_args()
    lines = read_lines(arguments.results)
    rt, wanted = Runtime(arguments.device), tuple(arguments.effects.split(","))
    done = {(line["object"], line["effect"], line["method"], line["seed"]) for line in lines}
    for seed in (int(s) for s in arguments.seeds.split(",")):
        for name in arguments.names.split(","):
            for line in rows(rt, name, seed, wanted, done):
                append(arguments.results, line)


if __name__ == "__main__":
    main()
