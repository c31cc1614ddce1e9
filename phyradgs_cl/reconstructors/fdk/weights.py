"""FDK's weights of rays: a measure of each ray, and its redundancy weight for displaced detectors and short scans.

The measure generalises FDK's cosine weight to any pose (docs/mathematics.md). Displaced detectors follow G. Wang, Med. Phys.
29 (2002) 1634, in the fan angle. Short scans follow D. L. Parker, Med. Phys. 9 (1982) 254, with M. D. Silver's margin for
arcs longer than the shortest, Med. Phys. 27 (2000) 773. The redundancy weights of a ray and its opposite sum to 2."""

from dataclasses import dataclass

import numpy as np

# Largest (width of the transition from rays measured twice to rays measured once)/(overhang of the panel's longer side).
# Wang's transition covers all rays that are measured twice: it was up to 15 % noisier, with no fewer artefacts.
TRANSITION = 1.0
_SYMMETRIC = 0.01  # a panel whose two sides differ by at most this, in pixels, is symmetric about the axis
# A panel whose two sides differ by less than this fraction of the fan counts as misaligned, not as displaced on purpose.
_ASIDE = 0.1

_PART_EDGE_RAD = np.deg2rad(15)  # beside a gap, the weights of views rise from 0 to full over an arc of this width


def turned_back(pose: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Returns poses (F, ..., 12), each rotated by −angle_rad (F,) about +z. The poses of a circular orbit become equal."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.zeros((len(angle_rad), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, s, -s, c, 1
    return np.einsum("fij,fkj->fki", turn, pose.reshape(len(pose), -1, 3)).reshape(pose.shape)


def pixel_rays(pose: np.ndarray, rows: np.ndarray, columns: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Returns vectors (..., v, u, 3) in mm from the source, in a parallel beam from the origin, to pixels at rows (v,) and
    columns (u,).

    pose broadcasts to (..., v, u, 12): one for all pixels (1, 1, 12), one per row (v, 1, 12), one per column (1, u, 12)."""
    corner = pose[..., 3:6] if is_parallel else pose[..., 3:6] - pose[..., 0:3]
    return corner + columns[:, None] * pose[..., 6:9] + rows[:, None, None] * pose[..., 9:12]


def ray_measure(pose: np.ndarray, rays: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Returns |ȧ·n| / D (v, u), which generalises FDK's cosine: how much each ray measures per radian of gantry angle and mm
    of detector, relative to the filter's own 1/mm².

    ȧ is the source's motion in mm per radian, n the unit normal of the ray in the plane of ray and detector row, D the row's
    distance from the source. For a flat panel that faces the source the measure is DSO / |ray|, FDK's cosine. In a parallel
    beam it is 1/(sine of the angle between rays and row): 1 for a panel across the rays."""
    if is_parallel:
        across = np.cross(pose[..., 0:3], pose[..., 6:9]) / np.linalg.norm(pose[..., 6:9], axis=-1, keepdims=True)
        return 1 / np.linalg.norm(across, axis=-1)
    row = pose[..., 6:9] / np.linalg.norm(pose[..., 6:9], axis=-1, keepdims=True)
    motion = np.stack([-pose[..., 1], pose[..., 0], np.zeros(pose.shape[:-1])], -1)
    length = np.linalg.norm(rays, axis=-1)
    along = rays / length[..., None]
    cosine = (row * along).sum(-1)
    normal_motion = (motion * row).sum(-1) - cosine * (motion * along).sum(-1)
    return np.abs(normal_motion) / (length * (1 - cosine**2))


def fan_angle(pose: np.ndarray, rays: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Returns the angle in rad (v, u) of each ray about +z, counter-clockwise from the direction source to axis. In a
    parallel beam returns the distance in mm at which each ray passes the axis, positive on the side of positive angles."""
    if is_parallel:
        along = pose[..., 0:2] / np.linalg.norm(pose[..., 0:2], axis=-1, keepdims=True)
        return along[..., 0] * rays[..., 1] - along[..., 1] * rays[..., 0]
    x, y = -pose[..., 0], -pose[..., 1]
    return np.arctan2(x * rays[..., 1] - y * rays[..., 0], x * rays[..., 0] + y * rays[..., 1])


@dataclass(frozen=True)
class Fan:
    """The fan angles, low_rad to high_rad, that every view sees; in a parallel beam distances in mm from the axis.

    missing_columns: numbers of columns that would make the panel symmetric about the axis, at its two ends. pixel_rad: width
    of the pixel at the shorter end. unlike: (largest change of an end of the fan among the views)/(width of the fan)."""

    low_rad: float
    high_rad: float
    missing_columns: tuple[int, int] = (0, 0)
    pixel_rad: float = 0.0
    unlike: float = 0.0

    @property
    def is_displaced(self) -> bool:
        return self.missing_columns != (0, 0)

    @property
    def is_put_aside(self) -> bool:
        """Whether the detector was displaced on purpose: its two sides differ by over 10 % of the fan. A panel with less
        difference may be misaligned, and still sees the whole object."""
        return abs(self.low_rad + self.high_rad) > _ASIDE * (self.high_rad - self.low_rad)

    @property
    def sees_axis(self) -> bool:
        """Whether the axis meets the panel, up to the outer edge of its last pixel."""
        return self.low_rad - self.pixel_rad / 2 < 0 < self.high_rad + self.pixel_rad / 2

    @property
    def overlap_columns(self) -> float:
        """Number of columns of a displaced detector from the axis to its nearer edge."""
        return self.short_rad / self.pixel_rad

    @property
    def short_rad(self) -> float:
        """The fan angle of the shorter side, to the outer edge of its last pixel; in a parallel beam its distance in mm."""
        return min(self.high_rad, -self.low_rad) + self.pixel_rad / 2

    @property
    def half_rad(self) -> float:
        """The fan angle at the end of the wider side; in a parallel beam its distance in mm from the axis."""
        return max(self.high_rad, -self.low_rad)


def measured_fan(pose: np.ndarray, shape: tuple[int, int], is_parallel: bool = False) -> Fan:
    """Returns the fan that all views see on a panel of ``shape`` (rows, columns). pose (F, ..., 12): as in
    ``pixel_rays``."""
    rows, columns = np.arange(shape[0]), np.arange(shape[1])
    outer = pose[:, :, [0, -1]] if pose.shape[2] > 1 else pose
    ends = np.sort(fan_angle(outer, pixel_rays(outer, rows, columns[[0, -1]], is_parallel), is_parallel), axis=-1)
    low, high = float(ends[..., 0].max()), float(ends[..., 1].min())
    overhang = abs(high + low) * max(shape[1] - 1, 1)
    unlike = float(np.ptp(ends.reshape(-1, 2), axis=0).max()) / max(high - low, 1e-12)
    if shape[1] == 1 or overhang <= _SYMMETRIC * (high - low):
        return Fan(low, high, unlike=unlike)
    middle = pose[0, [pose.shape[1] // 2]]
    across = fan_angle(middle, pixel_rays(middle, rows[[shape[0] // 2]], columns, is_parallel), is_parallel)[0]
    axis = float(np.interp(0.0, across if across[-1] > across[0] else -across, columns))
    missing = max(1, int(np.ceil(abs(shape[1] - 1 - 2 * axis) - 1e-6)))
    is_low = axis < (shape[1] - 1) / 2
    pixel_rad = float(np.ptp(across[:2] if is_low else across[-2:]))
    return Fan(low, high, (missing, 0) if is_low else (0, missing), pixel_rad, unlike)


def displaced_weight(angle_rad: np.ndarray, fan: Fan) -> np.ndarray:
    """Returns the weights of rays at fan angles of any shape. If the panel sees a ray and its opposite, they are 1 + s and
    1 − s, with a sine s. Elsewhere they are 2 on the side that the panel sees, and 0 on the other.

    If the panel does not see the axis, every ray is measured once and counts 2. If the axis meets the panel's outermost
    pixel, there is no room for a transition. A pixel's weight is then twice the fraction of it on the long side."""
    if not fan.sees_axis:
        return np.full(angle_rad.shape, 2.0)
    short = min(fan.high_rad, -fan.low_rad)
    sign = 1.0 if fan.high_rad > -fan.low_rad else -1.0
    if short < fan.pixel_rad / 2:
        return 1 + sign * np.clip(2 * angle_rad / fan.pixel_rad, -1, 1)
    width = min(short, TRANSITION * (fan.half_rad - short))
    into = np.clip((np.abs(angle_rad) - (short - width)) / width, 0, 1)
    return 1 + sign * np.sign(angle_rad) * np.sin(np.pi / 2 * into)


def short_scan_weight(progress_rad: float, angle_rad: np.ndarray, coverage_rad: float) -> np.ndarray:
    """Returns twice Parker's weight of rays at fan angles of any shape, for a view ``progress_rad`` into an arc of
    ``coverage_rad``.

    The weights of a ray and its opposite add up to 2. A ray without an opposite in the arc counts 2."""
    margin = (coverage_rad - np.pi) / 2  # below 0 for less than half a turn, in which a wide fan sees some rays twice
    rise = _eased(progress_rad, margin - angle_rad)
    return 2 * rise * _eased(coverage_rad - progress_rad, margin + angle_rad)


def parted_weight(progress_rad: float, angle_rad: np.ndarray, parts_rad: np.ndarray) -> np.ndarray:
    """Returns the weights of rays at fan angles of any shape, for a view at ``progress_rad`` in an arc whose parts (P, 2)
    begin and end at ``parts_rad``. The weights of a ray and its opposite add up to 2; the ray whose view is deeper inside
    its part counts more. A ray without an opposite counts 2. After F. Noo et al., Phys. Med. Biol. 47 (2002) 2525."""
    here = max(float(_depth(np.array(progress_rad), parts_rad)), 1e-6)
    there = _depth(np.mod(progress_rad + np.pi + 2 * angle_rad, 2 * np.pi), parts_rad)
    return 2 * here / (here + there)


def _depth(at_rad: np.ndarray, parts_rad: np.ndarray) -> np.ndarray:
    """Returns smooth weights (sin²) at angles ``at_rad`` (...): 0 at the ends of the parts (P, 2) and outside, 1 inside."""
    begin, end = parts_rad.T
    from_end = np.minimum(at_rad[..., None] - begin, end - at_rad[..., None])
    return _eased(from_end, np.minimum(_PART_EDGE_RAD, (end - begin) / 2) / 2).max(-1)


def _eased(distance_rad: float | np.ndarray, half_width_rad: np.ndarray) -> np.ndarray:
    """Returns smooth weights (sin²) at a distance from the end of an arc: 0 at the end, 1 from 2 · ``half_width_rad`` on."""
    share = np.clip(distance_rad / (2 * np.maximum(half_width_rad, 1e-12)), 0, 1)
    return np.sin(np.pi / 2 * share) ** 2
