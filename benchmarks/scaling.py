"""How cost grows with Gaussians and with pixels: splat forward and backward, and the voxeliser.

    python benchmarks/scaling.py [--quick] [--device D] [--json docs/results/scaling.json] [--figure docs/images/scaling.png]

Kernel times, medians of turns in which all sizes are run once. Gaussians from 1,000 to 500,000 on 256² pixels (and 128³
voxels), pixels from 128² to 1024² with 50,000 Gaussians that keep their size in mm; one static pose. Exponents p of
cost ~ size^p are fitted to sizes of which a launch takes more than its own overhead: from 10,000 Gaussians on, and to all
numbers of pixels.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import Facts, exponent, finish, median, parser_of, where

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import static_cells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector, Voxeliser
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows

GAUSSIANS, PIXELS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 500_000), (128, 256, 512, 1024)
FIXED_GAUSSIANS, FIXED_PIXELS, VOXELS = 50_000, 256, 128
FITTED_FROM = 10_000
STEPS = {"forward": "splat_forward_rows", "backward": "splat_backward_rows", "voxelise": "voxel_forward"}
Step = Callable[[], dict[str, float]]


def cloud(count: int, seed: int = 0) -> np.ndarray:
    """Gaussians (11, G) of 1 to 3 pixels of a panel of 256, in a ball of radius 0.95, sorted by height."""
    rng = np.random.default_rng(seed)
    pixel = 4.0 / FIXED_PIXELS / 1.4
    rows = np.zeros((11, count))
    direction = rng.normal(size=(3, count))
    rows[:3] = 0.95 * direction / np.linalg.norm(direction, axis=0) * rng.uniform(0, 1, count) ** (1 / 3)
    rows[3:6] = rng.uniform(pixel, 3 * pixel, (3, count))
    quaternion = rng.normal(size=(4, count))
    rows[6:10] = quaternion / np.linalg.norm(quaternion, axis=0)
    rows[10] = rng.uniform(0.1, 1.0, count)
    return rows[:, np.argsort(rows[2])]


def splat_step(rt: Runtime, count: int, pixels: int) -> Step:
    """A turn: forward and backward, kernel seconds by step."""
    geometry = ConeGeometry(5.0, 7.0, (pixels, pixels), (4.0 / pixels,) * 2)
    orbit = CircularOrbit(geometry, ConstantSpeed(0.3, 0.0))
    cells = DeviceCells.upload(rt, static_cells(orbit, Shutter(0.0), 0, 0.0, pixels))
    gaussians = DeviceGaussians.upload(rt, cloud(count))
    gradients = rt.zeros((13, gaussians.stride))
    by_image = rt.upload(pad_rows(np.random.default_rng(1).normal(size=(pixels, pixels))))
    projector = SplatProjector(rt, pixels, pixels)

    def turn() -> dict[str, float]:
        rt.kernel_seconds()
        projector.forward(gaussians, cells)
        projector.backward(gaussians, cells, by_image, gradients)
        return rt.kernel_seconds()

    return turn


def voxel_step(rt: Runtime, count: int) -> Step:
    grid = Grid.cube(VOXELS, 2.0)
    gaussians, voxeliser = DeviceGaussians.upload(rt, cloud(count)), Voxeliser(rt, grid.shape)

    def turn() -> dict[str, float]:
        rt.kernel_seconds()
        voxeliser.forward(gaussians, grid)
        return rt.kernel_seconds()

    return turn


def costs(steps: dict[int, Step], repeats: int) -> dict[int, dict[str, float]]:
    """Median milliseconds by size: of the kernels that STEPS names, and of all of a turn."""
    turns: dict[int, list[dict[str, float]]] = {size: [] for size in steps}
    for repeat in range(repeats + 1):
        for size, step in steps.items():
            seconds = step()
            if repeat:  # the first builds kernels
                turns[size].append(seconds)
    found = {}
    for size, runs in turns.items():
        named = {name: kernel for name, kernel in STEPS.items() if kernel in runs[0]}
        found[size] = {f"{name}_ms": 1e3 * median([run[k] for run in runs]) for name, k in named.items()}
        found[size]["all_ms"] = 1e3 * median([sum(run.values()) for run in runs])
    return found


def exponents(found: dict[int, dict[str, float]], power: int, least: int) -> dict[str, float]:
    """By cost; ``power``: of the size along a side, 2 for pixels."""
    sizes = [size for size in found if size >= least]
    return {
        name: exponent([size**power for size in sizes], [found[size][name] for size in sizes])
        for name in found[sizes[0]]
    }


def figure(facts: Facts, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    panes, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    titles = ("splats, by Gaussians", "splats, by pixels", "voxeliser, by Gaussians")
    for axis, key, power, title in zip(
        axes, ("gaussians", "pixels", "voxeliser"), (1, 2, 1), titles, strict=True
    ):
        found: dict[int, dict[str, float]] = facts[key]  # type: ignore[assignment]
        sizes = np.array(list(found), float) ** power
        for name in next(iter(found.values())):
            p = facts["exponents"][key][name]  # type: ignore[index]
            axis.loglog(sizes, [f[name] for f in found.values()], "o-", label=f"{name[:-3]}, p = {p:.2f}")
        axis.set(title=title, xlabel="pixels" if power == 2 else "Gaussians", ylabel="kernel time, ms")
        axis.grid(True, which="major", alpha=0.3)
        axis.legend(frameon=False)
    panes.savefig(path, dpi=150)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--figure", type=Path, default=None)
    arguments = parser.parse_args()
    quick = arguments.quick
    gaussians, pixels = ((300, 1000, 3000), (32, 64, 128)) if quick else (GAUSSIANS, PIXELS)
    repeats = 1 if quick else arguments.repeats
    fixed, side, least = (1000, 64, 300) if quick else (FIXED_GAUSSIANS, FIXED_PIXELS, FITTED_FROM)
    rt = Runtime(arguments.device, profile=True)
    facts: Facts = where(rt)
    facts["gaussians"] = costs({count: splat_step(rt, count, side) for count in gaussians}, repeats)
    facts["voxeliser"] = costs({count: voxel_step(rt, count) for count in gaussians}, repeats)
    facts["pixels"] = costs({n: splat_step(rt, fixed, n) for n in pixels}, repeats)
    facts["exponents"] = {
        "gaussians": exponents(facts["gaussians"], 1, least),  # type: ignore[arg-type]
        "voxeliser": exponents(facts["voxeliser"], 1, least),  # type: ignore[arg-type]
        "pixels": exponents(facts["pixels"], 2, 0),  # type: ignore[arg-type]
    }
    finish(facts, arguments.json)
    if arguments.figure:
        figure(facts, arguments.figure)


if __name__ == "__main__":
    main()
