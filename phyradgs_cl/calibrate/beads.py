"""Frames of a phantom of known shape at one coarseness: what is left to find is how it lies, its density, a background."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import OwnTimes, Scan
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.calibrate.level import MOST_FRAMES
from phyradgs_cl.calibrate.moved import Change, Sway, Views, moved
from phyradgs_cl.check.coarse import binned, fewer_frames
from phyradgs_cl.check.questions.timing import exposure_arc_rad
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR
from phyradgs_cl.phantoms import EllipsoidPhantom

_LEAST_SAMPLES, _MOST_SAMPLES = 6, 24  # of an exposure; the phantom's edge moves by a pixel between two
_PIXEL_SAMPLES, _MOST_PIXEL_SAMPLES = 2, 6  # rays along each side of a pixel, or a block, and along a bead's radius
_BLUR_PX = 0.8  # beyond it rays that are half a pixel apart show in the differences of sharp edges
_SLACK = 1.2  # of a bead's shadow, beside its size over the panel's pitch
_LEAST_ZEROS, _BLOCK = 0.2, 5  # of all pixels, where noise about air was cut off at 0; pixels along a side
_BACKGROUND = 4  # cosines along each side of a frame that tell no bead: a holder, scatter, drift of the tube
_STEP_PX = 0.25
_MOST_PX = 1.5  # that a step of the placement moves a frame by
_SETTLED_PX, _STRAIGHT_PX = 0.01, 0.3  # a step that is the last; one up to which signals are straight lines
DENSITY = 6  # of a placement's numbers, the last


@dataclass(frozen=True, eq=False)
class BeadOperator:
    """Frames (F, rows, columns) of a phantom where ``tables`` say that its lines look, ``model`` being the detector's.
    ``samples``: rays along each side of a pixel. ``cut``: standard deviation of noise of which the part below 0 was cut off,
    0 where none was."""

    phantom: EllipsoidPhantom
    tables: Sequence[TimeCells]
    shape: tuple[int, int]
    model: str
    samples: int
    cut: float

    def forward(self, placement: np.ndarray) -> np.ndarray:
        """Line integrals of the phantom turned (rotation vector, rad), shifted (mm) and of a density: seven numbers (7,)."""
        pose, weight = _by_line(self.tables)
        frames, lines, samples = weight.shape
        turn = Rotation.from_rotvec(placement[:3]).as_matrix()
        places, steps = pose[:, :2] - placement[3:DENSITY], pose[:, 2:]
        is_rows = self.tables[0].axis == "rows"
        seen = _Lines(
            source=places[:, 0] @ turn,
            first=places[:, 1] @ turn,
            line_step=steps[:, int(is_rows)] @ turn,
            pixel_step=steps[:, 1 - int(is_rows)] @ turn,
            line=np.tile(np.repeat(np.arange(lines), samples), frames),
            pixels=self.shape[1] if is_rows else self.shape[0],
        )
        total = np.zeros((frames, lines, seen.pixels))
        for p in seen.integrals(self.phantom, self.samples):
            p = placement[DENSITY] * p.reshape(frames, lines, samples, -1)
            total += np.einsum("fls,flsp->flp", weight, p if self.model == "log" else np.exp(-p)) / self.samples**2
        found = total if self.model == "log" else -np.log(np.maximum(total, TRANSMISSION_FLOOR))
        if self.cut > 0:  # the mean of what is left: faint ends of a shadow are raised less than air
            sure = found / self.cut
            found = found * scipy.special.ndtr(sure) + self.cut * np.exp(-(sure**2) / 2) / math.sqrt(2 * math.pi)
        return np.ascontiguousarray(found if is_rows else found.swapaxes(1, 2), np.float32)


def _by_line(tables: Sequence[TimeCells]) -> tuple[np.ndarray, np.ndarray]:
    """(poses (F · lines · S, 4, 3), weights (F, lines, S)) of every line of every frame, at as many times each."""
    poses, weights = [], []
    for table in tables:
        counts = table.line_stop - table.line_start
        cell = np.repeat(np.arange(table.count), counts)
        line = table.line_start[cell] + np.arange(cell.size) - np.repeat(np.cumsum(counts) - counts, counts)
        cell = cell[np.argsort(line, kind="stable")]
        poses.append(table.pose[cell].reshape(-1, 4, 3))
        weights.append(table.weight[cell].reshape(table.lines, -1))
    return np.concatenate(poses), np.stack(weights)


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines of a panel as the phantom sees them, each at one time: source and middle of the panel's first pixel (N, 3),
    steps to the next line and to the next pixel in it, mm; which ``line`` (N,) it is, of ``pixels`` each."""

    source: np.ndarray
    first: np.ndarray
    line_step: np.ndarray
    pixel_step: np.ndarray
    line: np.ndarray
    pixels: int

    def integrals(self, phantom: EllipsoidPhantom, samples: int) -> Iterator[np.ndarray]:
        """Line integrals (N, pixels), float32, of rays to samples² points of every pixel's area, one after the other."""
        shadows = [(body, *self._shadow(np.array(body.ends_mm), body.reach_mm)) for body in phantom.ellipsoids]
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        for across, along in itertools.product(offsets, offsets):
            total = np.zeros((len(self.line), self.pixels), np.float32)
            for body, chosen, start, width in shadows:
                pixel = start[:, None] + np.arange(width)
                source = self.source[chosen]
                first = self.first[chosen] + (self.line[chosen, None] + across) * self.line_step[chosen] - source
                step = first[:, None] + (pixel[..., None] + along) * self.pixel_step[chosen][:, None]
                flat = step.reshape(-1, 3)
                part = body.chord_fraction(np.repeat(source, width, axis=0), flat)
                value = body.attenuation_per_mm * part * np.sqrt(np.einsum("ij,ij->i", flat, flat))
                total[chosen[:, None], pixel] += value.reshape(pixel.shape)
            yield total

    @cached_property
    def _onto_panel(self) -> tuple[tuple[np.ndarray, ...], ...]:
        """Vectors (N, 3) that count distances from the source in the panel's own, lines and pixels, with what they give (N,)
        of the source and of the first pixel, and their lengths (N,)."""
        normal = np.cross(self.line_step, self.pixel_step)
        height = np.sum(normal * (self.first - self.source), -1, keepdims=True)
        vectors = [normal / height]
        vectors += [step / np.sum(step**2, -1, keepdims=True) for step in (self.line_step, self.pixel_step)]
        at = [[np.sum(vector * point, -1) for point in (self.source, self.first)] for vector in vectors]
        return tuple((v, *both, np.linalg.norm(v, axis=-1)) for v, both in zip(vectors, at, strict=True))

    def _shadow(self, ends_mm: np.ndarray, reach_mm: float) -> tuple[np.ndarray, np.ndarray, int]:
        """(which lines (n,) may see a body, from which pixel on (n,), how many pixels)."""
        (depth, depth_of_source, *_), *axes = self._onto_panel
        lowest, highest = [], []
        for end_mm in ends_mm:
            stretch = 1 / (depth @ end_mm - depth_of_source)
            for vector, of_source, of_first, per_mm in axes:
                at = of_source - of_first + stretch * (vector @ end_mm - of_source)
                reach = _SLACK * reach_mm * np.abs(stretch) * per_mm + 1
                lowest.append(at - reach)
                highest.append(at + reach)
        line_from, pixel_from = (np.minimum(lowest[k], lowest[k + 2]) for k in (0, 1))
        line_to, pixel_to = (np.maximum(highest[k], highest[k + 2]) for k in (0, 1))
        chosen = np.flatnonzero(
            (self.line >= line_from) & (self.line <= line_to) & (pixel_to >= 0) & (pixel_from <= self.pixels - 1)
        )
        first = np.clip(np.floor(pixel_from[chosen]), 0, self.pixels - 1).astype(int)
        last = np.clip(np.ceil(pixel_to[chosen]), 0, self.pixels - 1).astype(int)
        width = int((last - first).max(initial=0)) + 1
        return chosen, np.minimum(first, self.pixels - width), width


@dataclass(frozen=True, eq=False)
class BeadLevel:
    """As ``Level``, of a phantom that lies about as ``start`` (7,) says; measured (F, rows, columns): frames in blocks."""

    scans: Sequence[Scan]
    block: int
    measured: np.ndarray
    valid: np.ndarray | None
    phantom: EllipsoidPhantom
    start: np.ndarray
    cut: float
    count_pass: Callable[[], None] = lambda: None

    @classmethod
    def of(
        cls,
        phantom: EllipsoidPhantom,
        start: np.ndarray,
        scans: Sequence[Scan],
        columns: int,
        most_frames: int = MOST_FRAMES,
    ) -> "BeadLevel":
        """Blocks such that the longer side has at most ``columns`` of them."""
        block = math.ceil(max(scans[0].geometry.detector_shape) / columns)
        fewer = [fewer_frames(scan, most_frames) for scan in scans]
        small = [binned(scan, block) for scan in fewer]
        measured = np.concatenate([np.asarray(scan.projections, np.float32) for scan in small])
        valid = np.concatenate([scan.valid for scan in small])
        bare = [replace(s, projections=np.broadcast_to(np.float32(0), s.projections.shape)) for s in fewer]
        return cls(bare, block, measured, None if valid.all() else valid, phantom, start, _cut_noise(fewer))

    def operator(self, change: Change, views: Views | Sway | None = None) -> BeadOperator:
        """The frames of the phantom after a change."""
        tables: list[TimeCells] = []
        for scan in self.scans:
            small = binned(moved(scan, change, views), self.block)
            edge_px = max(scan.grid.size_mm[1:]) / 2 * scan.geometry.magnification / min(small.geometry.pixel_size_mm)
            times = int(np.clip(math.ceil(exposure_arc_rad(scan) * edge_px), _LEAST_SAMPLES, _MOST_SAMPLES))
            spread = _as_wide(small, times)
            tables += [OwnTimes(times).cells(spread, frame) for frame in range(small.frames)]
        radius_mm = float(np.median([body.reach_mm for body in self.phantom.ellipsoids])) * small.geometry.magnification
        per_pixel = math.ceil(_PIXEL_SAMPLES * min(small.geometry.pixel_size_mm) / radius_mm)
        samples = int(np.clip(per_pixel, _PIXEL_SAMPLES, _MOST_PIXEL_SAMPLES))
        model = self.scans[0].detector_model
        return BeadOperator(self.phantom, tables, small.geometry.detector_shape, model, samples, self.cut)

    def at(self, change: Change) -> "BeadLevel":
        """Itself: a background takes a drift, and lag is not looked for."""
        return self

    def masked(self, frames: np.ndarray) -> np.ndarray:
        return frames if self.valid is None else np.where(self.valid, frames, np.float32(0))

    def residual(self, operator: BeadOperator, placement: np.ndarray) -> np.ndarray:
        """What the phantom, and a smooth background, leave of the frames."""
        return self._without_background(self.measured - operator.forward(placement))

    def noise(self, residual: np.ndarray) -> float:
        """Standard deviation of a pixel's noise and of what the model misses."""
        return float(np.std(residual if self.valid is None else residual[self.valid]))

    def explained(self, operator: BeadOperator, placement: np.ndarray) -> float:
        """Share of the squares of what is compared that the phantom explains; 0 where it would have to add light."""
        left, whole = (self.compared(one) for one in (self.residual(operator, placement), self.masked(self.measured)))
        return float(1 - left @ left / max(float(whole @ whole), 1e-30)) if placement[DENSITY] > 0 else 0.0

    def reconstruct(self, operator: BeadOperator, start: np.ndarray | None, iterations: int) -> np.ndarray:
        """The placement (7,) that fits best, from ``start`` on, by Gauss–Newton."""
        placement = self.start if start is None else start
        inverse = None
        for _ in range(iterations):
            if inverse is None:
                inverse = np.linalg.pinv(self._signals(operator, placement))
            step = self.compared(self.residual(operator, placement)) @ inverse
            step *= min(1.0, _MOST_PX / max(np.abs(step[:DENSITY]).max(), 1e-30))
            placement = _further(placement, step * self._units())
            self.count_pass()
            if np.abs(step).max() < _SETTLED_PX:
                break
            if np.abs(step).max() > _STRAIGHT_PX:
                inverse = None
        return placement

    def off_range(
        self, operator: BeadOperator, placement: np.ndarray, images: Sequence[np.ndarray], iterations: int
    ) -> list[np.ndarray]:
        """What of each image (F, rows, columns) the phantom lying a little elsewhere, or denser, does not explain."""
        basis, _ = np.linalg.qr(self._signals(operator, placement).T)
        compared = np.array([self.compared(image) for image in images])
        left = compared - compared @ basis @ basis.T
        return list(left.reshape(len(images), *self.measured.shape))

    def _units(self) -> np.ndarray:
        """What of each number (7,) of a placement moves a frame by a pixel at its edge, or makes it ten times as dense."""
        scan = self.scans[0]
        pixel_mm = self.block * min(scan.geometry.pixel_size_mm) / scan.geometry.magnification
        return np.array([pixel_mm / (max(scan.grid.size_mm) / 2)] * 3 + [pixel_mm] * 3 + [1.0])

    def _signals(self, operator: BeadOperator, placement: np.ndarray) -> np.ndarray:
        """Change of what is compared (7, F · pixels) by a unit of each number."""
        found = []
        for number, unit in enumerate(self._units()):
            step = np.eye(DENSITY + 1)[number] * _STEP_PX * unit
            ends = [operator.forward(_further(placement, sign * step)) for sign in (1, -1)]
            found.append(self.compared((ends[0] - ends[1]) / np.float32(2 * _STEP_PX)))
        return np.array(found)

    def compared(self, frames: np.ndarray) -> np.ndarray:
        """Frames (F · pixels), float64, without background and without what is finer than the few rays per pixel."""
        blurred = gaussian_filter(self._without_background(frames), (0, _BLUR_PX, _BLUR_PX), output=np.float64)
        return blurred.ravel()

    def _without_background(self, frames: np.ndarray) -> np.ndarray:
        """Frames without what a few cosines along each side explain."""
        rows, columns = (_cosines(count) for count in frames.shape[1:])
        if self.valid is None:
            inner = np.einsum("vi,fvu,uj->fij", rows, frames, columns)
            return (frames - np.einsum("vi,fij,uj->fvu", rows, inner, columns)).astype(np.float32)
        found = np.zeros(frames.shape, np.float32)
        cosines = np.einsum("vi,uj->vuij", rows, columns).reshape(-1, _BACKGROUND**2)
        for into, frame, valid in zip(found, frames, self.valid, strict=True):
            some = cosines[valid.ravel()]
            into[valid] = frame[valid] - some @ np.linalg.lstsq(some, frame[valid], rcond=None)[0]
        return found


def _cut_noise(scans: Sequence[Scan]) -> float:
    """Standard deviation of noise about air of which what was below 0 is 0, from means of small blocks; 0 where few are."""
    values = np.concatenate([np.asarray(scan.projections, np.float32) for scan in scans])
    valid = np.concatenate([scan.valid for scan in scans])
    if np.mean(values[valid] == 0) < _LEAST_ZEROS or values[valid].min() < 0:
        return 0.0
    means = uniform_filter(np.where(valid, values, 0), (0, _BLOCK, _BLOCK)) * math.sqrt(2 * math.pi)
    return float(np.median(means[valid]))


def _as_wide(scan: Scan, times: int) -> Scan:
    """The scan with lines open so much longer, about the same middle, that ``times`` moments of that are spread (standard
    deviation) as all of the exposure is: else few would pass for a shorter one. A pulse is left as it is."""
    if scan.shutter.pulse_s is not None:
        return scan
    exposure_s = scan.shutter.exposure_s / math.sqrt(1 - times**-2)
    early_s = (exposure_s - scan.shutter.exposure_s) / 2
    shutter = replace(scan.shutter, exposure_s=exposure_s)
    return replace(scan, shutter=shutter, frame_start_s=np.asarray(scan.frame_start_s) - early_s)


def _further(placement: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A placement (7,) after another turn about the world's axes, shift, and density added."""
    turn = Rotation.from_rotvec(step[:3])
    turned = (turn * Rotation.from_rotvec(placement[:3])).as_rotvec()
    return np.concatenate([turned, turn.apply(placement[3:DENSITY]) + step[3:DENSITY], placement[DENSITY:] + step[DENSITY:]])


def _cosines(count: int) -> np.ndarray:
    """The slowest cosines (count, n) along a side, orthonormal."""
    order = np.arange(min(_BACKGROUND, count))
    waves = np.cos(np.pi * order * (np.arange(count)[:, None] + 0.5) / count)
    found: np.ndarray = waves / np.linalg.norm(waves, axis=0)
    return found
