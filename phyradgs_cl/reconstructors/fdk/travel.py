"""FDK where some views miss voxels: at the ends of a volume, and in helices and other orbits that travel along z. Each voxel
is computed only from the views that see it.

At the ends of a volume (``all_over_seen``) a voxel takes the mean of the views that see it. If the orbit travels along z
(``seen_volume``), voxels at different heights are seen by different views, in some directions twice, in others once. So the
rays' directions about z are sorted into overlapping classes. In each class a voxel takes the mean of the views that see it,
weighted by the width of the class. A ray's weight falls towards the panel's first and last rows. After K. Stierstorfer et
al., Phys. Med. Biol. 49 (2004) 2209, with classes of directions in place of rebinned rays."""

import logging
from collections.abc import Callable

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject
from phyradgs_cl.operators.rays.layout import voxel_matrices
from phyradgs_cl.reconstructors.fdk import weights
from phyradgs_cl.reconstructors.fdk.frames import extended
from phyradgs_cl.reconstructors.fdk.views import pose_of_pixels, view_angles
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
_SAME_ROW = 1e-4  # a voxel at most this far beyond the outermost row's view, in slices, counts as seen by that row
_PLACES = 33  # most places along a side at which smooth sums over the views are computed, to be interpolated
_ENDLESS = 1e4  # width in pixels of the columns in ``all_over_seen``: so wide that every voxel projects into one of them
Backproject = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A function from frames (n, rows, columns) and the numbers (n,) of their views to a volume (z, y, x)."""


def travels(pose: np.ndarray, rows: int, is_parallel: bool) -> bool:
    """Returns whether poses (F, r, c, 12) travel so far along the axis that some views miss voxels: whether the image of the
    origin moves by more than one row and by more than 5 % of the ``rows``."""
    middle = pose[:, pose.shape[1] // 2, pose.shape[2] // 2]
    first, across = middle[:, 3:6], np.cross(middle[:, 6:9], middle[:, 9:12])
    source = middle[:, :3]
    if is_parallel:
        hit = source * ((first * across).sum(-1) / (source * across).sum(-1))[:, None]
    else:
        hit = source - source * (((first - source) * across).sum(-1) / (-source * across).sum(-1))[:, None]
    along = np.cross(across, middle[:, 6:9])
    row = ((hit - first) * along).sum(-1) / (middle[:, 9:12] * along).sum(-1)
    return bool(np.ptp(row) > max(1.0, _TRAVEL * rows))


def still_along_z(canonical: np.ndarray, is_parallel: bool) -> np.ndarray:
    """Returns poses (F, r, c, 12) moved along z until the source (in a parallel beam, the first pixel) is at height 0. Ray
    weights do not depend on the height."""
    level = canonical.copy()
    level[..., 5] -= canonical[..., 5 if is_parallel else 2]
    if not is_parallel:
        level[..., 2] = 0
    return level


def seen_volume(
    frames: np.ndarray, pose: np.ndarray, axis: str, grid: Grid, is_displaced: bool, is_parallel: bool,
    counted: Callable[[int], np.ndarray | float], of_views: Backproject, of_views_seen: Backproject,
) -> np.ndarray:  # fmt: skip
    """Returns the volume (nz, ny, nx) of filtered frames (F, rows, columns), in which each voxel is normalised by the views
    that see it.

    pose (F, 12) or (F, lines, 12) mm. counted: returns a view's redundancy weights (rows, columns). Both backprojections
    weight each view by the angle for which it stands. ``of_views_seen`` divides by the distance, not by its square."""
    by_pixel, shape = pose_of_pixels(pose, axis), frames.shape[1:]
    angle_rad, pace = _directions(by_pixel[:, [by_pixel.shape[1] // 2]], shape, is_parallel)
    turn_rad = 2 * np.pi if is_displaced else np.pi  # a centred panel measures every ray in half a turn
    views_a_turn = np.unique(np.round(np.mod(view_angles(by_pixel), 2 * np.pi), 6)).size
    width_rad = turn_rad / max(4, round(turn_rad / max(_CLASS_RAD, _VIEWS_A_CLASS * 2 * np.pi / views_a_turn)))
    classes, place = round(turn_rad / width_rad), np.mod(angle_rad, turn_rad) / width_rad
    name = "FBP" if is_parallel else "FDK"
    _warn_if_few_views(min(views_a_turn, _views_a_turn(view_angles(by_pixel))), name)
    row_weight = _row_weight(shape[0])[:, None]
    volume, covered = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    for number in range(classes):
        apart = np.abs(place - number)
        part = np.maximum(1 - np.minimum(apart, classes - apart), 0)
        views = np.flatnonzero(part.any(axis=(1, 2)))
        if not views.size:
            continue
        weight = (part[views] * row_weight).astype(np.float32)
        values = of_views(frames[views] * weight, views)
        for i, view in enumerate(views.tolist()):
            weight[i] *= pace[view] * counted(view)
        seen = of_views_seen(weight, views) * np.float32(2 / width_rad)
        volume += values / np.maximum(seen, _LEAST_SHARE) * np.float32(2 * np.pi / turn_rad)
        covered += np.minimum(seen / _LEAST_SHARE, 1)
    _warn_if_unseen(covered / classes, name, "a" if is_displaced else "half a")
    return volume * np.divide(classes, covered, out=np.zeros_like(covered), where=covered > 0)


def fill_ends(
    rt: Runtime, volume: np.ndarray, slices: list[tuple[int, int]], pose: np.ndarray, shape: tuple[int, int],
    weight: np.ndarray, grid: Grid, is_parallel: bool,
) -> None:  # fmt: skip
    """Multiplies the ``slices`` of FDK's volume (nz, ny, nx) by ``all_over_seen``, in place. pose (F, 12) mm, or (F, lines,
    12), of which the middle line's tells which slices a view sees. Other arguments: as in ``all_over_seen``."""
    middle = pose if pose.ndim == 2 else pose[:, pose.shape[1] // 2]
    for start, stop in slices:
        slab = grid.part((start, 0, 0), (stop - start, *grid.shape[1:]))
        volume[start:stop] *= all_over_seen(rt, middle, shape, weight, slab, is_parallel)


def all_over_seen(
    rt: Runtime, pose: np.ndarray, shape: tuple[int, int], weight: np.ndarray, grid: Grid, is_parallel: bool
) -> np.ndarray:
    """Returns the factor (nz, ny, nx) for voxels that some views miss, at most 2: (sum of the weights of all views)/(sum
    of the weights of the views that see the voxel). A view counts less and less up to one row beyond the panel.

    pose (F, 12) in mm of a panel of ``shape`` (rows, columns); weight (F,): the views' factors in the backprojection."""
    rows, columns = shape
    wide = pose.copy()  # three columns so wide that every voxel projects into them
    wide[:, 3:6] += ((columns - 1) / 2 - _ENDLESS) * pose[:, 6:9]
    wide[:, 6:9] *= _ENDLESS
    ones = np.zeros((len(pose), rows + 2, 3), np.float32)
    ones[:, 1:-1] = 1
    taller = extended(wide, "rows", (1, 1), "rows")
    seen = backproject(rt, ones, taller, weight, grid, is_parallel=is_parallel, is_even=True)
    of_all = _distance_weights(pose, weight, grid, is_parallel)
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


def ends(pose: np.ndarray, rows: int, grid: Grid, radius_mm: float, is_parallel: bool) -> list[tuple[int, int]]:
    """Returns up to two ranges [start, stop) of slices, at the ends of the grid, in which some view misses a voxel within
    ``radius_mm`` of the axis. pose (F, 12) mm, or (F, lines, 12)."""
    pose = pose if pose.ndim == 2 else np.concatenate([pose[:, 0], pose[:, -1]])
    at_rad = 2 * np.pi * np.arange(_AROUND) / _AROUND
    rim_mm = radius_mm * np.stack([np.cos(at_rad), np.sin(at_rad)])
    x, y = (
        (np.clip(rim, *grid.box_mm[k]) - grid.first_centre_mm[k]) / grid.voxel_size_mm[k]
        for k, rim in zip((2, 1), rim_mm, strict=True)
    )
    m = voxel_matrices(pose, grid, is_parallel)[:, :, None]
    # v · depth and depth are linear in z: each has a value in slice 0, (F, rim), and a change from slice to slice, (F, 1)
    (v, v_step), (depth, depth_step) = ((m[:, i] * x + m[:, i + 1] * y + m[:, i + 3], m[:, i + 2]) for i in (4, 8))
    low, high = -np.inf, np.inf
    for start, step in ((v, v_step), ((rows - 1) * depth - v, (rows - 1) * depth_step - v_step)):  # both ≥ 0 if seen
        root = -start / np.where(step == 0, np.inf, step)
        low = max(low, np.max(root, initial=-np.inf, where=step > 0))
        high = min(high, np.min(root, initial=np.inf, where=step < 0))
        if np.any((step == 0) & (start < 0)):
            high = -np.inf
    slices = grid.shape[0]
    first = int(np.clip(np.ceil(low - _SAME_ROW), 0, slices))
    last = int(np.clip(np.floor(high + _SAME_ROW) + 1, first, slices))
    return [(start, stop) for start, stop in ((0, first), (last, slices)) if start < stop]


def _directions(pose: np.ndarray, shape: tuple[int, int], is_parallel: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns the angles in rad about z (F, 1, columns) of the rays of poses (F, 1, c, 12), and d(angle of the ray)/d(angle
    of the source), of the same shape, for the ray from the turning source to a fixed point at the pixel."""
    rays = weights.pixel_rays(pose, np.array([shape[0] // 2]), np.arange(shape[1]))
    if is_parallel:
        angle_rad = np.broadcast_to(np.arctan2(pose[..., 1], pose[..., 0]), rays.shape[:-1])
        return angle_rad, np.ones_like(angle_rad)
    pace = np.abs(pose[..., 0] * rays[..., 0] + pose[..., 1] * rays[..., 1]) / (rays[..., :2] ** 2).sum(-1)
    return np.arctan2(rays[..., 1], rays[..., 0]), pace


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


def _warn_if_few_views(views_a_turn: float, name: str) -> None:
    if views_a_turn < _FEW_VIEWS - 0.5:
        text = "%s: %.0f views a turn are few for a helix: densities may be 5 %% wrong at 17 views, 20 %% at 7; take %d"
        log.warning(text, name, views_a_turn, _FEW_VIEWS)


def _warn_if_unseen(covered: np.ndarray, name: str, turn: str) -> None:
    """Warns of voxels that too few views see. covered (nz, ny, nx): fraction of the needed directions that see a voxel."""
    share = float((covered < 1 - 1e-3).mean())
    if share > _NAMED:
        text = "%s: %.0f %% of the voxels are seen from less than %s turn, the least from %.0f°: their densities are wrong"
        log.warning(text, name, 100 * share, turn, (360 if turn == "a" else 180) * float(covered.min()))
