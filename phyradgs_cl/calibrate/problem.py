"""What a calibration compares: the frames of one or two scans on a coarse grid, their operator after a correction, and the
volume that fits them. Also its grids, from coarse to fine, and its progress in passes through the frames."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import ConeGeometry, PerRow, Scan
from phyradgs_cl.acquisition.altered import coarse
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, perturb
from phyradgs_cl.acquisition.geometry import Geometry, field_of_view_mm
from phyradgs_cl.acquisition.motion import rim_travel_voxels
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.detector import noise_level
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import TvProx
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.operators.rays.upright import FEWEST_LINES
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.fista_tv import FistaTv, FistaTvOptions
from phyradgs_cl.reconstructors.voxels.priors import axis_weights
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

_MOST_TIMES = 8  # most times per exposure, since each time costs a projection
_VOXELS_PER_TIME = 2.0  # most voxels that the volume's rim moves between two times, if _MOST_TIMES times suffice
_REACH_OF_CUT = 2.0  # (half width of the grid) / (radius of the field of view) for an object beyond the panel's sides
_MOST_BESIDE = 0.01  # a grid is too small if a larger fraction of the rays through matter must meet some beside it
_TOO_DENSE = 4.0  # (density that a ray would need in the grid) / (median density) from which it must meet matter beside it
_MATTER, _NOISES = 0.1, 4.0  # matter is above this fraction of the largest value, and above so many deviations of the noise
_TV = FistaTvOptions(tv_weight=0.0005, tv_iterations=8)
_AT_END = 0.1  # an object reaches beyond the first or last row if more than this fraction of its pixels shows matter
_END_ROWS = 2  # rows of blocks that are not compared at an end of the panel that cuts the object; at most a quarter of all
# Standard deviation, in blocks, of the Gaussian that smooths frames of nearly parallel rays: of a grid narrower than this
# fraction of its distance from the source. A row's rays stay in one slice in all views, so that errors of voxels, and of
# edges narrower than a pixel, do not average out: with 0.8 a roll of 0.8° came out at 0.73°, unsmoothed at 0.6°.
_SMOOTHING_NARROW, _NARROW = 1.6, 0.3
_COLUMNS_NARROW = 16  # least blocks of pixels from left to right for this smoothing
Report = Callable[[int, int, str, float], None]
"""A callback for progress: passes done, passes in all, the phase, and the fraction of the time that has passed."""
_LEAST_SHARE = 0.1  # least (expected cost of a phase's remaining passes) / (their full cost) in the progress
Passes = tuple[int, float]
"""For a phase: the largest number of passes through the frames, and their expected total cost (``pass_cost``)."""


@dataclass(frozen=True)
class Stage:
    """One grid of a calibration: at most ``columns`` blocks of pixels along the panel's longer side.

    first, again: iterations for the first volume, and for each later one. steps: most Gauss–Newton steps. project: in each
    step, the iterations of CGLS that remove from signals what a volume explains. is_cut: whether the object reaches beyond
    the panel's sides."""

    columns: int
    first: int
    again: int
    steps: int = 3
    project: int = 20
    is_cut: bool = False

    def block(self, scan: Scan) -> int:
        """Returns the number of pixels along a block's side."""
        return ceil_div(max(scan.geometry.detector_shape), self.columns)

    def passes(self, parameters: int, asks: bool) -> int:
        """Returns the largest number of passes through the frames, for ``parameters`` unknowns. asks: whether the stage also
        tests which parameters the frames determine."""
        return self.first - self.again + self.steps * (self.again + self.project * (parameters + (3 if asks else 1)))


def pass_cost(scans: Sequence[Scan], columns: int, most_frames: int) -> float:
    """Returns the cost of a pass through all scans: (number of rays) × (voxels along a ray), with at most ``columns`` blocks
    of pixels along the panel's longer side, and at most ``most_frames`` frames of each scan."""
    shape = scans[0].geometry.detector_shape
    rows, across = (ceil_div(n, ceil_div(max(shape), columns)) for n in shape)
    return float(sum(min(scan.frames, most_frames) for scan in scans) * rows * across * max(rows, across))


class PassCounter:
    """Counts passes through the frames and reports them. plan: number and cost of each phase's passes, in order. A skipped
    phase leaves the plan, so the reported total falls."""

    def __init__(self, report: Report, plan: Mapping[str, Passes]) -> None:
        self.plan = dict(plan)
        self._report = report
        self._done, self._spent, self._text = 0, 0.0, ""
        self._current: Passes = (0, 0.0)  # remaining passes of the present phase, and their cost

    def begin(self, phase: str, text: str) -> None:
        """Begins a phase of the plan, which reports call ``text``, and drops the phases before it."""
        while phase in self.plan and next(iter(self.plan)) != phase:
            self.plan.pop(next(iter(self.plan)))
        self._text, self._current = text, self.plan.pop(phase, (0, 0.0))
        self._say()

    def counter(self, cost: float) -> Callable[[], None]:
        """Returns a function that counts one pass through the frames, of the given cost, at each call."""

        def count() -> None:
            passes, remaining = self._current
            self._done, self._spent = self._done + 1, self._spent + cost
            self._current = max(passes - 1, 0), max(remaining - cost, _LEAST_SHARE * max(passes - 1, 0) * cost)
            self._say()

        return count

    def _say(self) -> None:
        passes, costs = zip(self._current, *self.plan.values(), strict=True)
        spent_share = self._spent / max(self._spent + sum(costs), 1e-30)
        self._report(self._done, self._done + sum(passes), self._text, spent_share)


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseFrames:
    """The stated ``scans`` with fewer frames, whose line integrals are 0 to save memory, and their measurement.

    measured (F, rows, columns): all scans' frames, in line integrals averaged over blocks of ``block`` × ``block`` pixels.
    valid, of the same shape: True for pixels to use; None: all. ``count_pass`` is called once per iteration, which projects
    and backprojects all frames."""

    scans: Sequence[Scan]
    block: int
    measured: np.ndarray
    valid: np.ndarray | None
    count_pass: Callable[[], None] = lambda: None

    def masked(self, frames: np.ndarray) -> np.ndarray:
        return frames if self.valid is None else np.where(self.valid, frames, np.float32(0))


def frames_of(scans: Sequence[Scan], small: Sequence[Scan], block: int) -> dict[str, Any]:
    """Returns the fields of ``CoarseFrames`` for ``scans`` and their copies ``small``, binned by ``block``."""
    valid = np.concatenate([scan.valid for scan in small])
    measured = np.where(valid, np.concatenate([np.asarray(scan.projections, np.float32) for scan in small]), np.float32(0))
    empty = [replace(scan, projections=np.broadcast_to(np.float32(0), scan.projections.shape)) for scan in scans]
    return {"scans": empty, "block": block, "measured": measured, "valid": None if valid.all() else valid}


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseProblem(CoarseFrames):
    """Coarse frames of an unknown object, and the grid of its volume."""

    rt: Runtime
    grid: Grid

    @classmethod
    def of(
        cls, rt: Runtime, scans: Sequence[Scan], stage: Stage, most_frames: int = coarse.MOST_FRAMES
    ) -> "CoarseProblem":
        """Returns the problem with the scans binned as ``stage`` says, and at most ``most_frames`` frames of each."""
        block = stage.block(scans[0])
        fewer = [coarse.fewer_frames(scan, most_frames) for scan in scans]
        small = [coarse.binned(coarse.smooth(scan, _smoothing_px(scan, block, stage.is_cut)), block) for scan in fewer]
        grid = coarse.coarse_grid(scans[0].grid, small[0].geometry)
        problem = cls(rt=rt, grid=grid, **frames_of(fewer, small, block))
        if stage.is_cut or problem.matter_beside_grid() > _MOST_BESIDE:
            reach = _REACH_OF_CUT if stage.is_cut else 1.0
            problem = replace(problem, grid=_around_view(grid, scans[0].geometry, reach))
        return problem

    def matter_beside_grid(self) -> float:
        """Returns the fraction, 0 to 1, of the rays through matter that must meet some beside the grid, in the stated
        geometry: their path in the grid would need over four times the density that most paths need."""
        is_matter = _is_matter(self.measured, self.valid)
        paths = self.operator(GeometryCorrection()).forward(np.ones(self.grid.shape, np.float32))[is_matter]
        integrals, inside = self.measured[is_matter], paths > 0
        if not inside.any():
            return 0.0
        density = float(np.median(integrals[inside] / paths[inside]))
        return float(np.mean(integrals > _TOO_DENSE * density * paths))

    def without_cut_ends(self) -> "CoarseProblem":
        """Returns the problem without the rows next to an end of the panel that cuts the object.

        The volume has an edge there, since no ray shows what lies beyond. The object has none: expected frames would change
        more than measured ones, and a roll came out at a fifth of its value."""
        valid = np.ones(self.measured.shape, bool) if self.valid is None else self.valid.copy()
        is_matter, rows = _is_matter(self.measured, self.valid), np.flatnonzero(valid.any((0, 2)))
        count = min(_END_ROWS, len(rows) // 4)
        cut = [end for end in (rows[:count], rows[::-1][:count]) if count and is_matter[:, end[0]].mean() > _AT_END]
        if not cut:
            return self
        valid[:, np.concatenate(cut)] = False
        return replace(self, valid=valid, measured=np.where(valid, self.measured, np.float32(0)))

    def operator(self, correction: GeometryCorrection, views: Views | Sway | None = None) -> RayOperator:
        """Returns the projector A to the coarse frames of all scans, in the geometry after ``correction`` and ``views``.

        In a fly-scan each line averages over 2 to 8 times of its exposure. views: changes of single views or of the
        object's pose."""
        tables = []
        for scan in self.scans:
            small = coarse.binned(perturb(scan, correction, views), self.block)
            moved_voxels = rim_travel_voxels(replace(small, grid=self.grid))
            times = min(max(2, math.ceil(moved_voxels / _VOXELS_PER_TIME)), _MOST_TIMES)
            tables += [PerRow(times).cells(small, frame) for frame in range(small.frames)]
        return RayOperator(self.rt, self.grid, small.geometry.detector_shape, tables, fewest_lines=FEWEST_LINES)

    def line_integrals(self, operator: RayOperator, volume: np.ndarray) -> np.ndarray:
        """Returns the measurement as mean line integrals (F, rows, columns). A detector that averages intensity measures
        less at edges; this difference, computed for ``volume``, is added."""
        if self.scans[0].detector_model != "intensity":
            return self.measured
        return self.measured + self.masked(operator.forward(volume) - self._expected(operator, volume))

    def _expected(self, operator: RayOperator, volume: np.ndarray) -> np.ndarray:
        """Returns a volume's frames (F, rows, columns). They average line integrals or intensities, as the detector does."""
        if self.scans[0].detector_model != "intensity":
            return operator.forward(volume)
        return IntensityOperator(self.rt, self.grid, operator.detector_shape, operator.tables).expected(volume)

    def reconstruct(self, operator: RayOperator, start: np.ndarray | None, iterations: int) -> np.ndarray:
        """Returns a nonnegative volume (nz, ny, nx) in 1/mm of little total variation, after ``iterations`` of FISTA-TV from
        ``start`` (None: zeros)."""
        volume = np.zeros(self.grid.shape, np.float32) if start is None else start
        system = System(operator, self.line_integrals(operator, volume), self.valid)
        method = FistaTv(system, _TV, TvProx(self.rt, self.grid.shape, axis_weights(self.grid)))
        method.start_from(volume)
        for _ in range(iterations):
            method.step()
            self.count_pass()
        return method.volume

    def compared(self, frames: np.ndarray) -> np.ndarray:
        """Returns the values (F · pixels,) by which frames are compared: the frames themselves, 0 at invalid pixels."""
        return self.masked(frames).ravel()

    def residual(self, operator: RayOperator, volume: np.ndarray) -> np.ndarray:
        """Returns measured minus expected frames (F, rows, columns)."""
        return self.measured - self.masked(self._expected(operator, volume))

    def noise(self, residual: np.ndarray) -> float:
        """Returns the standard deviation of a pixel's noise, from the measurement. ``residual`` is not used: the volume has
        fitted some of its noise."""
        return noise_level(self.measured, self.valid)

    def beyond_object(
        self, operator: RayOperator, volume: np.ndarray, images: Sequence[np.ndarray], iterations: int
    ) -> list[np.ndarray]:
        """Returns the part of each image (F, rows, columns) that no volume explains, after ``iterations`` of CGLS."""
        residuals = []
        for image in images:
            method = Cgls(System(operator, self.masked(image), self.valid))
            for _ in range(iterations):
                if method.finished:
                    break
                method.step()
                self.count_pass()
            residuals.append(method.residual)
        return residuals


def _around_view(grid: Grid, geometry: Geometry, reach: float) -> Grid:
    """Returns the grid with voxels added on all sides, so that it is ``reach`` times as wide as the panel's field of view,
    and as high as what the panel sees of this width.

    The frames show all matter that rays meet. If the grid has no place for some of it, wrong geometries fit better than the
    right one."""
    (low_mm, top_mm), (_, radius_mm), _ = field_of_view_mm(geometry).tolist()
    half_mm = (top_mm - low_mm) / 2
    if isinstance(geometry, ConeGeometry):  # the fan widens from the radius to the reach
        half_mm *= (geometry.source_to_axis_mm + reach * radius_mm) / (geometry.source_to_axis_mm + radius_mm)
    middles_mm, halves_mm = ((low_mm + top_mm) / 2, 0.0, 0.0), (half_mm, reach * radius_mm, reach * radius_mm)
    off_mm = [abs(offset - middle) for offset, middle in zip(grid.offset_mm, middles_mm, strict=True)]
    sides = zip(grid.shape, grid.voxel_size_mm, np.add(halves_mm, off_mm).tolist(), strict=True)
    nz, ny, nx = (n + 2 * max(0, math.ceil(wanted_mm / voxel_mm - n / 2)) for n, voxel_mm, wanted_mm in sides)
    return Grid((nz, ny, nx), grid.voxel_size_mm, grid.offset_mm)


def _is_matter(p: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    """Returns which line integrals p (F, rows, columns) belong to rays through matter."""
    return p > max(_NOISES * noise_level(p, valid), _MATTER * float(np.percentile(p, 99.9)))


def _smoothing_px(scan: Scan, block: int, is_cut: bool) -> float | tuple[float, float]:
    """Returns the standard deviations (v, u), in pixels, of the smoothing before binning. Rows that are read one after the
    other are not smoothed together: they see the object at different angles, and smoothed they would look like a shorter
    readout. A readout by columns shears the image, and smoothing does not change the shear.

    Frames of nearly parallel rays are smoothed more, single pixels too: they stay frames of an object, a smoother one. Not
    so where the panel's sides cut the object (``is_cut``), since smoothing mirrors it there, nor with few columns."""
    cone, width_mm = scan.geometry, max(scan.grid.size_mm[1:])
    is_narrow = not isinstance(cone, ConeGeometry) or width_mm < _NARROW * cone.source_to_axis_mm
    is_smoother = is_narrow and not is_cut and cone.detector_shape[1] >= _COLUMNS_NARROW * block
    if block == 1 and not is_smoother:
        return 0.0
    smoothing_px = (_SMOOTHING_NARROW if is_smoother else coarse.SMOOTHING) * block
    is_rolling = scan.shutter.readout_s > 0 and scan.shutter.axis == "rows"
    return 0.0 if is_rolling else smoothing_px, smoothing_px
