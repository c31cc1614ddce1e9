"""What a margin of coarser voxels would cost: a box and what lies around it on two grids, solved as one system.

    python benchmarks/coarse_margin.py --phantoms jaw foot VOLUMES/cthead_128.h5 VOLUMES/walnut_128.h5

PSNR in dB in the box, of a panel that sees a third less than the object, with the margin's voxels as wide as the box's,
twice and three times as wide. docs/prepare.md has the figures; no method has such a margin.
"""

import argparse
from pathlib import Path

import numpy as np
from prepare import EFFECTS, PEAK
from skimage.restoration import denoise_tv_chambolle

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.api import compare, simulate
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.runtime import Runtime

TIMES = (1, 2, 3)
TV_PER_MM = 2e-4
MOTION = PerRow(sub_intervals=1)


def around(box: Grid, margin_mm: np.ndarray, times: int) -> tuple[Grid, np.ndarray]:
    """A grid of voxels so many times as wide as those of ``box``, with its margin, and 1 where they lie outside the box."""
    voxel_mm = times * np.array(box.voxel_size_mm)
    shape = np.ceil((box.size_mm + 2 * margin_mm) / voxel_mm - 0.01).astype(int)
    middles_mm = [(np.arange(n) - (n - 1) / 2) * side_mm for n, side_mm in zip(shape, voxel_mm, strict=True)]
    far = np.stack(np.meshgrid(*middles_mm, indexing="ij"), -1) / box.size_mm
    grid = Grid(tuple(map(int, shape)), tuple(map(float, voxel_mm)), box.offset_mm)
    return grid, (np.abs(far).max(-1) > 0.5).astype(np.float32)


def solved(rt: Runtime, scan: Scan, parts: list[tuple[Grid, np.ndarray]], iterations: int) -> list[np.ndarray]:
    """Volumes on several grids, each with a mask of its voxels, that explain the frames together: accelerated gradient
    steps, each over the row sums of AᵀA, with total variation and no negative values."""
    tables = [MOTION.cells(scan, frame) for frame in range(scan.frames)]
    operators = [RayOperator(rt, grid, scan.geometry.detector_shape, tables) for grid, _ in parts]
    masks = [mask for _, mask in parts]

    def forward(volumes: list[np.ndarray]) -> np.ndarray:
        return sum(o.forward((v * mask).astype(np.float32)) for o, v, mask in zip(operators, volumes, masks, strict=True))

    def adjoint(frames: np.ndarray) -> list[np.ndarray]:
        return [o.adjoint(frames) * mask for o, mask in zip(operators, masks, strict=True)]

    lipschitz = [np.maximum(sums, 1e-9) for sums in adjoint(forward(masks))]
    now = [np.zeros_like(mask) for mask in masks]
    ahead, speed = now, 1.0
    for _ in range(iterations):
        slopes = adjoint(forward(ahead) - scan.projections)
        steps = [v - slope / most for v, slope, most in zip(ahead, slopes, lipschitz, strict=True)]
        new = [denoise_tv_chambolle(np.maximum(v, 0), TV_PER_MM, max_num_iter=20).astype(np.float32) for v in steps]
        faster = (1 + np.sqrt(1 + 4 * speed**2)) / 2
        ahead = [v + (speed - 1) / faster * (v - old) for v, old in zip(new, now, strict=True)]
        now, speed = new, faster
    return now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--phantoms", nargs="+", default=["jaw", "foot"], help="names, or files of volumes")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--iterations", type=int, default=80)
    given = parser.parse_args()
    rt, cut_off = Runtime(), EFFECTS["a third cut off"]
    print("| volume |" + "".join(f" voxels × {times} |" for times in TIMES) + "\n" + "| --- " * (1 + len(TIMES)) + "|")
    for phantom in given.phantoms:
        scan = simulate(
            phantom, size=given.size, detector=3 * given.size // 2, views=60, peak=PEAK, noise="beer", dose=1e5,
            exposure_deg=4.8, device=rt, seed=0, **cut_off.planted,
        )  # fmt: skip
        part = scan.on_grid(cut_off.grid(scan.grid))
        margin_mm = cut_off.margin * np.array(part.grid.size_mm)
        found = []
        for times in TIMES:
            parts = [(part.grid, np.ones(part.grid.shape, np.float32)), around(part.grid, margin_mm, times)]
            inner = solved(rt, part, parts, given.iterations)[0]
            found.append(f"{compare(inner, part.reference)['psnr_db']:.2f}")
        print(f"| {' | '.join([Path(phantom).stem, *found])} |", flush=True)


if __name__ == "__main__":
    main()
