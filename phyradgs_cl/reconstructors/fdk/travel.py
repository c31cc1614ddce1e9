"""FDK where some views miss voxels: at the ends of a volume, and in helices and other orbits that travel along z. Each voxel
is computed only from the views that see it.

At the ends of a volume (``all_over_seen``) a voxel takes the mean of the views that see it. If the orbit travels along z
(``seen_volume``), voxels at different heights are seen by different views, in some directions twice, in others once. So the
rays' directions about z are sorted into overlapping classes. In each class a voxel takes the mean of the views that see it,
weighted by the width of the class. A ray's weight falls towards the panel's first and last rows. After K. Stierstorfer et
al., Phys. Med. Biol. 49 (2004) 2209, with classes of directions in place of rebinned rays."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition.altered.angles import azimuth_rad
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject
from phyradgs_cl.operators.rays.layout import voxel_matrices
from phyradgs_cl.operators.splats.layout import projection_matrices
from phyradgs_cl.reconstructors.fdk import weights
from phyradgs_cl.reconstructors.fdk.views import Views, opposite_weight
from phyradgs_cl.runtime import Runtime

log = logging.getLogger(__name__)

# An orbit travels along z if the image of the origin moves by more than this fraction of the panel's height, and by more
# than one row. Less travel only matters at the ends of the volume.
_TRAVEL = 0.05
_CLASS_RAD = np.deg2rad(15)  # angular width of a class of ray directions about z, unless views are few
_VIEWS_A_CLASS = 2.0  # classes are made so wide that each contains at least this many views of one turn
_EVEN = 0.5  # rows at most this fraction of the panel's half height away from its middle have full weight
_LEAST_ROW = 0.02  # least weight of a row: some voxels are seen by the outermost row alone
_LEAST_SHARE = 0.01  # a class counts fully for a voxel if the voxel is seen from at least this fraction of its directions
_NAMED = 0.01  # a warning comes if more than this fraction of the voxels lack views from some directions
_FEW_VIEWS = 24  # fewer views per turn cause a warning: with 24, densities of balls are within 2 %
_ENOUGH = 0.5  # voxels that fewer views see than this fraction have incomplete data: their density falls towards 0
_AROUND = 32  # number of points on the rim of the field of view at which ``ends`` tests whether all views see a slice
_SAME_ROW = 5e-4  # a voxel at most this far beyond the outermost row, in rows, counts as seen: less than kernels allow
_PLACES = 33  # most places along a side at which smooth sums over the views are computed, to be interpolated
_ENDLESS = 1e4  # width in pixels of the columns in ``all_over_seen``: so wide that every voxel projects into one of them


def travels(pose: np.ndarray, rows: int, is_parallel: bool) -> bool:
    """Returns whether poses (F, 12) travel so far along the axis that some views miss voxels: whether the image of the
    origin moves by more than one row and by more than 5 % of the ``rows``."""
    of_origin = projection_matrices(pose, is_parallel)[:, 3::4]
    return bool(np.ptp(of_origin[:, 1] / of_origin[:, 2]) > max(1.0, _TRAVEL * rows))


def seen_volume(
    frames: np.ndarray, views: Views, wide: Views, grid: Grid, of_views: Callable[..., np.ndarray]
) -> np.ndarray:
    """Returns the volume (nz, ny, nx) of filtered frames (F, rows, columns) with the poses of ``wide``, in which each voxel
    is normalised by the views that see it.

    views: as measured, without the columns that hold the filter's response. of_views: backprojects frames (n, rows, columns)
    of the views numbered (n,), each weighted by the angle for which it stands, and divides by the distance to the ``power``,
    1 or, by default, 2."""
    rows, name, counted = wide.shape[0], views.name, opposite_weight(views)
    angle_rad, pace = _directions(wide)
    # a centred panel measures every ray in half a turn
    turn_rad, turn = (2 * np.pi, "a") if views.fan.is_displaced else (np.pi, "half a")
    views_a_turn = np.unique(np.round(np.mod(views.angle_rad, 2 * np.pi), 6)).size
    width_rad = turn_rad / max(4, round(turn_rad / max(_CLASS_RAD, _VIEWS_A_CLASS * 2 * np.pi / views_a_turn)))
    classes, place = round(turn_rad / width_rad), np.mod(angle_rad, turn_rad) / width_rad
    if (fewest := min(views_a_turn, _views_a_turn(views.angle_rad))) < _FEW_VIEWS - 0.5:
        text = "%s: %.0f views a turn are few for a helix: densities may be 5 %% wrong at 17 views, 20 %% at 7; take %d"
        log.warning(text, name, fewest, _FEW_VIEWS)
    row_weight = _row_weight(rows)[:, None]
    volume, covered = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    for number in range(classes):
        apart = np.abs(place - number)
        part = np.maximum(1 - np.minimum(apart, classes - apart), 0)
        chosen = np.flatnonzero(part.any(axis=(1, 2)))
        if not chosen.size:
            continue
        weight = (part[chosen] * row_weight).astype(np.float32)
        values = of_views(frames[chosen] * weight, chosen)
        for i, view in enumerate(chosen.tolist()):
            weight[i] *= pace[view] * counted(view)
        seen = of_views(weight, chosen, power=1) * np.float32(2 / width_rad)
        volume += values / np.maximum(seen, _LEAST_SHARE) * np.float32(2 * np.pi / turn_rad)
        covered += np.minimum(seen / _LEAST_SHARE, 1)
    share = float((covered / classes < 1 - 1e-3).mean())
    if share > _NAMED:
        text = "%s: %.0f %% of the voxels are seen from less than %s turn, the least from %.0f°: their densities are wrong"
        log.warning(text, name, 100 * share, turn, np.rad2deg(turn_rad) * float(covered.min() / classes))
    return volume * np.divide(classes, covered, out=np.zeros_like(covered), where=covered > 0)


def fill_ends(
    rt: Runtime, volume: np.ndarray, slices: list[tuple[int, int]], views: Views, wide: Views, share: np.ndarray,
    grid: Grid,
) -> None:
    """Multiplies the ``slices`` of FDK's volume (nz, ny, nx) by ``all_over_seen``, in place. share (F,): factors of the
    views in the backprojection. views, wide: as in ``seen_volume``. A view's middle line tells which slices it sees."""
    counted = opposite_weight(views, one_row=True)
    weight = share * [np.mean(counted(view)) for view in range(len(share))]
    for start, stop in slices:
        slab = grid.part((start, 0, 0), (stop - start, *grid.shape[1:]))
        volume[start:stop] *= all_over_seen(rt, replace(wide, pose=wide.middle), weight, slab)


def all_over_seen(rt: Runtime, views: Views, weight: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns the factor (nz, ny, nx) for voxels that some views miss, at most 2: (sum of the weights of all views)/(sum
    of the weights of the views that see the voxel). A view counts less and less up to one row beyond the panel.

    views: with one pose each. weight (F,): the views' factors in the backprojection."""
    (rows, columns), pose = views.shape, views.pose
    wide = pose.copy()  # three columns so wide that every voxel projects into them
    wide[:, 3:6] += ((columns - 1) / 2 - _ENDLESS) * pose[:, 6:9]
    wide[:, 6:9] *= _ENDLESS
    taller = replace(views, pose=wide, shape=(rows, 3)).extended((1, 1), "rows")
    ones = np.zeros((len(pose), *taller.shape), np.float32)
    ones[:, 1:-1] = 1
    seen = backproject(rt, ones, taller.pose, weight, grid, is_parallel=views.is_parallel, is_even=True)
    of_all = _distance_weights(pose, weight, grid, views.is_parallel)
    enough = np.maximum(seen, _ENOUGH * of_all)
    return np.divide(of_all, enough, out=np.zeros_like(seen), where=enough > 0)


def _distance_weights(pose: np.ndarray, weight: np.ndarray, grid: Grid, is_parallel: bool) -> np.ndarray:
    """Returns Σ ``weight`` / z² over the views, (ny, nx) float32, in the grid's middle slice. weight: (F,). pose: (F, 12). z
    is a voxel's depth, as in ``backproject``. The sums are smooth, and are therefore interpolated between few places."""
    nz, *sides = grid.shape
    y, x = (np.linspace(0, side - 1, min(side, _PLACES)) for side in sides)
    m = voxel_matrices(pose, grid, is_parallel)[:, 8:, None, None]
    depth = m[:, 0] * x + m[:, 1] * y[:, None] + m[:, 2] * (nz - 1) / 2 + m[:, 3]
    sums = np.einsum("f,fyx->yx", weight, np.divide(1, depth**2, out=np.zeros_like(depth), where=depth > 0))
    for places, side in ((y, sides[0]), (x, sides[1])):  # each pass interpolates along the first axis, then transposes
        sums = np.array([np.interp(np.arange(side), places, line) for line in sums.T])
    return sums.astype(np.float32)


def ends(views: Views, grid: Grid) -> list[tuple[int, int]]:
    """Returns up to two ranges [start, stop) of slices, at the ends of the grid, in which some view misses a voxel in the
    circle about the axis that the panel sees."""
    rows, pose = views.shape[0], views.pose
    pose = pose if pose.ndim == 2 else np.concatenate([pose[:, 0], pose[:, -1]])
    at_rad = 2 * np.pi * np.arange(_AROUND) / _AROUND
    rim_mm = views.seen_mm * np.stack([np.cos(at_rad), np.sin(at_rad)])
    x, y = (
        (np.clip(rim, *grid.box_mm[k]) - grid.first_centre_mm[k]) / grid.voxel_size_mm[k]
        for k, rim in zip((2, 1), rim_mm, strict=True)
    )
    m = voxel_matrices(pose, grid, views.is_parallel)[:, :, None]
    # v · depth and depth are linear in z: each has a value in slice 0, (F, rim), and a change from slice to slice, (F, 1)
    (v, v_step), (depth, depth_step) = ((m[:, i] * x + m[:, i + 1] * y + m[:, i + 3], m[:, i + 2]) for i in (4, 8))
    low, high = -np.inf, np.inf
    v, v_step, most = v + _SAME_ROW * depth, v_step + _SAME_ROW * depth_step, rows - 1 + 2 * _SAME_ROW
    for start, step in ((v, v_step), (most * depth - v, most * depth_step - v_step)):  # both ≥ 0 if seen
        root = -start / np.where(step == 0, np.inf, step)
        low = max(low, np.max(root, initial=-np.inf, where=step > 0))
        high = min(high, np.min(root, initial=np.inf, where=step < 0))
        if np.any((step == 0) & (start < 0)):
            high = -np.inf
    slices = grid.shape[0]
    first = int(np.clip(np.ceil(low), 0, slices))
    last = int(np.clip(np.floor(high) + 1, first, slices))
    return [(start, stop) for start, stop in ((0, first), (last, slices)) if start < stop]


def _directions(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Returns the angles in rad about z (F, 1, columns) of the rays of each view's middle row, and d(angle of the ray)/
    d(angle of the source), of the same shape, for the ray from the turning source to a fixed point at the pixel."""
    (rows, columns), pose = views.shape, views.by_pixel
    pose = pose[:, [pose.shape[1] // 2]]
    rays = weights.pixel_rays(pose, np.array([rows // 2]), np.arange(columns))
    if views.is_parallel:
        angle_rad = np.broadcast_to(azimuth_rad(pose), rays.shape[:-1])
        return angle_rad, np.ones_like(angle_rad)
    pace = np.abs(pose[..., 0] * rays[..., 0] + pose[..., 1] * rays[..., 1]) / (rays[..., :2] ** 2).sum(-1)
    return azimuth_rad(rays), pace


def _row_weight(rows: int) -> np.ndarray:
    """Returns the weights (rows,) of the panel's rows: 1 in the middle, falling as cos² to 0.02 at both outermost rows."""
    away = np.abs(np.arange(rows) - (rows - 1) / 2) / max((rows - 1) / 2, 0.5)
    falling = np.cos(np.pi / 2 * np.clip((away - _EVEN) / (1 - _EVEN), 0, 1)) ** 2
    return np.maximum(falling, _LEAST_ROW)


def _views_a_turn(angle_rad: np.ndarray) -> float:
    """Returns how many consecutive views at angles (F,) in rad make a turn; infinity if their median step is 90° or more."""
    steps_rad = np.abs(np.angle(np.exp(1j * np.diff(angle_rad))))
    step_rad = float(np.median(steps_rad)) if steps_rad.size else 0.0
    return 2 * np.pi / step_rad if 0 < step_rad < np.pi / 2 else np.inf
