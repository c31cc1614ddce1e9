"""Finds the shift of the panel along u that puts the rotation axis in its right place: the shift with which a coarse
reconstruction explains the frames best. In a parallel beam at right angles to the axis, views half a turn apart are mirror
images, from which the shift follows directly."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import fftconvolve

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import azimuth_rad, has_opposite_views, middle_poses, wrapped
from phyradgs_cl.acquisition.altered.variants import altered_trajectory, shifted
from phyradgs_cl.reconstructors.fits.residuals import fit_squares, vertex
from phyradgs_cl.runtime import Runtime

_ROUGH_SHIFTS = (-2.0, -1.0, 0.0, 1.0, 2.0)  # shifts of the panel that are tried first, in coarse pixels
_ROUGH_ITERATIONS = 8  # iterations of CGLS for each coarse shift: few are enough to tell the shifts apart
_STEP = 0.25  # distance between the three shifts that bracket the best one, in coarse pixels
_MOST_STEPS = 8  # the three trial shifts move at most this many times, so that a search without a minimum ends
ANYWHERE = (-math.inf, math.inf)  # limits in pixels that allow every shift
_MOST_VIEWS = 60  # most views that are compared with their opposites, to save time
# Most rows by which a row may rise from side to side: with 9 rows, shifts were 0.04 pixels off; with 18 rows, 0.09 pixels.
_MOST_ROLLED_ROWS = 10.0
_MOST_ROWS = 64  # most blocks of rows that are compared, to save time
_BEYOND = 1.5  # at an end of the scan, a view's opposite may lie up to this many angular steps beyond the outermost view
WIDEST_STEP_RAD = math.radians(10.0)  # views further apart differ too much to be interpolated
# Smoothing along rows (std, in pixels). Without it, interpolation would lower noise between pixels, which biases shifts.
SMOOTHING_PX = 1.0
_CORRELATED_PX = 2 * math.sqrt(math.pi) * SMOOTHING_PX  # number of columns over which the smoothing correlates noise
_LEAST_OVERLAP = 0.25  # a view and its mirrored opposite must overlap in at least this fraction of the columns
_LEAST_ENERGY = 0.2  # an overlap whose sum of squares is below this fraction of the largest sum counts as air alone
_STEPS = 12  # most steps of Gauss–Newton
_SETTLED_PX = 1e-3  # Gauss–Newton ends after a step shorter than this, in pixels
_BIAS_PX = 0.02  # standard deviation of the error of a shift, in pixels, that the interpolation of views causes


@dataclass(frozen=True, eq=False)
class AxisShift:
    """A shift of the panel along u, and the fit that found it. pixels, deviation: the shift and its standard deviation in
    pixels of the recorded scan, both NaN if no shift fits best. squares (F,): mean squared residual of each frame, in the
    trial whose shift is nearest; empty if there was no trial."""

    pixels: float
    deviation: float
    squares: np.ndarray

    @property
    def is_found(self) -> bool:
        return math.isfinite(self.pixels)


NOT_FOUND = AxisShift(math.nan, math.nan, np.empty(0))


def rough_shift(rt: Runtime, scan: Scan, limits_px: tuple[float, float] = ANYWHERE) -> AxisShift:
    """Returns the shift with the least residual after few iterations, of up to five shifts one coarse pixel apart within
    ``limits_px``. Its deviation is NaN."""
    block = columns_per_block(scan)
    shifts_px = [block * shift for shift in _ROUGH_SHIFTS if limits_px[0] <= block * shift <= limits_px[1]]
    trials = [fit_squares(rt, shifted(scan, shift_px), _ROUGH_ITERATIONS) for shift_px in shifts_px]
    best = int(np.argmin([squares.sum() for squares in trials]))
    return AxisShift(shifts_px[best], math.nan, trials[best])


def refined_shift(
    rt: Runtime, scan: Scan, rough: AxisShift, limits_px: tuple[float, float] = ANYWHERE
) -> AxisShift:
    """Returns the shift near ``rough`` with the least residual: the vertex of a parabola through three shifts. If the vertex
    lies outside of ``limits_px``, ``rough`` is fitted with all iterations and returned, with a deviation of NaN."""
    block = columns_per_block(scan)
    centre = rough.pixels / block
    trials: dict[float, np.ndarray] = {}

    def squares_at(shift: float) -> np.ndarray:
        if shift not in trials:
            trials[shift] = fit_squares(rt, shifted(scan, block * shift))
        return trials[shift]

    for _ in range(_MOST_STEPS):
        neighbours = [centre - _STEP, centre, centre + _STEP]
        lowest = int(np.argmin([squares_at(shift).sum() for shift in neighbours]))
        if lowest == 1:
            break
        centre = neighbours[lowest]
    around = np.array([centre - _STEP, centre, centre + _STEP])
    best, deviation = vertex(around, np.stack([squares_at(shift) for shift in around]))
    if math.isfinite(best) and not limits_px[0] <= block * best <= limits_px[1]:
        return AxisShift(rough.pixels, math.nan, squares_at(rough.pixels / block))
    return AxisShift(block * best, block * deviation, squares_at(centre))


def axis_shift(rt: Runtime, scan: Scan) -> AxisShift:
    """Returns the panel's shift, within a few coarse pixels of 0, under which a coarse scan has the least residual."""
    return refined_shift(rt, scan, rough_shift(rt, scan))


def with_best_shift(rt: Runtime, scan: Scan) -> Scan:
    """Returns the coarse scan with its panel shifted to the least residual, by a parabola through three shifts one coarse
    pixel apart with few iterations each. If the parabola has no minimum, returns the scan itself."""
    block, start = columns_per_block(scan), altered_trajectory(scan).shift_px
    shifts = np.array([-1.0, 0.0, 1.0])
    trials = np.stack([fit_squares(rt, shifted(scan, start + block * shift), _ROUGH_ITERATIONS) for shift in shifts])
    best, _ = vertex(shifts, trials)
    return shifted(scan, start + block * float(np.clip(best, -2, 2))) if math.isfinite(best) else scan


def columns_per_block(scan: Scan) -> int:
    """Returns how many columns of the recorded scan were averaged to one column of the coarse ``scan``."""
    return altered_trajectory(scan).blocks[1]


@dataclass(frozen=True, eq=False)
class _Pair:
    """A view and the mirror image of its opposite, both (rows, columns). apart_px: (column of the stated axis in the view) −
    (its column in the mirror image)."""

    view: np.ndarray
    mirrored: np.ndarray
    apart_px: float


def opposite_shift(scan: Scan) -> AxisShift:
    """Returns the panel's shift along u under which views half a turn apart are mirror images, with its deviation.

    A view's opposite is interpolated between the two views nearest to it in angle. A half turn has opposites at its ends
    only, where they may be extrapolated by up to 1.5 steps. The shift is NaN for cone beams, for panels that move along
    the axis or are rolled by over 10 rows from side to side, for scans without opposite views, and if columns are read one
    after the other, at other angles."""
    if not has_opposite_views(scan) or (scan.shutter.axis == "columns" and scan.shutter.readout_s > 0):
        return NOT_FOUND
    pairs = _pairs(scan)
    if not pairs:
        return NOT_FOUND
    start_px = _rough_shift(pairs)
    shifts, information = np.array([_refined_shift(pair, start_px) for pair in pairs]).T
    is_found = np.isfinite(shifts) & (information > 0)
    if not is_found.any():
        return NOT_FOUND
    shifts, weight = shifts[is_found], information[is_found] / information[is_found].sum()
    shift = float(weight @ shifts)
    noise, scatter = 1 / information[is_found].sum(), float(weight**2 @ (shifts - shift) ** 2)
    # the variance is doubled, because most pairs of a view and its opposite are in ``pairs`` twice, once from each side
    return AxisShift(shift, math.sqrt(2 * max(noise, scatter) + _BIAS_PX**2), np.empty(0))


def _pairs(scan: Scan) -> list[_Pair]:
    poses, (rows, columns) = middle_poses(scan), scan.geometry.detector_shape
    angle = azimuth_rad(poses)
    across = np.stack([-np.sin(angle), np.cos(angle), np.zeros(scan.frames)], -1)
    first, step_u, step_v = poses[:, 3:6], poses[:, 6:9], poses[:, 9:12]
    pitch = np.einsum("fi,fi->f", step_u, across)
    # a row must see nearly the same slice from both sides: hardly a roll, and no motion along the axis
    row_mm = np.linalg.norm(step_v, axis=1).min()
    moved_rows, rolled_rows = np.ptp(first[:, 2]) / row_mm, np.abs(step_u[:, 2]).max() * (columns - 1) / row_mm
    turns = (np.abs(pitch) < 0.9 * np.linalg.norm(step_u, axis=1)).any() or np.ptp(np.sign(pitch)) > 0
    if moved_rows > 0.5 or rolled_rows > _MOST_ROLLED_ROWS or turns:
        return []
    axis_px = -np.einsum("fi,fi->f", first + (rows - 1) / 2 * step_v, across) / pitch
    pairs = []
    for view in np.unique(np.linspace(0, scan.frames - 1, min(scan.frames, _MOST_VIEWS)).round().astype(int)):
        opposite = _opposite(wrapped(angle - angle[view] - np.pi))
        if opposite is None:
            continue
        frames, shares = opposite
        mirrored = np.einsum("f,fvu->vu", shares, [_few_rows(scan, frame)[:, ::-1] for frame in frames])
        mirrored_axis_px = columns - 1 - shares @ axis_px[frames]
        pairs.append(_Pair(_few_rows(scan, view), mirrored, float(axis_px[view] - mirrored_axis_px)))
    return pairs


def _opposite(away: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the numbers of two frames, and weights with sum 1 that combine both to the view at angle 0; None if no two
    frames are near. away (F,): angles of the frames in rad, relative to that view."""
    order = np.argsort(away)
    step = float(np.median(np.abs(np.diff(away[order])))) if len(away) > 1 else math.inf
    above = int(np.searchsorted(away[order], 0.0))
    two = order[np.clip([above - 1, above], 0, len(away) - 1)]
    if two[0] == two[1] or np.ptp(away[two]) > min(WIDEST_STEP_RAD, 2 * _BEYOND * step):
        nearest = order[np.argsort(np.abs(away[order]), kind="stable")]
        near = nearest[0]
        same_side = [frame for frame in nearest[1:] if step / 2 < abs(away[frame] - away[near]) < _BEYOND * step]
        if not same_side or abs(away[near]) > min(WIDEST_STEP_RAD, _BEYOND * step):
            return None
        two = np.array([near, same_side[0]])
    # linear interpolation to angle 0, or extrapolation if both frames are on one side of it
    share = float(away[two[0]] / (away[two[0]] - away[two[1]]))
    return two, np.array([1 - share, share])


def _few_rows(scan: Scan, frame: int) -> np.ndarray:
    """Returns a frame's means over at most ``_MOST_ROWS`` blocks of rows, (blocks, columns) float64, smoothed along rows.
    Masked pixels are first interpolated along their rows."""
    image = np.asarray(scan.projections[frame], np.float64)
    if scan.pixel_mask is not None:
        columns = np.arange(image.shape[1])
        image = np.array([
            np.interp(columns, columns[valid], row[valid]) if valid.any() else 0 * row
            for row, valid in zip(image, scan.valid[frame], strict=True)
        ])
    starts = np.unique(np.linspace(0, len(image), min(len(image), _MOST_ROWS), endpoint=False).astype(int))
    means = np.add.reduceat(image, starts, axis=0) / np.diff(starts, append=len(image))[:, None]
    return gaussian_filter1d(means, SMOOTHING_PX, axis=1)


def _rough_shift(pairs: list[_Pair]) -> float:
    """Returns the shift in pixels, in steps of 1/2, with the least Σ (view − mirror image)² / Σ (view² + mirror image²). The
    sums run over all pairs, where the view and the shifted mirror image overlap."""
    columns = pairs[0].view.shape[1]
    # a shift of the panel moves a view and its mirror image against each other, by twice the shift
    lags = np.arange(1 - columns, columns)  # column of the mirror image minus column of the view
    twice_px = lags.astype(np.float64)
    products, energies = np.zeros(lags.size), np.zeros(lags.size)
    for pair in pairs:
        ones = np.ones_like(pair.view)
        product = _correlation(pair.mirrored, pair.view)
        energy = _correlation(pair.mirrored**2, ones) + _correlation(ones, pair.view**2)
        products += np.interp(twice_px - pair.apart_px, lags, product)
        energies += np.interp(twice_px - pair.apart_px, lags, energy)
    is_possible = (np.abs(lags) < (1 - _LEAST_OVERLAP) * columns) & (energies > _LEAST_ENERGY * energies.max())
    difference = np.where(is_possible, 1 - 2 * products / np.maximum(energies, 1e-30), np.inf)
    return float(twice_px[np.argmin(difference)] / 2)


def _correlation(mirrored: np.ndarray, view: np.ndarray) -> np.ndarray:
    return fftconvolve(mirrored, view[:, ::-1], axes=1).sum(0)


def _refined_shift(pair: _Pair, shift_px: float) -> tuple[float, float]:
    """Returns the shift in pixels near ``shift_px`` with the least squared difference, by Gauss–Newton, and 1/(its
    variance). Returns NaN and 0 if the steps lead over 2 pixels away, or so far that too few columns overlap."""
    last = pair.view.shape[1] - 1
    columns = np.arange(last + 1)
    view, mirrored = (CubicSpline(columns, image, axis=1) for image in (pair.view, pair.mirrored))
    start_px = shift_px
    for _ in range(_STEPS):
        half_lag = shift_px - pair.apart_px / 2
        middle = columns[(columns - abs(half_lag) >= 0) & (columns + abs(half_lag) <= last)]
        if middle.size < _LEAST_OVERLAP * columns.size:
            return math.nan, 0.0
        difference = view(middle - half_lag) - mirrored(middle + half_lag)
        # d(difference)/d(shift): the shift moves the view and the mirror image in opposite directions
        slope = -view(middle - half_lag, 1) - mirrored(middle + half_lag, 1)
        squares = float((slope**2).sum())
        step = -float((difference * slope).sum()) / max(squares, 1e-30)
        shift_px += step
        if abs(shift_px - start_px) > 2:
            return math.nan, 0.0
        if abs(step) < _SETTLED_PX:
            break
    variance = float((difference**2).mean()) * _CORRELATED_PX / max(squares, 1e-30)
    return shift_px, 1 / max(variance, 1e-12)
