"""Speed of the splat projector and of a whole iteration, as rates and ratios from one run.

    python benchmarks/splat_speed.py [--detector 256] [--gaussians 50000] [--repeats 7] [--device D] [--json FILE]

"Evaluated" pairs are the Gaussian-pixel pairs of all vectors that were computed; "box" pairs lie in the bounding boxes
of the cutoff ellipses, "useful" ones inside the ellipses (pi/4 of the box).
"""

import resource
import statistics
import time

import numpy as np
from measuring import finish, parser_of

from phyradgs_cl.acquisition import ConeGeometry, MicroViews, Scan, Static, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.run import SplatRun
from phyradgs_cl.reconstructors.splats.start import first_population, internal_scale
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

MOTIONS = {"static": Static(), "micro-views 8x5": MicroViews(8, 5)}


def cloud(count: int, detector: int, rng: np.random.Generator) -> np.ndarray:
    """Random Gaussians of 1 to 3 pixels in a ball, sorted by height as a reconstruction keeps them; (11, G)."""
    pixel = 4.0 / detector / 1.4
    rows = np.zeros((11, count))
    rows[:3] = rng.uniform(-0.55, 0.55, (3, count))
    rows[3:6] = rng.uniform(pixel, 3 * pixel, (3, count))
    rows[6:10] = rng.normal(size=(4, count))
    rows[6:10] /= np.linalg.norm(rows[6:10], axis=0)
    rows[10] = rng.uniform(0.1, 1.0, count)
    return rows[:, np.argsort(rows[2])]


def fly_scan(rt: Runtime, detector: int) -> Scan:
    geometry = ConeGeometry(5.0, 7.0, (detector, detector), (4.0 / detector,) * 2)
    scene = phantom_scene(rt, "foot", geometry, Grid.cube(detector // 2, 2.0), detector // 2, "rows", 0)
    options = SimulationOptions(protocol=make_protocol("rapid"), noise="tigre", time_samples=8)
    return simulate(scene.source, geometry, scene.grid, options, reference=scene.reference)


def projector_rates(rt: Runtime, scan: Scan, count: int, repeats: int) -> dict[str, dict[str, float]]:
    """Kernel seconds and rates of forward and backward, by motion model."""
    rng = np.random.default_rng(0)
    detector = scan.lines
    gaussians = DeviceGaussians.upload(rt, cloud(count, detector, rng))
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
                box, evaluated, footprints = projector.count_pairs(gaussians, cells)
                result[name] = {"box_pairs": box, "evaluated_pairs": evaluated, "footprints": footprints}
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


def iteration_shares(rt: Runtime, scan: Scan, count: int, iterations: int) -> dict[str, dict[str, float]]:
    """Wall and kernel time of whole iterations (density control left out), by motion model."""
    fdk = static_fdk(rt, scan)
    scale = internal_scale(fdk, scan.grid)
    grid = scan.grid.scaled(1 / scale.length_mm)
    result: dict[str, dict[str, float]] = {}
    for name, motion in MOTIONS.items():
        options = SplatOptions(motion=motion, gaussians=count)
        rng = np.random.default_rng(0)
        population = first_population(fdk / scale.density_per_mm, grid, options, rng)
        run = SplatRun(rt, scan, options, scale, population, rng)
        for _ in range(3):
            run.step()
        rt.kernel_seconds()
        started = time.perf_counter()
        for _ in range(iterations):
            run.step()
        rt.finish()
        wall = time.perf_counter() - started
        kernels = rt.kernel_seconds()
        result[name] = {"wall_ms": 1e3 * wall / iterations, "kernel_share": sum(kernels.values()) / wall}
        result[name].update(
            {f"{k}_ms": 1e3 * s / iterations for k, s in sorted(kernels.items(), key=lambda x: -x[1])[:8]}
        )
    return result


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--detector", type=int, default=256)
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    rt = Runtime(arguments.device, profile=True)
    scan = fly_scan(rt, arguments.detector)
    facts: dict[str, object] = {
        "device": rt.device.name,
        "lanes": rt.lanes,
        "detector": arguments.detector,
        "gaussians": arguments.gaussians,
        "projector": projector_rates(rt, scan, arguments.gaussians, arguments.repeats),
        "iteration": iteration_shares(rt, scan, arguments.gaussians, 3 * arguments.repeats),
        "peak_host_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    projector: dict[str, dict[str, float]] = facts["projector"]  # type: ignore[assignment]
    iteration: dict[str, dict[str, float]] = facts["iteration"]  # type: ignore[assignment]
    facts["projector_overhead"] = projector["micro-views 8x5"]["all_ms"] / projector["static"]["all_ms"]
    facts["iteration_overhead"] = iteration["micro-views 8x5"]["wall_ms"] / iteration["static"]["wall_ms"]
    finish(facts, arguments.json)


if __name__ == "__main__":
    main()
