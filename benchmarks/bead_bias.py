"""Measures why the beads of the sphere phantom come out too dense from fly-scans, by changing one thing at a time.

The scans are those of `python benchmarks/tables phantom`. Others have no noise and no jitter, and average line integrals
over an exposure in place of intensities, where the forward model is exact. Bias is the mean inside the beads over the true
mean, less 1. The bias of the total is that of the whole volume."""

from dataclasses import dataclass, field
from functools import lru_cache

from scans import RAPID, append, read_lines, results_parser
from tables.case import FLY, STILL
from tables.phantom_case import PhantomCase
from tables.sizes import bench_size

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, simulate

RAW, CLEAN, LINEAR = FLY, "free of noise and jitter", "lines averaged, free of noise and jitter"


@dataclass(frozen=True)
class Trial:
    name: str
    data: str = RAW
    method: str = "fista-tv"
    changes: dict[str, object] = field(default_factory=dict)


TRIALS = (
    Trial("as in the table"),
    Trial("intensity not modelled", changes={"detector_model": "log"}),
    Trial(CLEAN, CLEAN),
    Trial(LINEAR, LINEAR),
    Trial("the same, 15 times per line", LINEAR, changes={"sub_intervals": 15}),
    Trial("the same, 500 iterations", LINEAR, changes={"iterations": 500}),
    Trial("the same, a tenth of the TV weight", LINEAR, changes={"tv_weight": 1e-4}),
    Trial("the same, ten times the TV weight", LINEAR, changes={"tv_weight": 1e-2}),
    Trial("stop-and-shoot", STILL, changes={"motion": "static"}),
    Trial("as in the table", method="phyradgs"),
    Trial("intensity not modelled", method="phyradgs", changes={"detector_model": "log"}),
)


def ideal(case: PhantomCase, detector_model: str) -> Scan:
    """Returns the fly-scan of a case in which only the quantity averaged over an exposure may be wrong."""
    options = SimulationOptions(protocol=RAPID, readout_axis="rows", detector_model=detector_model)
    source = AnalyticSource(case.phantom, case.geometry)
    return simulate(source, case.geometry, case.grid, options, reference=case.truth)


def run(rt: Runtime, case: PhantomCase, scan: Scan, trial: Trial) -> dict[str, float]:
    motion = {"motion": "per-row"} if trial.method == "fista-tv" else {}
    options = method_options(trial.method, None, {**motion, **trial.changes})
    volume = reconstruct(scan, RunPlan(trial.method, options), rt).volume
    shape = case.shape(volume)
    return {
        "psnr_db": compare(volume, case.truth)["psnr_db"],
        "bias_balls": shape["bias_balls"],
        "bias_total": float(volume.sum(dtype=float) / case.truth.sum(dtype=float)) - 1,
        "edge_rise_mm": shape["edge_rise_mm"],
    }


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--size", default="S", help="of benchmarks/tables")
    parser.add_argument("--trials", default="", help="beginnings of their names, with commas; all without it")
    arguments = parser.parse_args()
    rt = Runtime(arguments.device)
    case = PhantomCase(rt, bench_size(arguments.size), RAPID, "rows", 0, lambda: case.truth)
    models = {CLEAN: "intensity", LINEAR: "log"}

    @lru_cache
    def scan_of(data: str) -> Scan:
        return ideal(case, models[data]) if data in models else case.scan(data)

    done = {(line["size"], line["trial"], line["method"]) for line in read_lines(arguments.results)}
    for trial in TRIALS:
        facts = {"size": arguments.size, "trial": trial.name, "method": trial.method}
        if tuple(facts.values()) not in done and trial.name.startswith(tuple(arguments.trials.split(","))):
            append(arguments.results, {**facts, **run(rt, case, scan_of(trial.data), trial)})


if __name__ == "__main__":
    main()
