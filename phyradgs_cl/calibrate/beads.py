"""Calibrates with a phantom of known shape. The phantom's placement and density, and a smooth background of the frames,
are the unknowns in place of a volume.

``BeadOperator`` computes the expected frames in closed form, with each line at its own times."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import OwnTimes, Scan
from phyradgs_cl.acquisition.altered.angles import exposure_arc_rad
from phyradgs_cl.acquisition.altered.coarse import MOST_FRAMES, binned, fewer_frames
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, perturb
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.calibrate.problem import CoarseFrames, Stage, frames_of
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR
from phyradgs_cl.phantoms import EllipsoidPhantom

DENSITY = 6  # a placement (7,) is a turn (rotation vector, rad), a shift (mm) and, at this index, a factor of the density
_MARGIN = 1.2  # the region searched for a bead's shadow is wider by this factor: perspective widens shadows
# Fewest and most times of an exposure. Within these limits the grid's edge moves by at most a pixel between two times.
_FEWEST_TIMES, _MOST_TIMES = 6, 24
_FEWEST_RAYS = 2  # fewest rays along each side of a pixel, and along a bead's radius: sharp edges need several
_MOST_RAYS = 6  # rays along each side of a pixel, at most: the time grows with their square
# Standard deviation, in pixels, of the blur of compared frames. Rays are up to half a pixel apart: without blur, differences
# of sharp edges would show single rays.
_BLUR_PX = 0.8
_LEAST_ZEROS = 0.2  # if at least this fraction of the pixels is 0, the noise of air was clipped at 0
_ZEROS_PX = 5  # side, in pixels, of the squares whose means show the noise of clipped air
_BACKGROUND = 4  # number of cosines along each side of a frame, which describe holder, scatter and drift of the tube
_STEP_PX = 0.25  # a central difference moves the frame's edge by this many pixels to each side
_MOST_PX = 1.5  # most pixels by which a step of the placement moves a frame's edge: beyond them the effect is not linear
_SETTLED_PX = 0.01  # the search for the placement ends when a step moves the frame's edge by fewer pixels
_LINEAR_PX = 0.3  # derivatives are computed again after a step that moves the frame's edge by more pixels


@dataclass(frozen=True, eq=False)
class BeadOperator:
    """Computes the frames (F, rows, columns) of a phantom. tables: the time cells of each frame, one table per frame.

    shape: the panel's (rows, columns). model: what the detector averages, "log" (line integrals) or "intensity". samples:
    rays along each side of a pixel. clipped_noise: standard deviation of noise that was clipped at 0; 0 without clipping."""

    phantom: EllipsoidPhantom
    tables: Sequence[TimeCells]
    shape: tuple[int, int]
    model: str
    samples: int
    clipped_noise: float

    def forward(self, placement: np.ndarray) -> np.ndarray:
        """Returns the phantom's frames at a placement (7,): turn (rotation vector, rad), shift (mm), and density factor."""
        # a table has one pose for all lines, or S poses for each line, one line after the other
        lengths = [table.line_stop - table.line_start for table in self.tables]
        tables = list(zip(self.tables, lengths, strict=True))
        readout = self.tables[0].readout
        pose = np.concatenate([np.repeat(readout.poses(table.pose), length, axis=0) for table, length in tables])
        pose = pose.reshape(-1, 4, 3)
        weight = np.stack([np.repeat(table.weight, length).reshape(table.lines, -1) for table, length in tables])
        frames, lines, samples = weight.shape
        turn = Rotation.from_rotvec(placement[:3]).as_matrix()
        places, steps = pose[:, :2] - placement[3:DENSITY], pose[:, 2:]
        if self.tables[0].is_parallel:
            places[:, 0] = pose[:, 0]  # a shift of the phantom does not change the direction of parallel rays
        panel_lines = _PanelLines(
            source=places[:, 0] @ turn, first=places[:, 1] @ turn, line_step=steps[:, 1] @ turn,
            pixel_step=steps[:, 0] @ turn,
            line=np.tile(np.repeat(np.arange(lines), samples), frames),
            pixels=readout.shape(self.shape)[1],
            is_parallel=self.tables[0].is_parallel,
        )
        total = np.zeros((frames, lines, panel_lines.pixels))
        for p in panel_lines.integrals(self.phantom, self.samples):
            p = placement[DENSITY] * p.reshape(frames, lines, samples, -1)
            total += np.einsum("fls,flsp->flp", weight, p if self.model == "log" else np.exp(-p)) / self.samples**2
        expected = total if self.model == "log" else -np.log(np.maximum(total, TRANSMISSION_FLOOR))
        if self.clipped_noise > 0:
            expected = _mean_of_clipped(expected, self.clipped_noise)
        return np.ascontiguousarray(readout.frames(expected), np.float32)


def _mean_of_clipped(p: np.ndarray, sigma: float) -> np.ndarray:
    """Returns the mean of max(p + noise, 0) for normal noise of standard deviation ``sigma``; it exceeds p, most in air."""
    ratio = p / sigma
    return p * scipy.special.ndtr(ratio) + sigma * np.exp(-(ratio**2) / 2) / math.sqrt(2 * math.pi)


@dataclass(frozen=True, eq=False)
class _PanelLines:
    """N lines of a panel, each at one time, in the phantom's frame of reference.

    - source, first (N, 3): the source, and the centre of the panel's pixel (0, 0), in mm.
    - line_step, pixel_step (N, 3): steps in mm to the next line, and to a line's next pixel. line (N,): the lines' numbers.
    - pixels: the number of pixels of a line. is_parallel: ``source`` is the rays' direction."""

    source: np.ndarray
    first: np.ndarray
    line_step: np.ndarray
    pixel_step: np.ndarray
    line: np.ndarray
    pixels: int
    is_parallel: bool

    def integrals(self, phantom: EllipsoidPhantom, samples: int) -> Iterator[np.ndarray]:
        """Yields samples² arrays of line integrals (N, pixels), float32, each for rays to another point within a pixel."""
        shadows = [(body, *self._shadow(np.array(body.ends_mm), body.reach_mm)) for body in phantom.ellipsoids]
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        for across, along in itertools.product(offsets, offsets):
            total = np.zeros((len(self.line), self.pixels), np.float32)
            for body, lines, start, width in shadows:
                pixel = start[:, None] + np.arange(width)
                source = self.source[lines]
                first = self.first[lines] + (self.line[lines, None] + across) * self.line_step[lines]
                first = first if self.is_parallel else first - source
                ray = first[:, None] + (pixel[..., None] + along) * self.pixel_step[lines][:, None]
                starts, rays = np.repeat(source, width, axis=0), ray.reshape(-1, 3)
                if self.is_parallel:  # a parallel ray has no source: it starts and ends far outside of the body
                    reach = 2 * (np.abs(rays).max(initial=0.0) + np.abs(body.ends_mm).max() + body.reach_mm)
                    starts, rays = rays - reach * starts, 2 * reach * starts
                fraction = body.chord_fraction(starts, rays)
                value = body.attenuation_per_mm * fraction * np.sqrt(np.einsum("ij,ij->i", rays, rays))
                total[lines[:, None], pixel] += value.reshape(pixel.shape)
            yield total

    @cached_property
    def _parts(self) -> np.ndarray:
        """Matrices (N, 3, 3) that resolve vectors into parts along line_step, pixel_step and the ray to the first pixel."""
        ray = self.source if self.is_parallel else self.first - self.source
        return np.linalg.inv(np.stack([self.line_step, self.pixel_step, ray], -1))

    def _shadow(self, ends_mm: np.ndarray, reach_mm: float) -> tuple[np.ndarray, np.ndarray, int]:
        """Returns the indices (n,) of lines that may see a body, the first pixel (n,) of its shadow on each, and the widest
        shadow's width in pixels. The body lies within ``reach_mm`` of the segment between its ``ends_mm`` (2, 3)."""
        lowest, highest = [], []
        for end_mm in ends_mm:
            parts = np.einsum("nij,nj->ni", self._parts, end_mm - (self.first if self.is_parallel else self.source))
            place, slopes = parts[:, :2], self._parts[:, :2]  # line and pixel of the end's image, and their gradients per mm
            if not self.is_parallel:
                place = place / parts[:, 2:]
                slopes = (slopes - place[..., None] * self._parts[:, 2:]) / parts[:, 2:, None]
            reach = _MARGIN * reach_mm * np.linalg.norm(slopes, axis=-1) + 1
            lowest.append(place - reach)
            highest.append(place + reach)
        (line_from, pixel_from), (line_to, pixel_to) = np.min(lowest, axis=0).T, np.max(highest, axis=0).T
        lines = np.flatnonzero(
            (self.line >= line_from) & (self.line <= line_to) & (pixel_to >= 0) & (pixel_from <= self.pixels - 1)
        )
        first, last = (
            np.clip(ends[lines], 0, self.pixels - 1).astype(int) for ends in (np.floor(pixel_from), np.ceil(pixel_to))
        )
        width = int((last - first).max(initial=0)) + 1
        return lines, np.minimum(first, self.pixels - width), width


@dataclass(frozen=True, eq=False, kw_only=True)
class BeadProblem(CoarseFrames):
    """The counterpart of ``CoarseProblem`` for a known phantom, whose placement (7,) replaces the volume.

    start: the first placement of the search. clipped_noise: as in ``BeadOperator``."""

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
        fields = frames_of(fewer, [binned(scan, block) for scan in fewer], block)
        return cls(phantom=phantom, start=start, clipped_noise=_clipped_noise(fewer), **fields)

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
        """Returns measured minus expected frames (F, rows, columns), without a smooth background."""
        return self._without_background(self.measured - operator.forward(placement))

    def noise(self, residual: np.ndarray) -> float:
        """Returns the standard deviation of the valid pixels of ``residual``: of noise and errors of the model together."""
        return float(np.std(residual if self.valid is None else residual[self.valid]))

    def explained(self, operator: BeadOperator, placement: np.ndarray) -> float:
        """Returns 1 − Σ (``compared`` residual)² / Σ (``compared`` measurement)², the fraction that the phantom explains; 0
        unless the placement's density factor is above 0."""
        residual = self.compared(self.residual(operator, placement))
        whole = self.compared(self.measured)
        return float(1 - residual @ residual / max(float(whole @ whole), 1e-30)) if placement[DENSITY] > 0 else 0.0

    def reconstruct(self, operator: BeadOperator, start: np.ndarray | None, iterations: int) -> np.ndarray:
        """Returns the placement (7,) that fits best, by at most ``iterations`` Gauss–Newton steps from ``start``; None
        starts from the placement ``self.start``."""
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
        """Returns the ``compared`` part of each image (F, rows, columns) that no change of the placement explains: the part
        outside of the Jacobian's range at ``placement``. ``iterations`` has no effect."""
        basis, _ = np.linalg.qr(self._signals(operator, placement).T)
        compared = np.array([self.compared(image) for image in images])
        beyond = compared - compared @ basis @ basis.T
        return list(beyond.reshape(len(images), *self.measured.shape))

    def compared(self, frames: np.ndarray) -> np.ndarray:
        """Returns the values (F · pixels,) float64 by which frames are compared: the frames without background, and blurred
        to hide single rays."""
        blurred = gaussian_filter(self._without_background(frames), (0, _BLUR_PX, _BLUR_PX), output=np.float64)
        return blurred.ravel()

    def _units(self) -> np.ndarray:
        """Returns the unit (7,) of each number of a placement: turns (rad) and shifts (mm) that move the image's edge by one
        coarse pixel or so, and 1 for the density factor."""
        scan = self.scans[0]
        pixel_mm = self.block * min(scan.geometry.pixel_size_mm) / scan.geometry.magnification
        return np.array([pixel_mm / (max(scan.grid.size_mm) / 2)] * 3 + [pixel_mm] * 3 + [1.0])

    def _signals(self, operator: BeadOperator, placement: np.ndarray) -> np.ndarray:
        """Returns the transposed Jacobian (7, F · pixels), d(compared)/d(placement / ``_units``), by central differences."""
        signals = []
        for number, unit in enumerate(self._units()):
            step = np.eye(DENSITY + 1)[number] * _STEP_PX * unit
            ends = [operator.forward(_moved(placement, sign * step)) for sign in (1, -1)]
            signals.append(self.compared((ends[0] - ends[1]) / np.float32(2 * _STEP_PX)))
        return np.array(signals)

    def _without_background(self, frames: np.ndarray) -> np.ndarray:
        """Subtracts from frames (F, rows, columns) their fit by a few slow cosines along each side; 0 at invalid pixels."""
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
    """Returns the standard deviation of the noise of air if its values below 0 were set to 0, from means over small squares.
    Returns 0 if nothing was clipped: if less than a fifth of the pixels are 0, or any is below 0."""
    values = np.concatenate([np.asarray(scan.projections, np.float32) for scan in scans])
    valid = np.concatenate([scan.valid for scan in scans])
    if np.mean(values[valid] == 0) < _LEAST_ZEROS or values[valid].min() < 0:
        return 0.0
    means = uniform_filter(np.where(valid, values, 0), (0, _ZEROS_PX, _ZEROS_PX)) * math.sqrt(2 * math.pi)
    return float(np.median(means[valid]))


def _with_spread_of(scan: Scan, times: int) -> Scan:
    """Returns the scan with longer exposures about the same middle: the ``times`` moments at which a line is computed then
    have the standard deviation of its stated exposure. Otherwise few moments would look like a shorter exposure. A pulsed
    scan stays unchanged."""
    if scan.shutter.pulse_s is not None:
        return scan
    exposure_s = scan.shutter.exposure_s / math.sqrt(1 - times**-2)
    early_s = (exposure_s - scan.shutter.exposure_s) / 2
    shutter = replace(scan.shutter, exposure_s=exposure_s)
    return replace(scan, shutter=shutter, frame_start_s=np.asarray(scan.frame_start_s) - early_s)


def _moved(placement: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Returns the placement (7,) after a ``step`` (7,): turned about the origin, then shifted, with the step's last number
    added to the density factor."""
    turn = Rotation.from_rotvec(step[:3])
    turned = (turn * Rotation.from_rotvec(placement[:3])).as_rotvec()
    return np.concatenate([turned, turn.apply(placement[3:DENSITY]) + step[3:DENSITY], placement[DENSITY:] + step[DENSITY:]])


def _cosines(count: int) -> np.ndarray:
    """Returns the n slowest cosines (count, n) along a side of ``count`` pixels, orthonormal; n is at most 4."""
    order = np.arange(min(_BACKGROUND, count))
    waves = np.cos(np.pi * order * (np.arange(count)[:, None] + 0.5) / count)
    return waves / np.linalg.norm(waves, axis=0)
