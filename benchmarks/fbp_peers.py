"""Compares filtered backprojection with scikit-image's, ASTRA's (CPU) and silx's (OpenCL) on the same sinograms.

    python -m venv PEER && PEER/bin/pip install astra-toolbox silx scikit-image "pyopencl[pocl]"
    python benchmarks/fbp_peers.py --peer-python PEER/bin/python [--json docs/results/fbp_peers.json] [--quick]

The phantom is Shepp-Logan by Kak and Slaney's table, in closed form, over half a turn. Differences are relative RMS inside
the panel's circle, for 129 columns and 180 views. PSNR has the range 1, against the phantom at the pixels' centres. Speed is
that of 2048 columns, 1800 views and 16 rows. Peers reconstruct slice by slice, so they get one row, and their times count
sixteenfold."""

import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from measuring import Facts, finish, parser_of, where

from phyradgs_cl.acquisition import ParallelGeometry, pixel_centres
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors.fdk import fdk_volume
from phyradgs_cl.runtime import Runtime

PEERS = ("skimage", "astra", "silx")
SMALL, LARGE, QUICK = (129, 180, 1), (2048, 1800, 16), (256, 200, 16)  # columns, views, rows


def sinogram(columns: int, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns line integrals (views, columns) and angles (views,) in rad."""
    geometry, angle_rad = ParallelGeometry((1, columns), 1.0), np.arange(views) * np.pi / views
    phantom, lines = shepp_logan(0.45 * columns, "kak-slaney", 1.0), np.empty((views, columns), np.float32)
    for view, pose in enumerate(geometry.pose(angle_rad)):
        pixels = pixel_centres(pose, (1, columns))[0]
        lines[view] = phantom.line_integrals(pixels - 2 * columns * pose[:3], pixels + 2 * columns * pose[:3])
    return lines, angle_rad


def ours(rt: Runtime, lines: np.ndarray, angle_rad: np.ndarray, rows: int) -> tuple[np.ndarray, Facts]:
    """Returns the volume (rows, y, x) of ``rows`` equal rows, and the times of a run after a short one."""
    views, columns = lines.shape
    pose, frames = ParallelGeometry((rows, columns), 1.0).pose(angle_rad), np.repeat(lines[:, None], rows, 1)
    grid = Grid((rows, columns, columns), (1.0, 1.0, 1.0))
    fdk_volume(rt, frames[:: views // 8], pose[:: views // 8], grid, is_parallel=True)  # this builds the kernels
    wall_s, processor_s = time.perf_counter(), time.process_time()
    volume = fdk_volume(rt, frames, pose, grid, is_parallel=True)
    wall_s, processor_s = time.perf_counter() - wall_s, time.process_time() - processor_s
    return volume, {"wall_s": wall_s, "processor_s": processor_s}


def peer(python: str, name: str, lines: np.ndarray, angle_rad: np.ndarray) -> tuple[np.ndarray, Facts]:
    """Returns the slice (y, x) of a peer, and its times for one row."""
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, sino=lines[None], angle_rad=angle_rad)
        subprocess.run([python, str(Path(__file__).with_name("fbp_peer.py")), str(given), str(result), name], check=True)
        found = np.load(result)
        return found["volume"][0], {name: float(found[name]) for name in ("wall_s", "processor_s")}


def differences(rt: Runtime, python: str) -> Facts:
    """Returns each peer's relative RMS difference and PSNR, and ours."""
    columns, views, rows = SMALL
    lines, angle_rad = sinogram(columns, views)
    mine = ours(rt, lines, angle_rad, rows)[0][0]
    axis = np.arange(columns) - (columns - 1) / 2
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) < columns / 2 - 1
    truth = shepp_logan(0.45 * columns, "kak-slaney", 1.0).density(x, y, 0 * x)[inside]

    def psnr_db(image: np.ndarray) -> float:
        return float(-10 * np.log10(np.mean((image[inside] - truth) ** 2)))

    facts: Facts = {"ours": {"psnr_db": psnr_db(mine)}}
    for name in PEERS:
        image = peer(python, name, lines, angle_rad)[0]
        off = np.linalg.norm((image - mine)[inside]) / np.linalg.norm(mine[inside])
        facts[name] = {"relative_rms": float(off), "psnr_db": psnr_db(image)}
    return facts


def main() -> None:
    parser = parser_of(__doc__ or "")
    parser.add_argument("--peer-python", required=True, help="a Python that has the peers")
    args = parser.parse_args()
    rt = Runtime(args.device)
    columns, views, rows = QUICK if args.quick else LARGE
    lines, angle_rad = sinogram(columns, views)
    times = {"ours": ours(rt, lines, angle_rad, rows)[1]}
    for name in PEERS:
        one = peer(args.peer_python, name, lines, angle_rad)[1]
        times[name] = {key: rows * float(value) for key, value in one.items()}  # type: ignore[arg-type]
    fastest = {key: min(float(times[name][key]) for name in PEERS) for key in ("wall_s", "processor_s")}  # type: ignore[arg-type]
    ratios = {key: value / float(times["ours"][key]) for key, value in fastest.items()}  # type: ignore[arg-type]
    size = {"columns": columns, "views": views, "rows": rows}
    found = {"differences": differences(rt, args.peer_python), "times": times, "fastest_over_ours": ratios}
    finish({**where(rt), **size, **found}, args.json)


if __name__ == "__main__":
    main()
