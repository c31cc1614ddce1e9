"""Measures the speed of the splat projector, as rates and as ratios of one run.

    python benchmarks/splat_speed.py [--detector 256] [--gaussians 50000] [--repeats 7] [--device D] [--json FILE]

"Evaluated" pairs are the Gaussian-pixel pairs of all vectors that were computed. "box" pairs lie in the bounding boxes of
the cutoff ellipses, "useful" pairs inside the ellipses (pi/4 of the box)."""

import resource
import statistics

import numpy as np
from measuring import finish, foot_scan, parser_of, random_cloud

from phyradgs_cl.acquisition import MicroViews, Scan, Static
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows

MOTIONS = {"static": Static(), "micro-views 8x5": MicroViews(8, 5)}


def projector_rates(rt: Runtime, scan: Scan, count: int, repeats: int) -> dict[str, dict[str, float]]:
    """Returns kernel seconds and rates of forward and backward, by motion model."""
    rng = np.random.default_rng(0)
    detector = scan.lines
    pixel = 4.0 / detector / 1.4
    gaussians = DeviceGaussians.upload(rt, random_cloud(count, (pixel, 3 * pixel), rng))
    gradients = rt.zeros((13, gaussians.stride))
    by_image = rt.upload(pad_rows(rng.normal(size=(detector, detector))))
    projector = SplatProjector(rt, detector, detector)
    tables = {name: DeviceCells.upload(rt, motion.cells(scan, 3)) for name, motion in MOTIONS.items()}
    seconds: dict[str, dict[str, list[float]]] = {
        name: {"forward": [], "backward": [], "all": []} for name in tables
    }
    result: dict[str, dict[str, float]] = {}
    for repeat in range(repeats + 1):
        for name, cells in tables.items():
            rt.kernel_seconds()
            projector.forward(gaussians, cells)
            projector.backward(gaussians, cells, by_image, gradients)
            kernels = rt.kernel_seconds()
            if repeat == 0:
                work = projector.work(gaussians, cells)
                result[name] = {"box_pairs": work.pairs, "evaluated_pairs": work.evaluated, "footprints": work.footprints}
                continue
            seconds[name]["forward"].append(kernels["splat_forward_rows"])
            seconds[name]["backward"].append(kernels["splat_backward_rows"])
            seconds[name]["all"].append(sum(kernels.values()))
    for name, times in seconds.items():
        facts = result[name]
        for step in ("forward", "backward", "all"):
            facts[f"{step}_ms"] = 1e3 * statistics.median(times[step])
        for step in ("forward", "backward"):
            facts[f"{step}_evaluated_g_per_s"] = facts["evaluated_pairs"] / facts[f"{step}_ms"] / 1e6
            facts[f"{step}_useful_g_per_s"] = np.pi / 4 * facts["box_pairs"] / facts[f"{step}_ms"] / 1e6
    return result


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--detector", type=int, default=256)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    rt = Runtime(arguments.device, profile=True)
    scan = foot_scan(rt, arguments.detector // 2)
    facts: dict[str, object] = {
        "device": rt.device.name,
        "lanes": rt.lanes,
        "detector": arguments.detector,
        "gaussians": arguments.gaussians,
        "projector": projector_rates(rt, scan, arguments.gaussians, arguments.repeats),
        "peak_host_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    projector: dict[str, dict[str, float]] = facts["projector"]  # type: ignore[assignment]
    facts["projector_overhead"] = projector["micro-views 8x5"]["all_ms"] / projector["static"]["all_ms"]
    finish(facts, arguments.json)


if __name__ == "__main__":
    main()
