"""Geometry of cone and parallel beams: positions of source and detector at a gantry angle, and the field of view.

A *pose* is 12 numbers in world coordinates (mm): source, centre of pixel (0, 0), step to the next column (û·du), step to
the next row (v̂·dv), x y z each. For a parallel beam, the direction of the rays towards the panel replaces the source.
Operators take poses, never angles."""

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

if TYPE_CHECKING:
    from typing_extensions import Self

POSE_LENGTH = 12
# Largest distance of the source from the axis, in voxels. At this distance float32 displaces rays by 6 % of a voxel, at 1e7
# voxels by half a voxel.
_MOST_VOXELS_AWAY = 1e6
# Least sin² of the angle between a central ray and z. A steeper ray counts as if it had this angle, because the place where
# it passes the axis is uncertain.
_STEEP = 1e-2


class _Panel:
    """What the geometries of both beams share: the panel's fields and changes of their scale."""

    detector_shape: tuple[int, int]
    pixel_size_mm: tuple[float, float]

    def scaled(self, factor: float) -> "Self":
        """Returns the geometry with every length multiplied by ``factor``."""
        lengths = {name: np.multiply(value, factor).tolist() for name, value in vars(self).items() if name.endswith("_mm")}
        return replace(self, **lengths)  # type: ignore[type-var]

    def finer(self, factor: int) -> "Self":
        """Returns the geometry with every pixel divided into ``factor`` by ``factor``."""
        (rows, columns), (dv, du) = self.detector_shape, self.pixel_size_mm
        panel = {"detector_shape": (rows * factor, columns * factor), "pixel_size_mm": (dv / factor, du / factor)}
        return replace(self, **panel)  # type: ignore[type-var]


@dataclass(frozen=True)
class ConeGeometry(_Panel):
    """A circular cone-beam orbit about +z with a flat panel, in mm.

    ``source_to_axis_mm`` and ``source_to_detector_mm`` are measured along the central ray. ``detector_shape`` is (rows,
    columns). ``pixel_size_mm`` is (dv, du), or one number for square pixels. ``detector_offset_mm`` (v, u) is the panel's
    centre minus the central ray. A positive v moves the panel up, in the direction of rising rows. A positive u moves it in
    the direction of rising columns, to the right seen from the source.

    Raises InputError for lengths and counts that are not above 0, and for a panel nearer to the source than the axis."""

    source_to_axis_mm: float
    source_to_detector_mm: float
    detector_shape: tuple[int, int]
    pixel_size_mm: tuple[float, float]
    detector_offset_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("source_to_axis_mm", "source_to_detector_mm"):
            _positive_mm(name, getattr(self, name), ())
        if self.source_to_detector_mm < self.source_to_axis_mm:
            expected = f"at least source_to_axis_mm ({self.source_to_axis_mm:g}): the panel stands behind the axis"
            raise InputError("source_to_detector_mm", f"{self.source_to_detector_mm:g}", expected, "are they exchanged?")
        _check_panel(self)

    def pose(self, angle_rad: np.ndarray | float) -> np.ndarray:
        """Returns poses (..., 12) float64 at gantry angles θ (...). The source is at (DSO cos θ, DSO sin θ, 0), where DSO
        is ``source_to_axis_mm``."""
        radial, panel = _panel_at(self, angle_rad)
        panel[..., :3] -= (self.source_to_detector_mm - self.source_to_axis_mm) * radial
        return np.concatenate([self.source_to_axis_mm * radial, panel], -1)

    @property
    def magnification(self) -> float:
        """source_to_detector_mm / source_to_axis_mm: the factor by which the panel shows an object at the axis enlarged."""
        return self.source_to_detector_mm / self.source_to_axis_mm


@dataclass(frozen=True)
class ParallelGeometry(_Panel):
    """A circular parallel-beam orbit about +z with a flat panel across the rays, in mm.

    The panel's distance does not matter, so its plane is taken to contain the axis. ``detector_shape`` is (rows, columns).
    ``pixel_size_mm`` is (dv, du), or one number for square pixels. ``detector_offset_mm`` (v, u) is the panel's centre minus
    the ray through the axis, with signs as in ``ConeGeometry``.

    Raises InputError for lengths and counts that are not above 0."""

    detector_shape: tuple[int, int]
    pixel_size_mm: tuple[float, float]
    detector_offset_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _check_panel(self)

    def pose(self, angle_rad: np.ndarray | float) -> np.ndarray:
        """Returns poses (..., 12) float64 at gantry angles θ (...). Rays run along (−cos θ, −sin θ, 0), as the central ray
        of a cone beam does at the same angle."""
        radial, panel = _panel_at(self, angle_rad)
        return np.concatenate([-radial, panel], -1)

    @property
    def magnification(self) -> float:
        """1, because parallel rays do not magnify."""
        return 1.0


Geometry = ConeGeometry | ParallelGeometry
GEOMETRIES = (ConeGeometry, ParallelGeometry)


def _check_panel(geometry: Geometry) -> None:
    """Converts the panel's fields to tuples, so that geometries can be compared. Raises InputError for counts that are
    not whole or below 1, pixel sizes not above 0, and offsets that are not finite."""
    counts = checks.numbers("detector_shape", geometry.detector_shape, (2,))
    if (counts < 1).any() or (counts != np.floor(counts)).any():
        raise InputError("detector_shape", str(geometry.detector_shape), "two counts (rows, columns) of at least 1")
    object.__setattr__(geometry, "detector_shape", (int(counts[0]), int(counts[1])))
    if isinstance(geometry.pixel_size_mm, Real):
        object.__setattr__(geometry, "pixel_size_mm", (geometry.pixel_size_mm, geometry.pixel_size_mm))
    _positive_mm("pixel_size_mm", geometry.pixel_size_mm, (2,))
    for name in ("pixel_size_mm", "detector_offset_mm"):
        object.__setattr__(geometry, name, tuple(checks.numbers(name, getattr(geometry, name), (2,)).tolist()))


def _panel_at(geometry: Geometry, angle_rad: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the unit vector (..., 3) from the axis to the source. Also returns first pixel, column step and row step
    (..., 9) in mm of a panel whose plane contains the axis."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    u_hat = np.stack([-sin, cos, zero], -1)
    v_hat = np.stack([zero, zero, zero + 1.0], -1)
    (nv, nu), (dv, du), (off_v, off_u) = geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm
    first_pixel = (off_u - (nu - 1) / 2 * du) * u_hat + (off_v - (nv - 1) / 2 * dv) * v_hat
    return np.stack([cos, sin, zero], -1), np.concatenate([first_pixel, du * u_hat, dv * v_hat], -1)


def _positive_mm(name: str, value: object, shape: tuple[int, ...]) -> None:
    if (checks.numbers(name, value, shape) <= 0).any():  # type: ignore[arg-type]
        expected = "two positive lengths in mm (v, u)" if shape else "a positive length in mm"
        raise InputError(name, checks.short_repr(value), expected)


def pixel_centres(pose: np.ndarray, detector_shape: tuple[int, int]) -> np.ndarray:
    """Returns the world coordinates (..., nv, nu, 3) in mm of all pixel centres for poses (..., 12)."""
    nv, nu = detector_shape
    pose = np.asarray(pose, dtype=np.float64)[..., None, None, :]
    columns, rows = np.arange(nu)[None, :, None], np.arange(nv)[:, None, None]
    return pose[..., 3:6] + columns * pose[..., 6:9] + rows * pose[..., 9:12]


def plain_geometry(pose: np.ndarray, panel: tuple[int, int], is_parallel: bool = False) -> Geometry:
    """Returns the circular geometry with the mean distances and offsets of poses (F, 12), for a panel (rows, columns).

    The distance to the detector is measured at right angles to the panel. The offset runs from the point of the panel's
    plane nearest to the source (in a parallel beam, to the origin) to the panel's middle."""
    source, first, step_u, step_v = (pose[:, i : i + 3] for i in (0, 3, 6, 9))
    pitch_u, pitch_v = (np.linalg.norm(step, axis=1, keepdims=True) for step in (step_u, step_v))
    u_hat, v_hat = step_u / pitch_u, step_v / pitch_v
    centre = first + (panel[1] - 1) / 2 * step_u + (panel[0] - 1) / 2 * step_v
    normal = np.cross(u_hat, v_hat)
    ray = centre - (0 * source if is_parallel else source)
    offset_v, offset_u, away = (np.einsum("ij,ij->i", ray, axis) for axis in (v_hat, u_hat, normal))
    to_axis = np.linalg.norm(source[:, :2], axis=1)
    means = [float(np.mean(x)) for x in (to_axis, np.abs(away), pitch_v, pitch_u, offset_v, offset_u)]
    if is_parallel:
        return ParallelGeometry(panel, (means[2], means[3]), (means[4], means[5]))
    to_detector = max(means[:2])  # a panel that does not turn with the source may be nearer than the axis
    return ConeGeometry(means[0], to_detector, panel, (means[2], means[3]), (means[4], means[5]))


def towards_source(pose: np.ndarray, is_parallel: bool) -> np.ndarray:
    """Returns vectors (..., 3) from the origin to the source, for poses (..., 12). In a parallel beam these are unit
    vectors against the direction of the rays."""
    return -pose[..., :3] if is_parallel else pose[..., :3]


def transpose_pose(pose: np.ndarray) -> np.ndarray:
    """Returns the poses (..., 12) for an image with rows and columns exchanged."""
    return np.concatenate([pose[..., :6], pose[..., 9:12], pose[..., 6:9]], -1)


def field_of_view_mm(geometry: Geometry) -> np.ndarray:
    """Returns the box (3, 2) in mm of a full turn's field of view: its lowest and highest z, y and x.

    The radius is DSO·sin(atan(half width/DSD)), with the distances DSO from source to axis and DSD from source to panel.
    The half width reaches from the central ray to the farther edge of a shifted panel. Along z the box ends where the rays
    to the panel's lower and upper edge are farthest out within that radius."""
    sides = zip(geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm, strict=True)
    (low_mm, top_mm), (left_mm, right_mm) = ((off - n * pitch / 2, off + n * pitch / 2) for n, pitch, off in sides)
    radius_mm = max(-left_mm, right_mm)
    if isinstance(geometry, ConeGeometry):
        source_mm, panel_mm = geometry.source_to_axis_mm, geometry.source_to_detector_mm
        radius_mm = source_mm * math.sin(math.atan2(radius_mm, panel_mm))
        low_mm = low_mm * (source_mm + math.copysign(radius_mm, -low_mm)) / panel_mm
        top_mm = top_mm * (source_mm + math.copysign(radius_mm, top_mm)) / panel_mm
    return np.array([(low_mm, top_mm), (-radius_mm, radius_mm), (-radius_mm, radius_mm)])


def default_grid(geometry: Geometry, poses: np.ndarray | None = None) -> Grid:
    """Returns the grid of a full turn's field of view: a cube, or lower if the panel sees less along z.

    Voxels are as large as a pixel's image at the axis: the pitch of rows along z, the pitch of columns along y and x. The
    middle of a cube is where the ray to the panel's middle meets the axis. In a parallel beam the grid is as high as the
    panel. If ``poses`` (F, 12) travel along z, as in a helix, the grid is longer by that travel."""
    (low_mm, top_mm), (_, radius_mm), _ = field_of_view_mm(geometry).tolist()
    high_mm, wide_mm = (pitch / geometry.magnification for pitch in geometry.pixel_size_mm)
    wide = max(1, math.ceil(2 * radius_mm / wide_mm))
    at_axis_mm = geometry.detector_offset_mm[0] / geometry.magnification
    high, beside_mm = max(1, round((top_mm - low_mm) / high_mm)), (low_mm + top_mm) / 2 - at_axis_mm
    if isinstance(geometry, ConeGeometry) and (side := max(1, round(wide * wide_mm / high_mm))) < high:
        high, beside_mm = side, 0.0
    first_mm, last_mm = (at_axis_mm, at_axis_mm) if poses is None else _travel_mm(poses, geometry)
    middle_mm = (first_mm + last_mm) / 2
    if last_mm - first_mm >= high_mm:
        high += math.ceil((last_mm - first_mm) / high_mm)
    elif abs(middle_mm - at_axis_mm) < high_mm:  # a shift of less than a voxel is a wobble of the gantry
        middle_mm = at_axis_mm
    return Grid((high, wide, wide), (high_mm, wide_mm, wide_mm), (middle_mm + beside_mm, 0.0, 0.0))


def _travel_mm(poses: np.ndarray, geometry: Geometry) -> tuple[float, float]:
    """Returns the lowest and highest z in mm at which the rays of poses (F, 12) to the panel's middle row, in the column of
    the central ray, pass the z axis."""
    (rows, columns), off_u = geometry.detector_shape, geometry.detector_offset_mm[1]
    start, first, step_u, step_v = (poses[:, i : i + 3] for i in (0, 3, 6, 9))
    middle = first + ((columns - 1) / 2 - off_u / geometry.pixel_size_mm[1]) * step_u + (rows - 1) / 2 * step_v
    ray = start if isinstance(geometry, ParallelGeometry) else middle - start
    across = np.maximum(np.sum(ray[:, :2] ** 2, axis=1), _STEEP * np.sum(ray**2, axis=1))
    z_mm = middle[:, 2] - np.sum(middle[:, :2] * ray[:, :2], axis=1) / across * ray[:, 2]
    return float(z_mm.min()), float(z_mm.max())


def check_distances(geometry: Geometry, grid: Grid) -> None:
    """Raises InputError for a cone beam's source over 1e6 voxels from the axis: farther away, float32 misplaces rays."""
    if isinstance(geometry, ParallelGeometry):
        return
    source_mm, voxel_mm = geometry.source_to_axis_mm, min(grid.voxel_size_mm)
    if source_mm > _MOST_VOXELS_AWAY * voxel_mm:
        found = f"{source_mm:.4g} mm, {source_mm / voxel_mm:.3g} voxels of {voxel_mm:.4g} mm"
        expected = f"at most {_MOST_VOXELS_AWAY:.0e} voxels: beyond, rounding displaces the rays"
        remedy = "such rays are parallel: take ParallelGeometry, with pixels of their size over the magnification"
        raise InputError("source_to_axis_mm", found, expected, remedy)


def misses(grid: Grid, geometry: Geometry) -> bool:
    """Returns whether the box of ``grid`` lies wholly outside the box of a full turn's field of view."""
    (low_mm, high_mm), (first_mm, last_mm) = grid.box_mm.T, field_of_view_mm(geometry).T
    return bool(np.any((low_mm >= last_mm) | (high_mm <= first_mm)))


def hidden(grid: Grid, pose: np.ndarray, detector_shape: tuple[int, int], is_parallel: bool = False) -> str:
    """Returns why no ray of a pose (12,) meets a grid: "behind the panel" or "beside the rays"; "" if rays meet it."""
    corners = np.stack(np.meshgrid(*grid.box_mm[::-1], indexing="ij"), -1).reshape(-1, 3)
    if is_parallel:
        basis = np.stack([pose[6:9], pose[9:12], pose[0:3]], -1)
        at = np.linalg.solve(basis, (corners - pose[3:6]).T)[:2]  # the detector column and row of each corner, (2, 8)
        last = np.array(detector_shape[::-1])[:, None] - 0.5
        return "beside the rays" if ((at < -0.5).all(1) | (at > last).all(1)).any() else ""
    source, first, step_u, step_v = pose.reshape(4, 3)
    rows, columns = detector_shape
    edges = [(-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5)]
    rays = np.array([first + u * step_u + v * step_v - source for u, v in edges])
    corners = corners - source
    away = np.cross(step_u, step_v)
    away = away * np.sign(away @ rays[0])
    sides = np.cross(rays, np.roll(rays, -1, axis=0))
    inward = sides * np.sign(sides @ rays.sum(axis=0))[:, None]
    if (corners @ away > rays[0] @ away).all():
        return "behind the panel"
    planes = np.concatenate([inward, away[None]])  # normals of the four sides of the pyramid of rays, and of the panel
    return "beside the rays" if (corners @ planes.T < 0).all(axis=0).any() else ""


def panel_behind_mm(grid: Grid, pose: np.ndarray) -> float:
    """Returns how far the panel of a pose (12,) is behind the middle of ``grid``, in mm; below 0 in front of it. If the
    distance is less than half the grid's width, the panel stands inside the grid, and rays end there."""
    source, first, step_u, step_v = pose.reshape(4, 3)
    away = np.cross(step_u, step_v)
    away = away * np.sign(away @ (first - source)) / np.linalg.norm(away)
    return float((first - np.array(grid.offset_mm)[::-1]) @ away)


def cuts(grid: Grid, whole: Grid, geometry: Geometry) -> bool:
    """Returns whether ``grid`` lacks a part of the field of view that ``whole`` contains. A layer of up to one voxel of
    ``grid`` on a side does not count."""
    low_mm, high_mm = np.clip(whole.box_mm.T, *field_of_view_mm(geometry).T)
    begin_mm, end_mm = grid.box_mm.T
    return bool(np.any((begin_mm - low_mm > grid.voxel_size_mm) | (high_mm - end_mm > grid.voxel_size_mm)))
