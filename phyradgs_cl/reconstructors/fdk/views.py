"""The views of an FDK reconstruction: their poses, what they miss, whether their orbit is a circle, and the weights of
their pixels before filtering."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from phyradgs_cl.acquisition.altered.angles import azimuth_rad, wrapped
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import weights
from phyradgs_cl.reconstructors.fdk.arc import FILLED_RAD, Arc, view_arc

log = logging.getLogger(__name__)

_ANY_ORBIT = "take an iterative or splatting method: they take any orbit"
_STANDING = "exchange rows and columns if the panel stands on its side; iterative methods take any panel"
# Limits of an orbit, in pairs. Beyond the first limit a warning is logged; beyond the second, _NO_…, InputError is raised.
_CIRCLE = 0.05  # (distance of source or panel from a circle about z)/(distance from source to panel)
_NO_CIRCLE = 0.5
_PLANE_DEG = 10.0  # angle between the plane z = 0 and the line from the origin to the source
_NO_PLANE_DEG = 45.0
_LEAN_DEG = 0.5  # angle of parallel rays, or of their detector rows, from the plane of the rotation
_NO_LEAN_DEG = 10.0  # densities of a cone beam are 1.5 % too low at 10°, and 0 at 90°
_ROLL_DEG = 3.0  # angle of a cone beam's detector rows from the plane of the rotation: at 3° densities are 0.1 % too low
_UNLIKE = 0.1  # a warning comes if the fan's ends differ among the views by more than this fraction of the fan
_LEAST_OVERLAP = 2.0  # a warning comes if a displaced panel reaches less than this many columns beyond the axis
# A smaller missing angle causes no warning: nearly parallel rays have so narrow a fan that half a turn is enough.
_TOLERATED_RAD = np.deg2rad(0.5)
_PARTS = 16  # a short scan's weights are averaged over this many parts of a view's angular step
# Views share their ray weights if their poses, rotated back to one angle, differ by at most this fraction.
_SAME_POSE = 1e-9
# Gaps up to this width are filled for a panel displaced on purpose, whose strip of rays measured once is wide. For wider
# gaps short-scan weights were 0.2 to 10 dB better.
_FILLED_ASIDE_RAD = np.deg2rad(65)
RayWeight = Callable[[int], np.ndarray]


@dataclass(frozen=True, eq=False)
class Views:
    """The poses of frames of ``shape`` (rows, columns), and what follows from them. pose: (F, 12) mm, or (F, lines, 12) with
    a pose for every line along ``axis``. Weights of rays depend on ``canonical``, not on the gantry's angle or height."""

    pose: np.ndarray
    shape: tuple[int, int]
    axis: str = "rows"
    is_parallel: bool = False

    @property
    def name(self) -> str:
        return "FBP" if self.is_parallel else "FDK"

    @property
    def middle(self) -> np.ndarray:
        """The pose (F, 12) of each frame's middle line."""
        return self.pose if self.pose.ndim == 2 else self.pose[:, self.pose.shape[1] // 2]

    @property
    def by_pixel(self) -> np.ndarray:
        """The poses in a shape that broadcasts to (F, rows, columns, 12)."""
        if self.pose.ndim == 2:
            return self.pose[:, None, None]
        return self.pose[:, :, None] if self.axis == "rows" else self.pose[:, None]

    @cached_property
    def angle_rad(self) -> np.ndarray:
        """Each view's gantry angle (F,) in rad, the mean over the poses of its pixels."""
        angle_rad = azimuth_rad(self.by_pixel)
        first = angle_rad[:, :1, :1]
        return (first + wrapped(angle_rad - first).mean(axis=(1, 2), keepdims=True))[:, 0, 0]

    @cached_property
    def canonical(self) -> np.ndarray:
        """``by_pixel`` rotated about z to one gantry angle, and moved along z until the source (in a parallel beam, the
        first pixel) is at height 0. If all views are then equal, as on a circular orbit, the first axis has length 1. Raises
        InputError for a source on the rotation axis."""
        by_pixel = self.by_pixel
        if np.any(np.hypot(by_pixel[..., 0], by_pixel[..., 1]) <= 0):
            raise InputError("poses", "a source on the rotation axis", "a source beside it")
        level = weights.turned_back(by_pixel, self.angle_rad)
        level[..., 5] -= level[..., 5 if self.is_parallel else 2]
        if not self.is_parallel:
            level[..., 2] = 0
        return level[:1] if np.ptp(level, axis=0).max() <= _SAME_POSE * np.abs(level).max() else level

    @cached_property
    def fan(self) -> weights.Fan:
        """The fan that all views see."""
        return weights.measured_fan(self.canonical, self.shape, self.is_parallel)

    @cached_property
    def arc(self) -> Arc:
        """The arc that the views cover. Gaps are filled up to 65° for a panel displaced on purpose, and up to 15° for a
        misaligned panel, because some of a gap's rays then have no opposite; never for a symmetric panel."""
        fan = self.fan
        filled_rad = _FILLED_ASIDE_RAD if fan.is_put_aside else FILLED_RAD if fan.is_displaced else 0.0
        return view_arc(self.angle_rad, filled_rad)

    @property
    def seen_mm(self) -> float:
        """The radius of the circle about the axis that the panel's wider side sees, up to the middle of its last pixel."""
        source = float(np.linalg.norm(self.canonical[0, 0, 0, :2]))
        return self.fan.half_rad if self.is_parallel else source * np.sin(self.fan.half_rad)

    def extended(self, more: tuple[int, int], side: str = "columns") -> "Views":
        """Returns the views with ``more`` (first, last) "columns" or "rows" (``side``) at the ends of their frames."""
        if more == (0, 0):
            return self
        pose, (rows, columns), step = self.pose, self.shape, 6 if side == "columns" else 9
        if pose.ndim == 3 and self.axis == side:
            pose = np.pad(pose, ((0, 0), more, (0, 0)), mode="edge")
        moved = pose.copy()
        moved[..., 3:6] -= more[0] * pose[..., step : step + 3]
        shape = (rows, columns + sum(more)) if side == "columns" else (rows + sum(more), columns)
        return replace(self, pose=moved, shape=shape)


def ray_weight(views: Views) -> RayWeight:
    """Returns a function from a view's index to the weights (rows, columns), in 1/mm, of its pixels before filtering."""
    canonical, arc, (rows, columns) = views.canonical, views.arc, map(np.arange, views.shape)

    def geometry(view: int) -> tuple[np.ndarray, np.ndarray]:
        pose = canonical[view]
        rays = weights.pixel_rays(pose, rows, columns, views.is_parallel)
        pitch_mm = np.linalg.norm(pose[..., 6:9], axis=-1)
        measure = weights.ray_measure(pose, rays, views.is_parallel) / pitch_mm
        return measure, _redundancy_angle(pose, rays, arc, views.is_parallel)

    first, is_same = geometry(0), len(canonical) == 1

    def weight(view: int) -> np.ndarray:
        measure, angle_rad = first if is_same else geometry(view)
        return _redundancy(view, angle_rad, arc, views.fan) * measure

    constant = weight(0) if arc.is_full and is_same else None
    return weight if constant is None else lambda view: constant


def opposite_weight(views: Views, one_row: bool = False) -> Callable[[int], np.ndarray | float]:
    """Returns a function from a view's index to its redundancy weights (rows, columns), 1.0 in a full turn. The weights of a
    ray and its opposite sum to 2. A displaced detector is not considered. one_row: of the middle row, (1, columns)."""
    canonical, arc, (rows, columns) = views.canonical, views.arc, map(np.arange, views.shape)
    if one_row:
        canonical, rows = canonical[:, [canonical.shape[1] // 2]], rows[:1]

    def weight(view: int) -> np.ndarray | float:
        if arc.is_full:
            return 1.0
        pose = canonical[view % len(canonical)]
        rays = weights.pixel_rays(pose, rows, columns, views.is_parallel)
        return _redundancy(view, _redundancy_angle(pose, rays, arc, views.is_parallel), arc, weights.Fan(0.0, 0.0))

    return weight


def _redundancy(view: int, angle_rad: np.ndarray, arc: Arc, fan: weights.Fan) -> np.ndarray | float:
    progress_rad, gap_rad = float(arc.progress_rad[view]), float(arc.gap_rad[view])
    if len(arc.parts_rad) > 1:
        return weights.parted_weight(progress_rad, angle_rad, arc.parts_rad)
    if not arc.is_full:
        # A view stands for an angular step. If the step exceeds half of (arc − half a turn), weights are averaged over it.
        is_coarse = gap_rad > (arc.coverage_rad - np.pi) / 2 > 0
        within = gap_rad * (np.arange(_PARTS) - (_PARTS - 1) / 2) / _PARTS if is_coarse else (0.0,)
        at_rad = np.clip(progress_rad + np.asarray(within), 0, arc.coverage_rad)
        return sum(weights.short_scan_weight(at, angle_rad, arc.coverage_rad) for at in at_rad) / len(at_rad)
    return weights.displaced_weight(angle_rad, fan) if fan.is_displaced else 1.0


def _redundancy_angle(pose: np.ndarray, rays: np.ndarray, arc: Arc, is_parallel: bool) -> np.ndarray:
    """Returns the fan angle (rows, columns) that determines a ray's opposite. For a short scan of a parallel beam it is 0,
    for a full turn of a parallel beam the distance in mm from the axis.

    If columns are read out one after the other, each has its own gantry angle. A short scan then begins at another angle for
    each column, and a ray's opposite lies on another column. So the column's angle relative to the frame's is added."""
    angle_rad = weights.fan_angle(pose, rays, is_parallel)
    if is_parallel and not arc.is_full:
        angle_rad = np.zeros_like(angle_rad)
    if arc.is_full or pose.shape[1] == 1:
        return angle_rad
    return angle_rad + azimuth_rad(pose)


def check_beam(method: str, pose: np.ndarray, is_parallel: bool) -> None:
    """Raises InputError for ``fdk`` in a parallel beam, for ``fbp`` in a cone beam, and for orbits that ``method`` cannot
    reconstruct. Logs a warning for poses (F, 12) or (F, lines, 12) so far from a circle about z that accuracy suffers."""
    if is_parallel != (method == "fbp"):
        found, expected, remedy = ("parallel", "cone", "fbp") if is_parallel else ("cone", "parallel", "fdk")
        raise InputError(f"--method {method}", f"a {found} beam", f"a {expected} beam", f"take --method {remedy}")
    if not is_parallel:
        _check_orbit(pose)
    _check_lean(pose, is_parallel)


def _check_lean(pose: np.ndarray, is_parallel: bool) -> None:
    """Raises InputError, or warns, if detector rows, along which FDK and FBP filter, or parallel rays leave the plane of
    rotation."""
    lean_deg = float(np.rad2deg(np.arctan2(np.abs(pose[..., 8]), np.linalg.norm(pose[..., 6:8], axis=-1))).max())
    method, what, least_deg, remedy = "fdk", "detector rows", _ROLL_DEG, _STANDING
    if is_parallel:
        method, what, least_deg, remedy = "fbp", "rays or detector rows", _LEAN_DEG, _ANY_ORBIT
        lean_deg = max(lean_deg, float(np.rad2deg(np.arcsin(np.clip(np.abs(pose[..., 2]), 0, 1))).max()))
    if lean_deg > _NO_LEAN_DEG:
        found = f"{what} {lean_deg:.1f}° off the plane of the rotation{' (laminography?)' if is_parallel else ''}"
        raise InputError(f"--method {method}", found, f"at most {_NO_LEAN_DEG:.0f}°", remedy)
    if lean_deg > least_deg:
        text = "%s: %s %.2f° off the plane of the rotation: the volume is an approximation; %s"
        log.warning(text, method.upper(), what, lean_deg, _ANY_ORBIT)


def _check_orbit(pose: np.ndarray) -> None:
    middle = pose if pose.ndim == 2 else pose[:, pose.shape[1] // 2]
    canonical = weights.turned_back(middle, azimuth_rad(middle)).reshape(-1, 4, 3)
    usual = np.median(canonical, axis=0)
    length_mm = float(np.linalg.norm(usual[1] - usual[0]))
    off_mm = canonical[:, :2] - usual[:2]  # offsets of source and panel from their median positions in the turned poses
    aside_mm = off_mm - np.eye(3)[2] * off_mm[:, :1, 2:]  # without travel along z, which only makes voxels miss views
    above_deg = float(np.rad2deg(np.arctan2(abs(usual[0, 2]), np.hypot(*usual[0, :2]))))

    def distances_beyond(most: float, most_deg: float, of_mm: np.ndarray) -> str:
        off = float(np.linalg.norm(of_mm, axis=-1).max()) / length_mm
        parts = [f"{100 * off:.0f} % of their distance off a circle about z"] if off > most else []
        parts += [f"{above_deg:.0f}° above the middle of their circle"] if above_deg > most_deg else []
        return " and ".join(parts)

    if found := distances_beyond(_NO_CIRCLE, _NO_PLANE_DEG, aside_mm):
        expected = f"at most {100 * _NO_CIRCLE:.0f} % off it and {_NO_PLANE_DEG:.0f}° above"
        raise InputError("--method fdk", f"source and panel up to {found}", expected, _ANY_ORBIT)
    if found := distances_beyond(_CIRCLE, _PLANE_DEG, off_mm):
        text = "FDK: source and panel up to %s: the volume is an approximation; %s"
        log.warning(text, found, _ANY_ORBIT)


def warn_if_incomplete(views: Views, grid: Grid) -> None:
    """Logs a warning for each kind of data that the views do not measure."""
    name, arc, fan = views.name, views.arc, views.fan
    if np.unique(arc.progress_rad).size == 1:
        log.warning("%s: all views are from one angle: the volume is a single backprojection", name)
        return
    if not arc.is_full:
        _warn_of_short_scan(views, grid)
    elif not fan.sees_axis:
        log.warning("%s: the detector does not see the rotation axis; the middle of the volume is not measured", name)
    elif fan.is_displaced and fan.overlap_columns < _LEAST_OVERLAP:
        text = "%s: the panel ends %.2f pixels beyond the axis: densities near the axis may be 20 %% wrong; "
        text += "%g make them right"
        log.warning(text, name, fan.overlap_columns, _LEAST_OVERLAP)
    if arc.filled_rad > 0:
        text = "%s: %.1f° are missing where %s: the views beside them stand for them, and densities are approximate"
        where = "a displaced detector needs a full turn" if fan.is_put_aside else "views are uneven"
        log.warning(text, name, np.rad2deg(arc.filled_rad), where)
    if fan.unlike > _UNLIKE:
        text = "%s: the panel stands elsewhere in some views, by %.0f %% of its width: densities may be wrong by a third; "
        log.warning(text + "take an iterative method", name, 100 * fan.unlike)


def _warn_of_short_scan(views: Views, grid: Grid) -> None:
    name, arc, fan, coverage_deg = views.name, views.arc, views.fan, np.rad2deg(views.arc.coverage_rad)
    fan_rad, within_mm, why = 0.0, fan.short_rad, "half a turn"
    if not views.is_parallel:
        _, y_mm, x_mm = grid.axes_mm()
        radius_mm = np.hypot(np.abs(x_mm).max(), np.abs(y_mm).max())
        source_mm = float(np.hypot(views.canonical[..., 0], views.canonical[..., 1]).min())
        fan_rad = min(fan.half_rad, float(np.arcsin(min(radius_mm / source_mm, 1.0))))
        within_mm, why = source_mm * float(np.sin(fan.short_rad)), "half a turn and the fan"
    if fan.is_put_aside:
        text = "%s: a displaced panel needs a full turn: from %.1f° the volume is right within %.3g mm of the axis, if the "
        text += "object ends there; if not, take an iterative method"
        log.warning(text, name, coverage_deg, max(within_mm, 0))
    if len(arc.parts_rad) > 1:
        if (unseen_rad := arc.unseen_rad(fan_rad)) > _TOLERATED_RAD:
            text = "%s: the views cover %.1f° in %d parts, which leave %.1f° of half a turn unmeasured: densities are wrong"
            log.warning(text, name, coverage_deg, len(arc.parts_rad), np.rad2deg(unseen_rad))
    elif arc.coverage_rad < (needed_rad := np.pi + 2 * fan_rad) - _TOLERATED_RAD:
        text = "%s: the views cover %.1f°, complete data need %.1f° (%s)"
        log.warning(text, name, coverage_deg, np.rad2deg(needed_rad), why)
