"""Compares moving FDK with RTK's: on RTK's own test, from its files, and by warped backprojection with the same field.

    python -m venv PEER && PEER/bin/pip install itk-rtk numpy
    python benchmarks/rtk_moving.py --peer-python PEER/bin/python RESULTS.jsonl [--device D]

own test: the scan is imported from RTK's geometry file and stack. A field file says how the inner sphere moves, and the
command line reconstructs. Results are mean absolute error and PSNR (range 2) against the spheres in the middle. RTK's limits
are 0.05 and 22 dB. PSNR within 20 mm of the middle is given too, because FDK's error elsewhere hides the motion.

same field: both programs take a smooth random displacement at both ends of the cycle. Results are the largest difference of
the volumes over their peak, and processor seconds of the best of three runs of the whole FDK."""

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scans import append, results_parser
from scipy.ndimage import zoom

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import read_volume, write_deformation, write_scan
from phyradgs_cl.operators.warp.backproject import MovingBackprojector
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.phantoms.ellipsoids import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import fdk_volume
from phyradgs_cl.runtime import Runtime

FRAMES, VOXEL_MM = 128, 2.0  # as in rtk_moving_peer.py
GRID = Grid((32, 64, 64), (VOXEL_MM,) * 3)  # z, y, x are RTK's Y, X, Z
NEAR_MM = 20.0  # from the middle, where the inner sphere moves
PHASE = np.abs((4 + np.arange(FRAMES)) % 8 - 4) / 4  # 0 where the sphere is at -8 mm, 1 at 8 mm


def run_peer(python: str, folder: Path, field: np.ndarray, spacing_mm: float, repeats: int) -> tuple[np.ndarray, float]:
    """Returns RTK's volume in this project's axes, and its least processor seconds. field: (2, Z, Y, X, 3) in RTK's axes."""
    np.savez(folder / "task.npz", field=field, spacing_mm=spacing_mm, repeats=repeats)
    script = Path(__file__).with_name("rtk_moving_peer.py")
    words = [python, str(script), str(folder), str(folder / "task.npz"), str(folder / "result.npz")]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    with np.load(folder / "result.npz") as result:
        return np.ascontiguousarray(result["volume"].transpose(1, 2, 0)), float(result["seconds"][:, 1].min())


def figures(volume: np.ndarray) -> dict[str, float]:
    spheres = [Ellipsoid((0.0, 0.0, 0.0), (r, r, r), mu) for r, mu in ((60.0, 2.0), (8.0, -1.0))]
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    error = volume - EllipsoidPhantom(tuple(spheres), "spheres").density(x, y, z)
    near = x**2 + y**2 + z**2 < NEAR_MM**2
    psnr_db, near_db = (float(10 * np.log10(4 / np.mean(part**2))) for part in (error, error[near]))
    return {"mean_error": float(np.abs(error).mean()), "psnr_db": psnr_db, "near_psnr_db": near_db}


def imported(folder: Path) -> Scan:
    scan = import_scan(folder / "geometry.xml", ImportOptions())
    return replace(scan, grid=GRID)


def own_test(python: str, folder: Path) -> list[dict[str, object]]:
    """Runs RTK's own test. RTK's field is 8 mm within 31.5 mm and 0 outside; ours falls smoothly to 0 there."""
    field = np.zeros((2, 64, 64, 64, 3), np.float32)
    field[..., 0] = np.array([-8.0, 8.0])[:, None, None, None]
    theirs, _ = run_peer(python, folder, field, 1.0, 1)
    scan = imported(folder)
    control_mm = np.zeros((1, 7, 7, 7, 3))
    control_mm[..., 1] = -1.0  # matter shifted by s along y has the attenuation of the reference at y - s
    times_s = scan.frame_start_s + scan.shutter.middle_s
    one = Deformation(control_mm, (-24.0,) * 3, 8.0, times_s, (16 * PHASE - 8)[:, None])
    write_scan(folder / "scan.h5", scan)
    write_deformation(folder / "field.h5", one)
    for name, words in (("volume.h5", ("--object-motion", "field.h5")), ("rest.h5", ())):
        command = ["reconstruct", "scan.h5", "-o", name, "--method", "fdk", *words]
        subprocess.run([sys.executable, "-m", "phyradgs_cl", *command], check=True, cwd=folder, stdout=subprocess.DEVNULL)
    volumes = {
        "RTK": theirs, "phyradgs": read_volume(folder / "volume.h5").values,
        "phyradgs, motion ignored": read_volume(folder / "rest.h5").values,
    }
    return [{"case": "own test", "program": name, **figures(volume)} for name, volume in volumes.items()]


def same_field(rt: Runtime, python: str, folder: Path) -> dict[str, object]:
    """Compares both on one field. Both blend a view's displacement from those at the two ends of the cycle."""
    coarse = np.random.default_rng(0).normal(scale=4.0, size=(2, 5, 5, 5, 3))
    push_mm = np.stack([zoom(end, [n / 5 for n in GRID.shape] + [1], order=3) for end in coarse])  # z, y, x; x, y, z
    theirs, their_seconds = run_peer(python, folder, push_mm.transpose(0, 3, 1, 2, 4)[..., [1, 2, 0]], VOXEL_MM, 3)
    scan = imported(folder)
    at_rest = Deformation(np.zeros((1, 4, 4, 4, 3)), (0.0,) * 3, 8.0, np.zeros(1), np.zeros((1, 1)))
    moving = MovingBackprojector(rt, MotionStates.of_times(at_rest, GRID, np.zeros(1)), np.stack([1 - PHASE, PHASE], -1))
    ends = [rt.upload(np.pad(np.moveaxis(end, -1, 0).ravel() / VOXEL_MM, (0, 16)), np.float32) for end in push_mm]
    moving._push = ends.__getitem__  # type: ignore[method-assign, assignment]
    pose = np.concatenate([scan.trajectory.pose(f, scan.frame_start_s[f : f + 1]) for f in range(scan.frames)])
    seconds = []
    for _ in range(4):  # the first run builds kernels
        started = time.process_time()
        ours = fdk_volume(rt, scan.projections, pose, GRID, moving=moving)
        seconds.append(time.process_time() - started)
    reach = np.ceil(np.abs(push_mm).max((0, 1, 2, 3))[::-1] / VOXEL_MM).astype(int)
    inner = tuple(slice(n, -n) for n in reach)  # RTK leaves out views in which a voxel's matter is outside of the volume
    off = np.abs(ours - theirs)[inner]
    return {
        "case": "same field", "largest_difference": float(off.max() / np.abs(theirs).max()),
        "mean_difference": float(off.mean() / np.abs(theirs).max()), "seconds": min(seconds), "rtk_seconds": their_seconds,
        "device": rt.device.name,
    }


def main() -> None:
    parser = results_parser(__doc__)
    parser.add_argument("--peer-python", required=True)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for line in own_test(arguments.peer_python, Path(name)):
            append(arguments.results, line)
        append(arguments.results, same_field(Runtime(arguments.device), arguments.peer_python, Path(name)))


if __name__ == "__main__":
    main()
