"""Phantoms made of ellipsoids and cylinders whose attenuations add up, with exact line integrals.

An affine map takes an ellipsoid to the unit ball, and a ray to a ray. The ray's length in the ball follows from its distance
to the centre (Kak and Slaney, Principles of Computerized Tomographic Imaging, IEEE Press 1988, section 3.1)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import finite, positive, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]

IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_PARALLEL = 1e-30  # replaces divisors of 0: those of a ray along a cylinder's axis, or at right angles to the axis
RAYS_PER_CHUNK = 1 << 15  # most rays projected at a time: their intermediate arrays, 2-3 MB, stay in a core's cache


def rotation_about_z(angle_rad: float) -> Matrix:
    """Returns the matrix that rotates counter-clockwise about z, seen from +z, for an ellipsoid's ``rotation``."""
    c, s = float(np.cos(angle_rad)), float(np.sin(angle_rad))
    return ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Ellipsoid:
    """A solid ellipsoid, whose attenuation adds to that of other bodies.

    The centre is (x, y, z). The columns of the 3x3 ``rotation`` are the directions of the semi-axes. A negative
    ``attenuation_per_mm`` makes a hole in other bodies. Raises InputError for semi-axes that are not positive, values that
    are not finite, and a matrix that is not orthogonal."""

    centre_mm: Triple
    semi_axes_mm: Triple
    attenuation_per_mm: float
    rotation: Matrix = IDENTITY

    def __post_init__(self) -> None:
        for name in ("centre_mm", "semi_axes_mm"):
            shape(f"ellipsoid {name}", getattr(self, name), (3,))
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        finite("ellipsoid centre", self.centre_mm)
        finite("ellipsoid attenuation", self.attenuation_per_mm)
        for length in self.semi_axes_mm:
            positive("ellipsoid semi-axis", length)
        r = np.asarray(self.rotation, dtype=np.float64)
        if r.shape != (3, 3) or not np.allclose(r @ r.T, np.eye(3), atol=1e-9):
            raise InputError("ellipsoid rotation", str(self.rotation), "an orthogonal 3x3 matrix")
        object.__setattr__(self, "rotation", tuple(tuple(row) for row in r.tolist()))

    @property
    def to_unit_ball(self) -> Array:
        """The matrix (3, 3) that maps vectors (x, y, z) in mm to a frame in which the ellipsoid is the unit ball."""
        return np.asarray(self.rotation).T / np.asarray(self.semi_axes_mm)[:, None]

    @property
    def half_box_mm(self) -> Array:
        """Half the sides (3,), x y z, of the smallest axis-aligned box around the ellipsoid."""
        return np.linalg.norm(np.asarray(self.rotation) * np.asarray(self.semi_axes_mm), axis=1)

    @property
    def ends_mm(self) -> tuple[Triple, Triple]:
        """Both ends of the body's axis, here the centre. No point of the body is further than ``reach_mm`` from the axis."""
        return self.centre_mm, self.centre_mm

    @property
    def reach_mm(self) -> float:
        return max(self.semi_axes_mm)

    def chord_fraction(self, start: Array, step: Array) -> Array:
        """Returns the fraction (n,) of each segment start + t·step (n, 3), 0 <= t <= 1, that lies inside the ellipsoid."""
        to_ball = self.to_unit_ball.T
        o = (start - np.asarray(self.centre_mm)) @ to_ball
        d = step @ to_ball
        dd = np.einsum("ij,ij->i", d, d)
        dd[dd == 0] = 1.0  # avoids a division by 0; a segment without length has line integral 0
        nearest = -np.einsum("ij,ij->i", o, d) / dd
        # Computed from the ray's point nearest to the centre, as the quadratic formula would lose digits for far sources.
        foot = o + nearest[:, None] * d
        half = np.sqrt(np.maximum(1.0 - np.einsum("ij,ij->i", foot, foot), 0.0) / dd)
        return np.clip(nearest + half, 0.0, 1.0) - np.clip(nearest - half, 0.0, 1.0)

    def contains(self, x: Array, y: Array, z: Array) -> NDArray[np.bool_]:
        """Returns whether points, given by coordinates in mm that broadcast, lie inside the ellipsoid, bool (...)."""
        cx, cy, cz = self.centre_mm
        # Products are formed before the coordinates are broadcast to each other: this costs far less time than afterwards.
        rows = [m[0] * (x - cx) + m[1] * (y - cy) + m[2] * (z - cz) for m in self.to_unit_ball]
        return rows[0] ** 2 + rows[1] ** 2 + rows[2] ** 2 <= 1.0


@dataclass(frozen=True)
class Cylinder:
    """A straight wire or rod with flat ends between two points (x, y, z), whose attenuation adds to that of other bodies.
    Raises InputError for equal ends, a radius that is not positive, and values that are not finite."""

    ends_mm: tuple[Triple, Triple]
    radius_mm: float
    attenuation_per_mm: float

    def __post_init__(self) -> None:
        shape("cylinder ends_mm", self.ends_mm, (2, 3))
        finite("cylinder ends", self.ends_mm)
        finite("cylinder attenuation", self.attenuation_per_mm)
        positive("cylinder radius", self.radius_mm)
        if self.length_mm == 0:
            raise InputError("cylinder ends_mm", str(self.ends_mm), "two points")

    @property
    def length_mm(self) -> float:
        return float(np.linalg.norm(np.subtract(*self.ends_mm)))

    @property
    def axis(self) -> Array:
        """The unit vector (3,) from the first end to the second."""
        return np.asarray(np.subtract(self.ends_mm[1], self.ends_mm[0]) / self.length_mm)

    @property
    def centre_mm(self) -> Triple:
        x, y, z = np.mean(self.ends_mm, axis=0).tolist()
        return x, y, z

    @property
    def reach_mm(self) -> float:
        return self.radius_mm

    @property
    def half_box_mm(self) -> Array:
        """Half the sides (3,), x y z, of the smallest axis-aligned box around the cylinder."""
        along = np.abs(self.axis)
        return self.length_mm / 2 * along + self.radius_mm * np.sqrt(np.maximum(1 - along**2, 0))

    def chord_fraction(self, start: Array, step: Array) -> Array:
        """Returns the fraction (n,) of each segment start + t·step (n, 3), 0 <= t <= 1, that lies inside the cylinder."""
        o = start - np.asarray(self.ends_mm[0])
        height, rise = o @ self.axis, step @ self.axis
        o, d = o - height[:, None] * self.axis, step - rise[:, None] * self.axis
        dd = np.maximum(np.einsum("ij,ij->i", d, d), _PARALLEL)
        nearest = -np.einsum("ij,ij->i", o, d) / dd
        foot = o + nearest[:, None] * d
        half = np.sqrt(np.maximum(self.radius_mm**2 - np.einsum("ij,ij->i", foot, foot), 0.0) / dd)
        rise = np.where(np.abs(rise) < _PARALLEL, _PARALLEL, rise)
        ends = np.sort([-height / rise, (self.length_mm - height) / rise], axis=0)
        first, last = np.maximum(nearest - half, ends[0]), np.minimum(nearest + half, ends[1])
        return np.maximum(np.clip(last, 0.0, 1.0) - np.clip(first, 0.0, 1.0), 0.0)

    def contains(self, x: Array, y: Array, z: Array) -> NDArray[np.bool_]:
        """Returns whether points, given by coordinates in mm that broadcast, lie inside the cylinder, bool (...)."""
        points = [c - c0 for c, c0 in zip((x, y, z), self.ends_mm[0], strict=True)]
        height = sum(a * p for a, p in zip(self.axis, points, strict=True))
        across = sum((p - a * height) ** 2 for a, p in zip(self.axis, points, strict=True))
        return (across <= self.radius_mm**2) & (height >= 0) & (height <= self.length_mm)


Body = Ellipsoid | Cylinder


@dataclass(frozen=True)
class EllipsoidPhantom:
    """A sum of ellipsoids and cylinders, with exact line integrals."""

    ellipsoids: tuple[Body, ...]
    name: str
    kind: ClassVar[str] = "analytic"

    def __post_init__(self) -> None:
        object.__setattr__(self, "ellipsoids", tuple(self.ellipsoids))

    @property
    def reach_mm(self) -> float:
        """The radius in mm of a ball about the origin that contains every body."""
        return max(float(np.linalg.norm(body.ends_mm, axis=1).max()) + body.reach_mm for body in self.ellipsoids)

    def line_integrals(self, source: ArrayLike, target: ArrayLike) -> Array:
        """Integrates attenuation from ``source`` to ``target``, world points (..., 3) in mm, x y z, that broadcast.

        Returns (...) float64, dimensionless. A segment that misses every body, or has no length, gives 0. Raises InputError
        for a last axis whose length is not 3, and for shapes that do not broadcast."""
        start, end = _broadcast_points(source, target)
        result = np.zeros(start.shape[:-1])
        flat = result.reshape(-1)
        for first in range(0, flat.size, RAYS_PER_CHUNK):
            chunk = slice(first, min(first + RAYS_PER_CHUNK, flat.size))
            # Only the points of one chunk are copied. A reshape of the broadcast arrays would copy all points.
            where = np.unravel_index(np.arange(chunk.start, chunk.stop), result.shape) if result.ndim else ()
            p = start[where].reshape(-1, 3)
            flat[chunk] = self._segments(p, end[where].reshape(-1, 3) - p)
        return result

    def _segments(self, start: Array, step: Array) -> Array:
        total = np.zeros(len(start))
        for ellipsoid in self.ellipsoids:
            total += ellipsoid.attenuation_per_mm * ellipsoid.chord_fraction(start, step)
        return total * np.sqrt(np.einsum("ij,ij->i", step, step))

    def density(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
        """Returns the attenuation (...) float64 in 1/mm at points, given by coordinates in mm that broadcast."""
        px, py, pz = (np.asarray(c, dtype=np.float64) for c in (x, y, z))
        total = np.zeros(np.broadcast_shapes(px.shape, py.shape, pz.shape))
        for ellipsoid in self.ellipsoids:
            total += ellipsoid.attenuation_per_mm * ellipsoid.contains(px, py, pz)
        return total

    def voxelise(self, grid: Grid, supersampling: int = 2) -> NDArray[np.float32]:
        """Returns attenuation (nz, ny, nx) float32 in 1/mm, a mean over ``supersampling``³ points in each voxel. Raises
        InputError for a ``supersampling`` below 1."""
        if supersampling < 1:
            raise InputError("supersampling", str(supersampling), "an integer of at least 1")
        volume = np.zeros(grid.shape)
        for ellipsoid in self.ellipsoids:
            _add_ellipsoid(volume, ellipsoid, grid, int(supersampling))
        return volume.astype(np.float32)


def _broadcast_points(source: ArrayLike, target: ArrayLike) -> tuple[Array, Array]:
    start, end = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    try:
        common = np.broadcast_shapes(start.shape, end.shape)
    except ValueError:
        common = ()
    if not common or {start.shape[-1:], end.shape[-1:]} != {(3,)}:
        found = f"shapes {start.shape} and {end.shape}"
        raise InputError("ray source and target", found, "shapes (..., 3) that broadcast")
    return np.broadcast_to(start, common), np.broadcast_to(end, common)


def _add_ellipsoid(volume: Array, ellipsoid: Body, grid: Grid, samples: int) -> None:
    """Adds a body to ``volume`` (nz, ny, nx) in place. Samples only its bounding box, slice by slice, to save memory."""
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    centre, half = ellipsoid.centre_mm[::-1], ellipsoid.half_box_mm[::-1]
    ranges, fine = [], []
    for axis, d, c, h in zip(grid.axes_mm(), grid.voxel_size_mm, centre, half, strict=True):
        hit = np.flatnonzero(np.abs(axis - c) <= h + d / 2)
        if hit.size == 0:
            return
        ranges.append(slice(int(hit[0]), int(hit[-1]) + 1))
        fine.append((axis[ranges[-1], None] + offsets * d).ravel())
    zs, ys, xs = fine
    ny, nx = ys.size // samples, xs.size // samples
    for i, iz in enumerate(range(ranges[0].start, ranges[0].stop)):
        z = zs[i * samples : (i + 1) * samples, None, None]
        covered = ellipsoid.contains(xs[None, None, :], ys[None, :, None], z)
        mean = covered.reshape(samples, ny, samples, nx, samples).mean(axis=(0, 2, 4))
        volume[iz, ranges[1], ranges[2]] += ellipsoid.attenuation_per_mm * mean
