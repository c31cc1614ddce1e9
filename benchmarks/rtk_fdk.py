"""Compares FDK with RTK's on the same projections: difference, quality, and the ratio of speeds.

    python -m venv PEER && PEER/bin/pip install itk-rtk numpy
    python benchmarks/rtk_fdk.py --peer-python PEER/bin/python [--json docs/results/rtk_fdk.json] [--device D]

The set-up is that of RTK's own tests: Shepp-Logan by Kak and Slaney's table, scaled by 116 mm,
with its contrasts in 1/mm. The source is 600 mm from the axis and 1200 mm from the detector, with 128 x 128 pixels of 4 mm
and 128^3 voxels of 2 mm. PSNR has the range 2, against the phantom at the voxels' centres. It counts the voxels that every
view sees (displaced: that some view of every opposite pair sees)."""

import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measuring import finish, parser_of

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.splats.layout import projection_matrices
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.reconstructors.fdk import fdk_volume
from phyradgs_cl.runtime import Runtime

PIXELS, PIXEL_MM = 128, 4.0
GRID = Grid.cube(128, 256.0)
DSO_MM, DSD_MM = 600.0, 1200.0
PHANTOM = shepp_logan(116.0, "kak-slaney", 1.0)


@dataclass(frozen=True)
class Case:
    """One comparison. Offsets are in mm along u and v."""

    name: str
    views: int
    arc_deg: float = 360.0
    detector_offset_mm: float = 0.0
    source_offset_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def angles_rad(self) -> np.ndarray:
        return np.deg2rad(self.arc_deg) * np.arange(self.views) / self.views

    def pose(self) -> np.ndarray:
        """Returns poses (F, 12). An offset moves the source along the detector's own axes; the detector stays."""
        shape, pitch = (PIXELS, PIXELS), (PIXEL_MM, PIXEL_MM)
        pose = ConeGeometry(DSO_MM, DSD_MM, shape, pitch, (0.0, self.detector_offset_mm)).pose(
            self.angles_rad
        )
        along_u, along_v = self.source_offset_mm
        pose[:, 0:3] += (along_u * pose[:, 6:9] + along_v * pose[:, 9:12]) / PIXEL_MM
        return pose

    def task(self, frames: np.ndarray, repeats: int) -> dict[str, Any]:
        """Returns what benchmarks/rtk_peer.py reads. RTK's (X, Y, Z) are (y, z, x) here; angles and stack are the same."""
        return {
            "projections": frames,
            "gantry_deg": np.rad2deg(self.angles_rad),
            "sid_mm": DSO_MM,
            "sdd_mm": DSD_MM,
            "pixel_mm": PIXEL_MM,
            "projection_offset_mm": (self.detector_offset_mm, 0.0),
            "source_offset_mm": self.source_offset_mm,
            "voxels": GRID.shape[0],
            "spacing_mm": GRID.voxel_size_mm[0],
            "displaced": self.detector_offset_mm != 0,
            "short": self.arc_deg < 360,
            "repeats": repeats,
        }


CASES = (
    Case("full turn", 90),
    Case("source offset 20 and 15 mm", 180, source_offset_mm=(20.0, 15.0)),
    Case("short scan of 240 degrees", 110, arc_deg=240.0),
    Case("detector displaced by 120 mm", 180, detector_offset_mm=120.0),
)


def projections(pose: np.ndarray) -> np.ndarray:
    """Returns closed-form line integrals (F, rows, columns)."""
    targets = (pixel_centres(one, (PIXELS, PIXELS)) for one in pose)
    frames = [PHANTOM.line_integrals(one[:3], target) for one, target in zip(pose, targets, strict=True)]
    return np.stack(frames).astype(np.float32)


def field_of_view(case: Case, pose: np.ndarray) -> np.ndarray:
    """Returns the voxels (z, y, x) whose rays are measured: by every view; for a displaced detector by one of a pair."""
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij", sparse=True)
    seen = np.ones(GRID.shape, bool)
    for m in projection_matrices(pose[:: max(1, len(pose) // 36)]):
        depth = m[8] * x + m[9] * y + m[10] * z + m[11]
        u, v = ((m[r] * x + m[r + 1] * y + m[r + 2] * z + m[r + 3]) / depth for r in (0, 4))
        seen &= (v >= 0) & (v <= PIXELS - 1)
        if case.detector_offset_mm == 0:
            seen &= (u >= 0) & (u <= PIXELS - 1)
    reach_mm = (PIXELS - 1) / 2 * PIXEL_MM + abs(case.detector_offset_mm)
    return seen & (np.hypot(x, y) <= DSO_MM * np.sin(np.arctan(reach_mm / DSD_MM)))


def run_peer(python: str, task: dict[str, Any]) -> tuple[np.ndarray, list[list[float]], str]:
    """Returns RTK's volume in this project's axes (z, y, x), its seconds and processor seconds, and its version."""
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder) / "task.npz", Path(folder) / "result.npz"
        np.savez(given, **task)
        script = Path(__file__).with_name("rtk_peer.py")
        subprocess.run([python, str(script), str(given), str(result)], check=True, stdout=subprocess.DEVNULL)
        with np.load(result) as found:
            volume = np.ascontiguousarray(found["volume"].transpose(1, 2, 0))
            return volume, found["seconds"].tolist(), str(found["version"])


def decibels(volume: np.ndarray, truth: np.ndarray, seen: np.ndarray) -> float:
    """Returns the PSNR of range 2 over the voxels seen."""
    return float(10 * np.log10(4.0 / np.mean((volume[seen] - truth[seen]) ** 2)))


def compare(rt: Runtime, python: str, case: Case) -> dict[str, Any]:
    pose = case.pose()
    frames = projections(pose)
    ours = fdk_volume(rt, frames, pose, GRID).astype(np.float64)
    theirs, _, version = run_peer(python, case.task(frames, 1))
    seen, truth = field_of_view(case, pose), PHANTOM.density(*np.meshgrid(*GRID.axes_mm(), indexing="ij")[::-1])
    difference = np.linalg.norm(ours[seen] - theirs[seen]) / np.linalg.norm(theirs[seen].astype(np.float64))
    return {
        "case": case.name,
        "views": case.views,
        "relative_rms": float(difference),
        "psnr_db": decibels(ours, truth, seen),
        "rtk_psnr_db": decibels(theirs, truth, seen),
        "rtk_version": version,
    }


def speed(rt: Runtime, python: str, rounds: int) -> dict[str, Any]:
    """Returns the best seconds of alternating runs, both from arrays in memory to an array in memory, and processor time.

    Processor time (of all cores) says more where other programs run at the same time."""
    case = CASES[0]
    pose = case.pose()
    frames = projections(pose)
    fdk_volume(rt, frames, pose, GRID)  # this builds the kernels
    ours: list[list[float]] = []
    theirs: list[list[float]] = []
    for _ in range(rounds):
        for _ in range(6):
            started, processor = time.perf_counter(), time.process_time()
            fdk_volume(rt, frames, pose, GRID)
            ours.append([time.perf_counter() - started, time.process_time() - processor])
        theirs += run_peer(python, case.task(frames, 3))[1]
    (seconds, processor_seconds), (rtk_seconds, rtk_processor_seconds) = np.min(ours, 0), np.min(theirs, 0)
    return {
        "device": rt.device.name,
        "seconds": seconds,
        "rtk_seconds": rtk_seconds,
        "ratio": rtk_seconds / seconds,
        "processor_seconds": processor_seconds,
        "rtk_processor_seconds": rtk_processor_seconds,
        "processor_ratio": rtk_processor_seconds / processor_seconds,
    }


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--peer-python", required=True, help="a Python that has itk-rtk")
    parser.add_argument("--rounds", type=int, default=4, help="alternations of the speed comparison")
    options = parser.parse_args()
    rt = Runtime(options.device)
    rows = [compare(rt, options.peer_python, case) for case in CASES]
    times = speed(rt, options.peer_python, options.rounds)
    finish({"cases": rows, "speed": times}, options.json)


if __name__ == "__main__":
    main()
