"""Compares ``moving`` and ``changing`` with MACE4D of mbirtorch, on the scan of mbirtorch's 4D demonstration.

    python -m venv PEER && PEER/bin/pip install mbirtorch
    python benchmarks/mace4d.py --peer-python PEER/bin/python RESULTS.jsonl [--size 32] [--views 120] [--device D]

The object is a rack and pinion; the frames are line integrals without noise. Our methods have their default options, MACE4D
has those of the demonstration. A line has the mean and the least PSNR, the mean SSIM and processor seconds. The truth is the
state in the middle of each of MACE4D's windows. FBP of each window alone is measured too, and ``fista``, as if the object
rested. A pixel counts as 1 mm. With TORCHDYNAMO_DISABLE=1 mbirtorch runs without PyTorch's compiler."""

import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from moving import plan_of
from scans import append, results_parser

from phyradgs_cl.acquisition import ParallelGeometry, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import Volume
from phyradgs_cl.metrics import METRICS, compare
from phyradgs_cl.reconstructors import Reconstruction, reconstruct
from phyradgs_cl.runtime import Runtime


def run_peer(python: str, size: int, views: int, path: Path) -> dict[str, np.ndarray]:
    script = Path(__file__).with_name("mace4d_peer.py")
    subprocess.run([python, str(script), str(size), str(views), str(path)], check=True, stdout=subprocess.DEVNULL)
    with np.load(path) as result:
        return dict(result)


def in_our_axes(volumes: np.ndarray) -> np.ndarray:
    """Returns volumes (n, row, column, slice) as (n, z, y, x). At angle 0, rays follow the rows."""
    return np.ascontiguousarray(volumes.transpose(0, 3, 2, 1), np.float32)


def states_of(result: Reconstruction, views: np.ndarray, scan: Scan) -> np.ndarray:
    """Returns the volumes (n, z, y, x) of a result at the times of views (n,)."""
    volume = Volume(result.volume, result.grid, deformation=result.deformation, states=result.states)
    return np.stack([volume.at(time_s) for time_s in scan.frame_start_s[views].tolist()])


def scores(volumes: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    rows = [compare(np.ascontiguousarray(one), state) for one, state in zip(volumes, truth, strict=True)]
    averages = {f"mean_{name}": float(np.mean([row[name] for row in rows])) for name in METRICS}
    return {**averages, "least_psnr_db": min(row["psnr_db"] for row in rows)}


def run(rt: Runtime, python: str, size: int, views: int, folder: Path) -> Iterator[dict[str, object]]:
    peer = run_peer(python, size, views, folder / "peer.npz")
    truth, facts = in_our_axes(peer["truth"]), {"case": "rack and pinion", "size": size, "views": views}
    for name, label in (("fbp", "FBP of each window"), ("mace4d", f"MACE4D, mbirtorch {peer['version']}")):
        volumes, seconds = in_our_axes(peer[name]), round(float(peer[f"{name}_seconds"]), 1)
        yield {**facts, "program": label, **scores(volumes, truth), "seconds": seconds}
    poses = ParallelGeometry((size, size), (1.0, 1.0)).pose(peer["angles"])
    scan = Scan.from_poses(peer["frames"], poses, Grid.cube(size, float(size)), is_parallel=True)
    for method in ("fista", "moving", "changing"):
        started = time.process_time()
        result = reconstruct(scan, plan_of(method), rt)
        seconds = round(time.process_time() - started, 1)
        states = states_of(result, peer["middles"], scan)
        yield {**facts, "program": f"`{method}`", **scores(states, truth), "seconds": seconds, "device": rt.device.name}


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--peer-python", required=True)
    parser.add_argument("--size", type=int, default=32)
    parser.add_argument("--views", type=int, default=120)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for line in run(Runtime(arguments.device), arguments.peer_python, arguments.size, arguments.views, Path(name)):
            append(arguments.results, line)


if __name__ == "__main__":
    main()
