"""The views of an FDK reconstruction: the arcs that they cover, what they miss, whether their orbit is a circle, and the
weights of their pixels before filtering."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition.altered.angles import azimuth_rad, wrapped
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import weights

# A gap between views stands out if it is wider than this many times another gap; one lost view makes a gap of 2 steps.
# The widest gap is compared with the second widest: compared with the median, uneven full turns would look like short scans.
# Any gap wider than _WIDE_RAD is compared with both gaps beside it.
SHORT_SCAN_GAP = 2.5
_SAME_VIEW = 0.05  # views nearer to each other than this fraction of the mean gap count as one repeated view
# A warning names filled gaps from this width on: narrower ones changed the density of large balls by less than 1 %.
_NAMED_RAD = np.deg2rad(5)
# All gaps up to this width, except the widest, are filled: dividing the arc there would cost more accuracy.
_WIDE_RAD = np.deg2rad(10)
# A misaligned panel measures a strip of rays once only. Gaps up to this width are filled, so that the strip counts fully.
_FILLED_RAD = np.deg2rad(15)
# The same for a panel displaced on purpose, whose strip is wide. For wider gaps short-scan weights were 0.2 to 10 dB better.
_FILLED_ASIDE_RAD = np.deg2rad(65)
# Views nearer to a filled gap than this fraction of its width stand for the gap: more views smear, fewer draw streaks.
_FILL_REACH = 0.5
log = logging.getLogger(__name__)

# Limits of an orbit, in pairs. Beyond the first limit a warning is logged; beyond the second, _NO_…, InputError is raised.
_CIRCLE = 0.05  # (distance of source or panel from a circle about z)/(distance from source to panel)
_NO_CIRCLE = 0.5
_PLANE_DEG = 10.0  # angle between the plane z = 0 and the line from the origin to the source
_NO_PLANE_DEG = 45.0
_LEAN_DEG = 0.5  # angle of parallel rays, or of their detector rows, from the plane of the rotation
_NO_LEAN_DEG = 10.0
_ROLL_DEG = 3.0  # angle of a cone beam's detector rows from the plane of the rotation: at 3° densities are 0.1 % too low
_NO_ROLL_DEG = 10.0  # densities are 1.5 % too low at 10°, and 0 at 90°
_UNLIKE = 0.1  # a warning comes if the fan's ends differ among the views by more than this fraction of the fan
_LEAST_OVERLAP = 2.0  # a warning comes if a displaced panel reaches less than this many columns beyond the axis
# A smaller missing angle causes no warning: nearly parallel rays have so narrow a fan that half a turn is enough.
_TOLERATED_RAD = np.deg2rad(0.5)
_PARTS = 16  # a short scan's weights are averaged over this many parts of a view's angular step
RayWeight = Callable[[int], np.ndarray]


@dataclass(frozen=True, eq=False)
class Arc:
    """The angles that the views cover, and how much of them each view stands for.

    - gap_rad (F,): the angle for which each view stands. coverage_rad: the angle that all views cover. is_full: a full turn.
    - progress_rad (F,): each view's angle from the arc's start. The arc is half a step longer than the views at both ends; a
      full turn starts at the view of the least angle.
    - parts_rad (P, 2): progress at which each part between gaps begins and ends.
    - filled_rad: sum over the gaps above 5° for which neighbouring views stand of (gap − usual gap)."""

    gap_rad: np.ndarray
    progress_rad: np.ndarray
    coverage_rad: float
    is_full: bool
    parts_rad: np.ndarray
    filled_rad: float = 0.0

    def unseen_rad(self, fan_rad: float = 0.0) -> float:
        """Returns the part of half a turn, in rad, in which neither a ray nor its opposite is measured: the largest value
        of rays at fan angles −fan_rad, 0 and fan_rad."""
        at_rad = np.linspace(0, 2 * np.pi, 1440, endpoint=False)
        fans = (-fan_rad, 0.0, fan_rad)
        shares = [(self.covers(at_rad) | self.covers(at_rad + np.pi + 2 * fan)).mean() for fan in fans]
        return float(np.pi * (1 - min(shares)))

    def covers(self, at_rad: np.ndarray) -> np.ndarray:
        """Returns which of the angles (...), given as progress in rad, lie in a part of the arc; bool (...)."""
        turned = np.mod(at_rad, 2 * np.pi)[..., None]
        return ((turned >= self.parts_rad[:, 0]) & (turned <= self.parts_rad[:, 1])).any(-1)


def filled_gap_rad(fan: weights.Fan) -> float:
    """Returns the width in rad up to which the views at both sides fill gaps: 65° for a panel displaced on purpose, 15° for
    a misaligned panel, because some of a gap's rays then have no opposite; 0 for a symmetric panel."""
    if fan.is_put_aside:
        return _FILLED_ASIDE_RAD
    return _FILLED_RAD if fan.is_displaced else 0.0


def view_arc(angle_rad: np.ndarray, filled_rad: float = 0.0) -> Arc:
    """Returns the arc that views at gantry angles (F,) cover, in any order and over any number of turns.

    Gaps that stand out divide the arc into parts. If none is wider than ``filled_rad``, the arc is a full turn, and the
    views at both sides stand for the gaps."""
    cell, centre = distinct_views(angle_rad)
    count = np.bincount(cell)
    ahead = np.diff(centre, append=centre[0] + 2 * np.pi)
    wide = _stand_out(ahead)
    wide &= ~_only_here(centre, ahead, wide)
    if not wide.any() or ahead[wide].max() <= filled_rad:
        gap = _filled_cells(ahead, wide)
        whole = np.array([[0.0, 2 * np.pi]])
        return Arc((gap / count)[cell], (centre - centre[0])[cell], 2 * np.pi, True, whole, _filled_rad(ahead))
    first = (int(np.argmax(np.where(wide, ahead, 0))) + 1) % ahead.size
    ahead, wide = np.roll(ahead, -first), np.roll(wide, -first)  # so that the widest gap that stands out is the last
    forward, back = _steps(ahead, wide)
    progress = np.concatenate([[0.0], np.cumsum(ahead[:-1])]) + back[0] / 2
    parts = np.stack([(progress - back / 2)[np.roll(wide, 1)], (progress + forward / 2)[wide]], -1)
    gap, filled = (forward + back) / 2, _filled_rad(ahead[~wide])
    place = (cell - first) % ahead.size
    arc = Arc((gap / np.roll(count, -first))[place], progress[place], float(gap.sum()), False, parts, filled)
    return arc if len(parts) == 1 else replace(arc, gap_rad=arc.gap_rad * np.pi / (np.pi - arc.unseen_rad()))


def _stand_out(ahead: np.ndarray) -> np.ndarray:
    """Returns which gaps ``ahead`` (K,), from each view to the next, are wide, bool (K,): the widest if it stands out from
    all others, and any gap above 10° that stands out from the two gaps beside it."""
    wide = np.zeros(ahead.size, bool)
    if ahead.size < 2:
        return wide
    second, largest = np.sort(ahead)[-2:]
    wide[np.argmax(ahead)] = largest > SHORT_SCAN_GAP * second
    beside = np.maximum(np.roll(ahead, 1), np.roll(ahead, -1))
    return wide | (ahead > np.maximum(SHORT_SCAN_GAP * beside, _WIDE_RAD))


def _only_here(centre: np.ndarray, ahead: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Returns which ``wide`` gaps ``ahead`` (K,), at most 15°, have another wide gap opposite, bool (K,). No opposite rays
    measure such a gap, so the views at its sides fill it. The widest gap is left out. centre (K,): angles of the views."""
    narrow = wide & (ahead <= _FILLED_RAD) & (np.arange(ahead.size) != np.argmax(ahead))
    opposite = centre + ahead / 2 + np.pi
    before = np.searchsorted(centre, np.mod(opposite - centre[0], 2 * np.pi) + centre[0], side="right") - 1
    return narrow & wide[before]


def _steps(ahead: np.ndarray, wide: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the steps in rad from each view to the next (K,), and to each view from the one before (K,). They are the gaps
    ``ahead`` (K,); a gap that is ``wide``, bool (K,), is replaced by the gap on the view's other side."""
    forward = np.where(wide, np.roll(ahead, 1), ahead)
    return forward, np.roll(np.where(wide, np.roll(ahead, -1), ahead), 1)


def _filled_rad(ahead: np.ndarray) -> float:
    """Returns Σ (gap − usual) in rad over wide gaps; usual: max(median gap, both gaps beside it). ahead (K,): all gaps."""
    usual = np.maximum(np.median(ahead) if ahead.size else 0.0, np.maximum(np.roll(ahead, 1), np.roll(ahead, -1)))
    return float((ahead - usual)[ahead > np.maximum(SHORT_SCAN_GAP * usual, _NAMED_RAD)].sum())


def _filled_cells(ahead: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Returns the angle (K,) in rad for which each view of a full turn stands. A wide gap is divided among the views near
    it, with larger parts for nearer views. ahead, wide: as in ``_steps``."""
    forward, back = _steps(ahead, wide)
    known = (forward + back) / 2
    cells = known.copy()
    for gap in np.flatnonzero(wide):
        turned = np.cumsum(np.roll(ahead, -gap))  # angle from the view before the gap to each other view
        away_rad = np.minimum(turned - ahead[gap], 2 * np.pi - turned)
        near = np.roll(np.maximum(1 - away_rad / (_FILL_REACH * ahead[gap]), 0), gap + 1) * known
        cells += (ahead[gap] - (forward[gap] + np.roll(back, -1)[gap]) / 2) * near / near.sum()
    return cells


def distinct_views(angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns each view's index (F,) into the K distinct angles, and these angles (K,) in rad, ascending within a turn."""
    turned = np.mod(np.asarray(angle_rad, np.float64), 2 * np.pi)
    order = np.argsort(turned, kind="stable")
    tolerance = _SAME_VIEW * 2 * np.pi / turned.size
    is_new = np.diff(turned[order], prepend=-np.inf) > tolerance
    index = np.cumsum(is_new) - 1
    centre = turned[order][is_new]
    if centre.size > 1 and centre[0] + 2 * np.pi - turned[order[-1]] <= tolerance:  # first and last are one, as 0° and 360°
        index[index == centre.size - 1] = 0
        centre = centre[:-1]
    cell = np.empty(turned.size, np.int64)
    cell[order] = index
    return cell, centre


def pose_of_pixels(pose: np.ndarray, axis: str) -> np.ndarray:
    """Returns poses (F, 12), or (F, lines, 12) along ``axis``, in a shape that broadcasts to (F, rows, columns, 12)."""
    if pose.ndim == 2:
        return pose[:, None, None]
    return pose[:, :, None] if axis == "rows" else pose[:, None]


def view_angles(by_pixel: np.ndarray) -> np.ndarray:
    """Returns each view's gantry angle (F,) in rad, the mean over the poses (F, r, c, 12) of the view's pixels."""
    angle_rad = azimuth_rad(by_pixel)
    first = angle_rad[:, :1, :1]
    return (first + wrapped(angle_rad - first).mean(axis=(1, 2), keepdims=True))[:, 0, 0]


def ray_weight(
    canonical: np.ndarray, shape: tuple[int, int], arc: Arc, fan: weights.Fan, is_parallel: bool = False
) -> RayWeight:
    """Returns a function from a view's index to the weights (rows, columns), in 1/mm, of its pixels before filtering."""
    rows, columns = np.arange(shape[0]), np.arange(shape[1])

    def geometry(view: int) -> tuple[np.ndarray, np.ndarray]:
        pose = canonical[view]
        rays = weights.pixel_rays(pose, rows, columns, is_parallel)
        pitch_mm = np.linalg.norm(pose[..., 6:9], axis=-1)
        measure = weights.ray_measure(pose, rays, is_parallel) / pitch_mm
        return measure, _redundancy_angle(pose, rays, arc, is_parallel)

    first = geometry(0)
    if arc.is_full and len(canonical) == 1:
        constant = _redundancy(0, first[1], arc, fan) * first[0]
        return lambda view: constant

    def weight(view: int) -> np.ndarray:
        measure, angle_rad = first if len(canonical) == 1 else geometry(view)
        return _redundancy(view, angle_rad, arc, fan) * measure

    return weight


def opposite_weight(
    canonical: np.ndarray, shape: tuple[int, int], arc: Arc, is_parallel: bool
) -> Callable[[int], np.ndarray | float]:
    """Returns a function from a view's index to its redundancy weights (rows, columns), 1.0 in a full turn. The weights of a
    ray and its opposite sum to 2. A displaced detector is not considered."""
    rows, columns = np.arange(shape[0]), np.arange(shape[1])

    def weight(view: int) -> np.ndarray | float:
        if arc.is_full:
            return 1.0
        pose = canonical[view % len(canonical)]
        angle_rad = _redundancy_angle(pose, weights.pixel_rays(pose, rows, columns, is_parallel), arc, is_parallel)
        return _redundancy(view, angle_rad, arc, weights.Fan(0.0, 0.0))

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
    if is_parallel:
        _check_directions(pose)
    else:
        _check_orbit(pose)
        _check_rows(pose)


def _check_directions(pose: np.ndarray) -> None:
    """Raises InputError, or warns, if parallel rays or detector rows leave the plane of rotation, in which FBP filters."""
    rise_deg = np.rad2deg(np.arcsin(np.clip(np.abs(pose[..., 2]), 0, 1)))
    worst_deg = float(max(rise_deg.max(), _row_lean_deg(pose).max()))
    remedy = "take an iterative or splatting method: they take any orbit"
    if worst_deg > _NO_LEAN_DEG:
        found = f"rays or detector rows {worst_deg:.1f}° off the plane of the rotation (laminography?)"
        raise InputError("--method fbp", found, f"at most {_NO_LEAN_DEG:.0f}°", remedy)
    if worst_deg > _LEAN_DEG:
        text = "FBP: rays or detector rows %.2f° off the plane of the rotation: the volume is an approximation; %s"
        log.warning(text, worst_deg, remedy)


def _row_lean_deg(pose: np.ndarray) -> np.ndarray:
    """Returns the angle (...) in degrees between the detector rows of poses (..., 12) and the plane of the rotation."""
    return np.rad2deg(np.arctan2(np.abs(pose[..., 8]), np.linalg.norm(pose[..., 6:8], axis=-1)))


def _check_rows(pose: np.ndarray) -> None:
    """Raises InputError, or warns, if a cone beam's detector rows, along which FDK filters, leave the plane of rotation."""
    roll_deg = float(_row_lean_deg(pose).max())
    if roll_deg > _NO_ROLL_DEG:
        found = f"detector rows {roll_deg:.1f}° off the plane of the rotation"
        remedy = "exchange rows and columns if the panel stands on its side; iterative methods take any panel"
        raise InputError("--method fdk", found, f"at most {_NO_ROLL_DEG:.0f}°", remedy)
    if roll_deg > _ROLL_DEG:
        text = "FDK: detector rows %.1f° off the plane of the rotation: the volume is an approximation"
        log.warning(text, roll_deg)


def _check_orbit(pose: np.ndarray) -> None:
    middle = pose if pose.ndim == 2 else pose[:, pose.shape[1] // 2]
    canonical = weights.turned_back(middle, azimuth_rad(middle)).reshape(-1, 4, 3)
    usual = np.median(canonical, axis=0)
    length_mm = float(np.linalg.norm(usual[1] - usual[0]))
    off_mm = canonical[:, :2] - usual[:2]  # offsets of source and panel from their median positions in the turned poses
    aside_mm = off_mm - np.eye(3)[2] * off_mm[:, :1, 2:]  # without travel along z, which only makes voxels miss views
    above_deg = float(np.rad2deg(np.arctan2(abs(usual[0, 2]), np.hypot(*usual[0, :2]))))

    def distances_beyond(most: float, most_deg: float, of_mm: np.ndarray) -> str:
        off = float(np.linalg.norm(of_mm, axis=-1).max())
        parts = (
            f"{100 * off / length_mm:.0f} % of their distance off a circle about z",
            f"{above_deg:.0f}° above the middle of their circle",
        )
        wrong = (off > most * length_mm, above_deg > most_deg)
        return " and ".join(part for part, is_wrong in zip(parts, wrong, strict=True) if is_wrong)

    if found := distances_beyond(_NO_CIRCLE, _NO_PLANE_DEG, aside_mm):
        expected = f"at most {100 * _NO_CIRCLE:.0f} % off it and {_NO_PLANE_DEG:.0f}° above"
        remedy = "take an iterative or splatting method: they take any orbit"
        raise InputError("--method fdk", f"source and panel up to {found}", expected, remedy)
    if found := distances_beyond(_CIRCLE, _PLANE_DEG, off_mm):
        text = "FDK: source and panel up to %s: the volume is an approximation; %s"
        log.warning(text, found, "iterative and splatting methods take any orbit")


def warn_if_incomplete(
    arc: Arc, fan: weights.Fan, canonical: np.ndarray, grid: Grid, is_parallel: bool = False
) -> None:
    """Logs a warning for each kind of data that the views do not measure."""
    name = "FBP" if is_parallel else "FDK"
    if np.unique(arc.progress_rad).size == 1:
        log.warning("%s: all views are from one angle: the volume is a single backprojection", name)
        return
    if arc.is_full:
        _warn_of_axis(name, fan)
    else:
        _warn_of_short_scan(name, arc, fan, canonical, grid, is_parallel)
    if arc.filled_rad > 0:
        text = "%s: %.1f° are missing where %s: the views beside them stand for them, and densities are approximate"
        where = "a displaced detector needs a full turn" if fan.is_put_aside else "views are uneven"
        log.warning(text, name, np.rad2deg(arc.filled_rad), where)
    if fan.unlike > _UNLIKE:
        text = "%s: the panel stands elsewhere in some views, by %.0f %% of its width: densities may be wrong by a third; %s"
        log.warning(text, name, 100 * fan.unlike, "take an iterative method")


def _warn_of_axis(name: str, fan: weights.Fan) -> None:
    if not fan.sees_axis:
        text = "%s: the detector does not see the rotation axis; the middle of the volume is not measured"
        log.warning(text, name)
    elif fan.is_displaced and fan.overlap_columns < _LEAST_OVERLAP:
        text = "%s: the panel ends %.2f pixels beyond the axis: densities near the axis may be 20 %% wrong; %s"
        log.warning(text, name, fan.overlap_columns, f"{_LEAST_OVERLAP:g} make them right")


def _warn_of_short_scan(
    name: str, arc: Arc, fan: weights.Fan, canonical: np.ndarray, grid: Grid, is_parallel: bool
) -> None:
    fan_rad, within_mm = 0.0, fan.short_rad
    if not is_parallel:
        _, y_mm, x_mm = grid.axes_mm()
        radius_mm = np.hypot(np.abs(x_mm).max(), np.abs(y_mm).max())
        source_mm = float(np.hypot(canonical[..., 0], canonical[..., 1]).min())
        fan_rad = min(fan.half_rad, float(np.arcsin(min(radius_mm / source_mm, 1.0))))
        within_mm = source_mm * float(np.sin(fan.short_rad))
    if fan.is_put_aside:
        text = "%s: a displaced panel needs a full turn: from %.1f° the volume is right within %.3g mm of the axis, if the "
        text += "object ends there; if not, take an iterative method"
        log.warning(text, name, np.rad2deg(arc.coverage_rad), max(within_mm, 0))
    if len(arc.parts_rad) > 1:
        if (unseen_rad := arc.unseen_rad(fan_rad)) > _TOLERATED_RAD:
            text = "%s: the views cover %.1f° in %d parts, which leave %.1f° of half a turn unmeasured: densities are wrong"
            log.warning(text, name, np.rad2deg(arc.coverage_rad), len(arc.parts_rad), np.rad2deg(unseen_rad))
        return
    if is_parallel:
        if arc.coverage_rad < np.pi - _TOLERATED_RAD:
            text = "FBP: the views cover %.1f°, complete data of a parallel beam need 180°"
            log.warning(text, np.rad2deg(arc.coverage_rad))
        return
    needed_rad = np.pi + 2 * fan_rad
    if arc.coverage_rad < needed_rad - _TOLERATED_RAD:
        log.warning(
            "FDK: the views cover %.1f°, complete data need %.1f° (half a turn and the fan)",
            np.rad2deg(arc.coverage_rad), np.rad2deg(needed_rad),
        )
