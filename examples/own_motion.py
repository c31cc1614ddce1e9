"""A user-defined motion model, for an unknown readout time, and a user-defined trajectory, for a gantry that sags."""

from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.api import OwnTimes, Scan, TimeCells, compare, load_scan, reconstruct, save_scan, simulate


@dataclass(frozen=True)
class ReadoutOf:
    """Gives every line its own times, for a readout of ``ratio`` exposures in place of the scan's."""

    ratio: float

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        shutter = replace(scan.shutter, readout_s=self.ratio * scan.shutter.exposure_s)
        return OwnTimes(3).cells(replace(scan, shutter=shutter), frame)


@dataclass(frozen=True)
class Sagging:
    """A trajectory whose source and panel sink by up to ``sag_mm`` as they turn; poses are (..., 12) in mm."""

    level: object  # anything with pose(frame, time_s)
    sag_mm: float

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        pose = self.level.pose(frame, time_s).copy()
        source_y = pose[..., 1:2] / np.linalg.norm(pose[..., :2], axis=-1, keepdims=True)
        pose[..., [2, 5]] -= self.sag_mm * (1 + source_y) / 2  # z of the source, and of pixel (0, 0)
        return pose


# Which readout time explains the frames? This panel is read from the left, in 0.86 of an exposure. Noise ends no run.
true = simulate("jaw", size=24, detector=32, views=60, turns=7, exposure_deg=30.0, first="left")
residual = {}
for ratio in (0.0, 0.43, 0.86, 1.29):
    result = reconstruct(true, "cgls", iterations=20, noise_stop=0.0, motion=ReadoutOf(ratio), report=False)
    residual[ratio] = result.record[-1]["residual"]
    print(f"residual {residual[ratio]:.5f} with {result.facts['options']['motion']}")
print("readout takes", min(residual, key=residual.__getitem__), "of an exposure")

# The same frames with a trajectory that sags: the volume shows how much such an error costs.
sagging = replace(true, trajectory=Sagging(true.trajectory, sag_mm=0.2))
for name, scan in {"level": true, "sagging": sagging}.items():
    result = reconstruct(scan, "cgls", iterations=10, motion="per-row", report=False)
    print(f"{name}: {compare(result.volume, true.reference)['psnr_db']:.2f} dB")

save_scan("sagging.h5", sagging)  # as a table of poses that follows it to a ten-thousandth of a pixel
print(load_scan("sagging.h5").trajectory)
