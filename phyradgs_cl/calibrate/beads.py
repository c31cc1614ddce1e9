"""Compares frames with a phantom of known shape: its placement, its density and a background replace the volume."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import OwnTimes, Scan
from phyradgs_cl.acquisition.altered.angles import exposure_arc_rad
from phyradgs_cl.acquisition.altered.coarse import MOST_FRAMES, binned, fewer_frames
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, perturb
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.calibrate.problem import CoarseFrames, measured_blocks, without_pixels
from phyradgs_cl.calibrate.shadows import DENSITY, BeadOperator
from phyradgs_cl.calibrate.stages import Stage
from phyradgs_cl.phantoms import EllipsoidPhantom

_FEWEST_TIMES, _MOST_TIMES = 6, 24  # times per exposure; the phantom's edge moves by a pixel between two of them
_FEWEST_RAYS, _MOST_RAYS = 2, 6  # rays along each side of a pixel or a block, and per bead's radius
_BLUR_PX = 0.8  # with less blur, differences of sharp edges would show single rays, which are half a pixel apart
_LEAST_ZEROS, _ZEROS_PX = 0.2, 5  # fraction of zeros from which air was clipped; side of the averaged blocks
_BACKGROUND = 4  # cosines along each side of a frame: they describe holder, scatter and drift of the tube
_STEP_PX = 0.25
_MOST_PX = 1.5  # largest movement of a frame by a step of the placement
_SETTLED_PX, _LINEAR_PX = 0.01, 0.3  # size of the last step; the largest step after which the signals are still valid


@dataclass(frozen=True, eq=False, kw_only=True)
class BeadProblem(CoarseFrames):
    """The problem of ``CoarseProblem`` for a known phantom. Its objects are placements (7,), of which ``start`` is a first
    guess."""

    phantom: EllipsoidPhantom
    start: np.ndarray
    clipped_noise: float

    @classmethod
    def of(
        cls, phantom: EllipsoidPhantom, start: np.ndarray, scans: Sequence[Scan], stage: Stage,
        most_frames: int = MOST_FRAMES,
    ) -> "BeadProblem":
        block = stage.block(scans[0])
        fewer = [fewer_frames(scan, most_frames) for scan in scans]
        measured, valid = measured_blocks([binned(scan, block) for scan in fewer])
        return cls(
            scans=[without_pixels(scan) for scan in fewer], block=block, measured=measured, valid=valid,
            phantom=phantom, start=start, clipped_noise=_clipped_noise(fewer),
        )

    def operator(self, correction: GeometryCorrection, views: Views | Sway | None = None) -> BeadOperator:
        tables: list[TimeCells] = []
        for scan in self.scans:
            small = binned(perturb(scan, correction, views), self.block)
            edge_px = max(scan.grid.size_mm[1:]) / 2 * scan.geometry.magnification / min(small.geometry.pixel_size_mm)
            times = int(np.clip(math.ceil(exposure_arc_rad(scan) * edge_px), _FEWEST_TIMES, _MOST_TIMES))
            spread = _with_spread_of(small, times)
            tables += [OwnTimes(times).cells(spread, frame) for frame in range(small.frames)]
        radius_mm = float(np.median([body.reach_mm for body in self.phantom.ellipsoids])) * small.geometry.magnification
        per_pixel = math.ceil(_FEWEST_RAYS * min(small.geometry.pixel_size_mm) / radius_mm)
        rays = int(np.clip(per_pixel, _FEWEST_RAYS, _MOST_RAYS))
        model = self.scans[0].detector_model
        return BeadOperator(self.phantom, tables, small.geometry.detector_shape, model, rays, self.clipped_noise)

    def residual(self, operator: BeadOperator, placement: np.ndarray) -> np.ndarray:
        """Returns measured less expected frames (F, rows, columns), without a smooth background."""
        return self._without_background(self.measured - operator.forward(placement))

    def noise(self, residual: np.ndarray) -> float:
        """Returns the standard deviation of a pixel, from noise and model errors."""
        return float(np.std(residual if self.valid is None else residual[self.valid]))

    def explained(self, operator: BeadOperator, placement: np.ndarray) -> float:
        """Returns the fraction of the compared values' squares that the phantom explains. A negative density explains 0."""
        residual = self.compared(self.residual(operator, placement))
        whole = self.compared(self.masked(self.measured))
        return float(1 - residual @ residual / max(float(whole @ whole), 1e-30)) if placement[DENSITY] > 0 else 0.0

    def reconstruct(self, operator: BeadOperator, start: np.ndarray | None, iterations: int) -> np.ndarray:
        """Returns the placement (7,) that fits best, by Gauss–Newton from ``start``."""
        placement = self.start if start is None else start
        inverse = None
        for _ in range(iterations):
            if inverse is None:
                inverse = np.linalg.pinv(self._signals(operator, placement))
            step = self.compared(self.residual(operator, placement)) @ inverse
            step *= min(1.0, _MOST_PX / max(np.abs(step[:DENSITY]).max(), 1e-30))
            placement = _moved(placement, step * self._units())
            self.count_pass()
            if np.abs(step).max() < _SETTLED_PX:
                break
            if np.abs(step).max() > _LINEAR_PX:
                inverse = None
        return placement

    def beyond_object(
        self, operator: BeadOperator, placement: np.ndarray, images: Sequence[np.ndarray], iterations: int
    ) -> list[np.ndarray]:
        """Returns the part of each image (F, rows, columns) that no other placement or density explains."""
        basis, _ = np.linalg.qr(self._signals(operator, placement).T)
        compared = np.array([self.compared(image) for image in images])
        beyond = compared - compared @ basis @ basis.T
        return list(beyond.reshape(len(images), *self.measured.shape))

    def compared(self, frames: np.ndarray) -> np.ndarray:
        """Returns the values that enter the misfit (F · pixels), float64: without background, blurred over single rays."""
        blurred = gaussian_filter(self._without_background(frames), (0, _BLUR_PX, _BLUR_PX), output=np.float64)
        return blurred.ravel()

    def _units(self) -> np.ndarray:
        """Returns the amount of each number (7,) that moves a frame by a pixel at its edge, or changes the density by the
        known one."""
        scan = self.scans[0]
        pixel_mm = self.block * min(scan.geometry.pixel_size_mm) / scan.geometry.magnification
        return np.array([pixel_mm / (max(scan.grid.size_mm) / 2)] * 3 + [pixel_mm] * 3 + [1.0])

    def _signals(self, operator: BeadOperator, placement: np.ndarray) -> np.ndarray:
        """Returns the change of the compared values (7, F · pixels) per unit of each number."""
        signals = []
        for number, unit in enumerate(self._units()):
            step = np.eye(DENSITY + 1)[number] * _STEP_PX * unit
            ends = [operator.forward(_moved(placement, sign * step)) for sign in (1, -1)]
            signals.append(self.compared((ends[0] - ends[1]) / np.float32(2 * _STEP_PX)))
        return np.array(signals)

    def _without_background(self, frames: np.ndarray) -> np.ndarray:
        """Returns frames less the background, which is their fit by a few cosines along each side."""
        rows, columns = (_cosines(count) for count in frames.shape[1:])
        if self.valid is None:
            inner = np.einsum("vi,fvu,uj->fij", rows, frames, columns)
            return (frames - np.einsum("vi,fij,uj->fvu", rows, inner, columns)).astype(np.float32)
        rest = np.zeros(frames.shape, np.float32)
        cosines = np.einsum("vi,uj->vuij", rows, columns).reshape(-1, _BACKGROUND**2)
        for into, frame, valid in zip(rest, frames, self.valid, strict=True):
            usable = cosines[valid.ravel()]
            into[valid] = frame[valid] - usable @ np.linalg.lstsq(usable, frame[valid], rcond=None)[0]
        return rest


def _clipped_noise(scans: Sequence[Scan]) -> float:
    """Returns the standard deviation of the noise about air where it was clipped at 0, from means of small blocks.

    Returns 0 where few pixels are 0."""
    values = np.concatenate([np.asarray(scan.projections, np.float32) for scan in scans])
    valid = np.concatenate([scan.valid for scan in scans])
    if np.mean(values[valid] == 0) < _LEAST_ZEROS or values[valid].min() < 0:
        return 0.0
    means = uniform_filter(np.where(valid, values, 0), (0, _ZEROS_PX, _ZEROS_PX)) * math.sqrt(2 * math.pi)
    return float(np.median(means[valid]))


def _with_spread_of(scan: Scan, times: int) -> Scan:
    """Returns the scan with longer exposures about the same middle, so that ``times`` moments have the standard deviation of
    the whole exposure. Otherwise few moments would look like a shorter exposure. Pulses stay unchanged."""
    if scan.shutter.pulse_s is not None:
        return scan
    exposure_s = scan.shutter.exposure_s / math.sqrt(1 - times**-2)
    early_s = (exposure_s - scan.shutter.exposure_s) / 2
    shutter = replace(scan.shutter, exposure_s=exposure_s)
    return replace(scan, shutter=shutter, frame_start_s=np.asarray(scan.frame_start_s) - early_s)


def _moved(placement: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Returns the placement (7,) after a further turn about the world's axes, a shift, and a change of density."""
    turn = Rotation.from_rotvec(step[:3])
    turned = (turn * Rotation.from_rotvec(placement[:3])).as_rotvec()
    return np.concatenate([turned, turn.apply(placement[3:DENSITY]) + step[3:DENSITY], placement[DENSITY:] + step[DENSITY:]])


def _cosines(count: int) -> np.ndarray:
    """Returns the slowest cosines (count, n) along a side, which are orthonormal."""
    order = np.arange(min(_BACKGROUND, count))
    waves = np.cos(np.pi * order * (np.arange(count)[:, None] + 0.5) / count)
    return waves / np.linalg.norm(waves, axis=0)
