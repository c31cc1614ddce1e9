"""Finds the axis of rotation near the edge of a displaced panel, from the rays that a full turn measures twice.

The residual of a fit cannot find the axis there: it is always smaller for a shift with fewer rays measured twice. Here each
ray is compared with its opposite, half a turn and twice its fan angle away. The mean of the squared differences does not
depend on the number of rays."""

import math

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import azimuth_rad, middle_poses
from phyradgs_cl.prepare.step import fill_masked
from phyradgs_cl.reconstructors.fdk.weights import fan_angle, pixel_rays
from phyradgs_cl.reconstructors.fits.axis import NOT_FOUND, SMOOTHING_PX, WIDEST_STEP_RAD, AxisShift
from phyradgs_cl.reconstructors.fits.residuals import lowest

_COARSE_COLUMNS = 128  # shifts are first tried on frames of at most this many columns
_MOST_PX = 16.0  # largest shift of the panel that is tried, in coarse pixels: an eighth of the panel
_STEP_PX = 0.5  # distance between neighbouring trial shifts, in pixels of the compared frames
_NEAR_PX = 2.0  # full frames are tried with shifts up to this far from the best coarse shift, in coarse pixels
_FEWEST_VIEWS = 24  # with fewer views, the opposite of a ray cannot be interpolated between views
_MOST_VIEWS = 360  # most views that are compared, to save time
_MOST_ROWS = 32  # most rows that are compared, to save time
_MOST_PAIRS = 48  # most pairs of opposite rays that are compared in a row, to save time
_LEAST_PX = 1.0  # a shift of the panel is not tried if the axis is then nearer than this to a side of the panel, in pixels
_BLOCKS = 12  # the jackknife leaves out one of this many blocks of views at a time
_BIAS_PX = 0.05  # standard deviation of the shift's error without noise, in pixels: half-fan scans, features 2 pixels wide


def shift_by_rays_seen_twice(scan: Scan) -> AxisShift:
    """Returns the panel's shift along u under which rays and their opposites agree best, its deviation by a jackknife over
    the views, and the mean squared differences (n,) in the n views that are compared.

    The shift is NaN for fewer than 24 views, for views more than 10° apart, for columns read one after the other, and if no
    shift within an eighth of the panel is best."""
    if scan.shutter.axis == "columns" and scan.shutter.readout_s > 0:
        return NOT_FOUND  # a ray and its opposite lie on different columns, read at different times
    poses = middle_poses(scan)
    turned, views = np.unique(np.round(np.mod(azimuth_rad(poses), 2 * np.pi), 9), return_index=True)
    if len(turned) < _FEWEST_VIEWS or np.diff(turned, append=turned[0] + 2 * np.pi).max() > WIDEST_STEP_RAD:
        return NOT_FOUND
    some = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MOST_VIEWS)).round().astype(int))
    turned, views = turned[some], views[some]
    frames, pose = _level_rows(scan, views, poses[views[0]]), poses[views[0]]
    block = math.ceil(frames.shape[2] / _COARSE_COLUMNS)
    found = _best(scan, turned, *_binned(frames, pose, block), np.arange(-_MOST_PX, _MOST_PX + _STEP_PX, _STEP_PX))
    if block == 1 or not found.is_found:
        return found
    near = block * found.pixels + np.arange(-_NEAR_PX * block, _NEAR_PX * block + _STEP_PX, _STEP_PX)
    return _best(scan, turned, *_binned(frames, pose, 1), near)


def _level_rows(scan: Scan, views: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Returns the frames (n, few rows, columns) of ``views`` (n,), with only the rows nearest to the plane of the source: in
    this plane, opposite rays meet the same matter. pose (12,): that of one view."""
    rows = scan.projections.shape[1]
    level_mm = pose[5] + np.arange(rows) * pose[11] - (0.0 if scan.is_parallel else pose[2])
    near = np.sort(np.argsort(np.abs(level_mm), kind="stable")[: max(1, min(_MOST_ROWS, rows // 2))])
    frames = np.stack([np.asarray(scan.projections[view], np.float32)[near] for view in views])
    if scan.pixel_mask is not None:
        frames = fill_masked(frames, ~scan.valid[np.ix_(views, near)])
    return frames.astype(np.float64)


def _binned(frames: np.ndarray, pose: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns frames averaged over blocks of ``block`` columns and smoothed, and the pose (12,) of their coarser panel."""
    columns = frames.shape[2] // block
    means = frames[:, :, : columns * block].reshape(*frames.shape[:2], columns, block).mean(-1)
    coarse = pose.copy()
    coarse[3:6] += (block - 1) / 2 * pose[6:9]
    coarse[6:9] *= block
    return np.asarray(gaussian_filter1d(means, SMOOTHING_PX, axis=2)), coarse


def _best(scan: Scan, turned: np.ndarray, frames: np.ndarray, pose: np.ndarray, shifts_px: np.ndarray) -> AxisShift:
    """Returns the best of the shifts ``shifts_px``, in pixels of ``frames``, refined by a parabola. NaN if the first or last
    shift is best, or if fewer than three shifts give rays an opposite."""
    scores, shifts = [], []
    row, columns = np.array([(scan.projections.shape[1] - 1) / 2]), np.arange(frames.shape[2])
    for shift_px in shifts_px:
        moved = pose.copy()
        moved[3:6] += shift_px * pose[6:9]
        rays = pixel_rays(moved, row, columns, scan.is_parallel)
        squares = _mean_squares(turned, frames, fan_angle(moved, rays, scan.is_parallel)[0], scan.is_parallel)
        if squares is not None:
            shifts.append(shift_px)
            scores.append(squares)
    if len(shifts) < 3:
        return NOT_FOUND
    by_view, places = np.array(scores), np.array(shifts)
    parts = np.array_split(np.arange(len(turned)), _BLOCKS)
    some = np.array([_minimum(places, np.delete(by_view, part, axis=1).mean(1)) for part in parts])
    deviation = math.sqrt((_BLOCKS - 1) * float(np.mean((some - some.mean()) ** 2)))
    least = by_view[int(np.argmin(by_view.mean(1)))]
    return AxisShift(_minimum(places, by_view.mean(1)), math.hypot(deviation, _BIAS_PX), least)


def _mean_squares(turned: np.ndarray, frames: np.ndarray, fan: np.ndarray, is_parallel: bool) -> np.ndarray | None:
    """Returns each view's mean squared difference (F,) of rays and their opposites; None if the axis lies less than a pixel
    inside the outer columns. turned (F,): angles of the views in rad. fan (columns,): ``fan_angle`` of the columns."""
    columns = np.arange(fan.size)
    if fan[-1] < fan[0]:
        fan, columns = fan[::-1], columns[::-1]
    pixel = float(np.median(np.diff(fan)))
    reach = min(-fan[0], fan[-1]) / pixel
    if reach < _LEAST_PX:
        return None
    pairs = np.unique(np.linspace(-np.floor(reach), np.floor(reach), min(2 * int(reach) + 1, _MOST_PAIRS)).round())
    total, whole = np.zeros(len(turned)), np.append(turned, turned[0] + 2 * np.pi)
    for angle in pairs * pixel:
        ray, opposite = (_at_column(frames, float(np.interp(one, fan, columns))) for one in (angle, -angle))
        around = CubicSpline(whole, np.append(opposite, opposite[:1], 0), bc_type="periodic")
        total += ((ray - around(turned + np.pi + (0.0 if is_parallel else 2 * angle))) ** 2).mean(1)
    return total / len(pairs)


def _at_column(frames: np.ndarray, column: float) -> np.ndarray:
    """Returns the frames' values (F, rows) at a fractional ``column``, on the cubic through the four columns around it."""
    low = int(np.clip(np.floor(column), 1, frames.shape[2] - 3))
    t = column - low
    weights = np.array([
        -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6,
    ])  # fmt: skip
    return np.asarray(frames[:, :, low - 1 : low + 3] @ weights)


def _minimum(places: np.ndarray, scores: np.ndarray) -> float:
    least = int(np.argmin(scores))
    if least in (0, len(scores) - 1):
        return math.nan
    near = slice(least - 1, least + 2)
    return lowest(places[near], scores[near])
