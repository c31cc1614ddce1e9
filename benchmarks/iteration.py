"""Measures the parts of one iteration: binning, forward, loss, backward, TV, Adam, density control, gaps of the host.

    python benchmarks/iteration.py [--quick] [--size 128] [--gaussians 50000] [--rounds 5] [--device D] [--json FILE]

Kernel times are OpenCL events, the rest is the host's clock. Motions take turns in each round. Results are medians over
rounds of the mean iteration. "gaps" is what an iteration takes beyond its kernels: launches, copies, Python. Density control
is one round on the host, and counts with a hundredth per iteration (control.every)."""

import time

from measuring import Facts, finish, foot_scan, median, parser_of, splat_run, where

from phyradgs_cl.acquisition import Exact, MicroViews, Static
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import Runtime

MOTIONS = {"static": Static(), "8x5": MicroViews(8, 5), "exact": Exact()}
STAGES = {
    "prepare": ("splat_prepare", "splat_prepare_moving"),
    "binning": ("bin_count", "bin_within", "bin_starts", "bin_fill"),  # the sub-volume of TV is binned too
    "forward": ("splat_forward_rows", "intensity_merge"),
    "loss": ("ssim_moments", "ssim_map", "ssim_spread", "image_gradient", "intensity_split"),
    "backward": ("splat_backward_rows", "splat_chain"),
    "tv": ("voxel_prepare", "voxel_forward", "total_variation", "voxel_backward", "voxel_chain"),
    "adam": ("activate", "chain_activations", "adam_step"),
}


def one_round(rt: Runtime, run: SplatRun, iterations: int) -> dict[str, float]:
    """Returns milliseconds per iteration, by stage."""
    rt.kernel_seconds()
    started = time.perf_counter()
    for _ in range(iterations):
        run.step()
    rt.finish()
    wall_s = time.perf_counter() - started
    kernels = rt.kernel_seconds()
    known = {name for names in STAGES.values() for name in names}
    seconds = {stage: sum(kernels.get(name, 0.0) for name in names) for stage, names in STAGES.items()}
    seconds["other kernels"] = sum(s for name, s in kernels.items() if name not in known)
    seconds["gaps"] = wall_s - sum(kernels.values())
    seconds["iteration"] = wall_s
    return {stage: 1e3 * s / iterations for stage, s in seconds.items()}


def control_ms(run: SplatRun) -> float:
    """Returns the milliseconds of one round of density control, which leaves the run with another cloud."""
    started = time.perf_counter()
    run.control_density()
    run.rt.finish()
    return 1e3 * (time.perf_counter() - started)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument(
        "--size", type=int, default=128, help="voxels per side; the panel has twice as many pixels"
    )
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=10, help="in a round")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.size, arguments.gaussians, arguments.rounds, arguments.iterations = 24, 800, 1, 2
    rt = Runtime(arguments.device, profile=True)
    facts: Facts = where(rt) | {"size": arguments.size, "gaussians": arguments.gaussians}
    scan = foot_scan(rt, arguments.size)
    options = {name: SplatOptions(motion=motion, gaussians=arguments.gaussians) for name, motion in MOTIONS.items()}
    runs = {name: splat_run(rt, scan, one) for name, one in options.items()}
    for run in runs.values():
        one_round(rt, run, 3)
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in runs}
    for _ in range(arguments.rounds):
        for name, run in runs.items():
            rounds[name].append(one_round(rt, run, arguments.iterations))
    motions: dict[str, dict[str, float]] = {}
    for name, found in rounds.items():
        motions[name] = {stage: round(median([f[stage] for f in found]), 4) for stage in found[0]}
        motions[name]["kernel_share"] = round(1 - median([f["gaps"] / f["iteration"] for f in found]), 4)
        motions[name]["density_control_round"] = round(control_ms(runs[name]), 3)
        motions[name]["density_control"] = motions[name]["density_control_round"] / 100
    facts["ms"] = motions
    facts["over_static"] = {n: m["iteration"] / motions["static"]["iteration"] for n, m in motions.items()}
    finish(facts, arguments.json)
    print("| stage | " + " | ".join(motions) + " |\n|---" + "|---" * len(motions) + "|")
    for stage in motions["static"]:
        print(f"| {stage} | " + " | ".join(f"{m[stage]:.3g}" for m in motions.values()) + " |")


if __name__ == "__main__":
    main()
