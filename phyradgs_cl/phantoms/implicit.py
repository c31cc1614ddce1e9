"""Bodies for procedural phantoms: signed distances, smooth unions, band-limited texture.

Bodies are functions of position in the cube [-1, 1]^3, averaged over voxels, so every resolution shows the same object.
Lengths are in half sides of the cube. Distances are negative inside a body. Points are (x, y, z); arrays are (z, y, x),
float32."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Field = NDArray[np.float32]
Box = tuple[slice, slice, slice]
Point = tuple[float, float, float]

FAR = np.float32(4.0)  # stands for a large distance: no two points of the cube are this far apart
_REACH = 5.0  # a body counts in a smooth union up to this distance, in blend widths: beyond, it adds less than exp(-5)


@dataclass(frozen=True)
class Capsule:
    """A tapered capsule: the space swept by a sphere that moves from `p0` to `p1` as its radius goes from `r0` to `r1`."""

    p0: Point
    p1: Point
    r0: float
    r1: float

    def grown(self, width: float) -> "Capsule":
        """Returns the capsule with radii larger by ``width``."""
        return Capsule(self.p0, self.p1, self.r0 + width, self.r1 + width)


@dataclass(frozen=True)
class Lattice:
    """A lattice of voxels that fill the cube [-1, 1]^3, `count` along each axis."""

    count: int

    @property
    def step(self) -> float:
        return 2.0 / self.count

    @property
    def everything(self) -> Box:
        return (slice(0, self.count),) * 3

    def axis(self) -> Field:
        """Returns the voxel centres (count,) along any of the three axes."""
        return ((np.arange(self.count) + 0.5) * self.step - 1.0).astype(np.float32)

    def points(self, box: Box) -> tuple[Field, Field, Field]:
        """Returns the coordinates x (1, 1, nx), y (1, ny, 1), z (nz, 1, 1) of a box of voxels."""
        axis = self.axis()
        return axis[None, None, box[2]], axis[None, box[1], None], axis[box[0], None, None]

    def box(self, low: ArrayLike, high: ArrayLike) -> Box:
        """Returns the voxels (z, y, x) that may touch the world box from ``low`` to ``high`` (x, y, z)."""
        first = np.floor((np.asarray(low) + 1.0) / self.step).astype(int) - 1
        last = np.ceil((np.asarray(high) + 1.0) / self.step).astype(int) + 1
        x, y, z = (slice(max(int(a), 0), max(int(b), 0)) for a, b in zip(first, last, strict=True))
        return (z, y, x)

    def coverage(self, distance: Field) -> Field:
        """Returns the fraction of each voxel that lies in a body, from the voxel centre's signed ``distance`` to the body,
        as if the body's surface were parallel to a face of the voxel."""
        return np.clip(0.5 - distance / np.float32(self.step), 0.0, 1.0)


def capsule_distance(capsule: Capsule, x: Field, y: Field, z: Field) -> Field:
    """Returns the signed distance to a capsule, for coordinates that broadcast. It is exact for equal radii."""
    a, b = np.asarray(capsule.p0), np.asarray(capsule.p1)
    axis = (b - a).astype(np.float32)
    length2 = np.float32(max(float(axis @ axis), 1e-12))
    px, py, pz = x - np.float32(a[0]), y - np.float32(a[1]), z - np.float32(a[2])
    along = np.clip((px * axis[0] + py * axis[1] + pz * axis[2]) / length2, 0.0, 1.0)
    radial = (px - along * axis[0]) ** 2 + (py - along * axis[1]) ** 2 + (pz - along * axis[2]) ** 2
    return np.sqrt(radial) - (np.float32(capsule.r0) + along * np.float32(capsule.r1 - capsule.r0))


def ratio_distance(offsets: Sequence[Field], semi_axes: Sequence[ArrayLike]) -> Field:
    """Returns the signed distance to the surface Σ (offset / semi-axis)² = 1, to first order in the distance. Semi-axes may
    be arrays."""
    scaled = sum((o / np.asarray(s, np.float32)) ** 2 for o, s in zip(offsets, semi_axes, strict=True))
    slopes = sum((o / np.asarray(s, np.float32) ** 2) ** 2 for o, s in zip(offsets, semi_axes, strict=True))
    radius = np.sqrt(scaled)
    return np.asarray(radius * (radius - 1.0) / np.sqrt(np.maximum(slopes, 1e-12)), dtype=np.float32)


def capsule_box(lattice: Lattice, capsules: Sequence[Capsule], margin: float) -> Box:
    """Returns the box of voxels around all ``capsules``, widened by ``margin``."""
    ends = np.array([p for c in capsules for p in (c.p0, c.p1)])
    radii = np.array([r for c in capsules for r in (c.r0, c.r1)])[:, None] + margin
    return lattice.box((ends - radii).min(axis=0), (ends + radii).max(axis=0))


def capsule_union(
    lattice: Lattice, capsules: Sequence[Capsule], blend: float, box: Box, bodies: Iterable[Field] = ()
) -> Field:
    """Returns the signed distance to the smooth union of capsules, for a box of voxels, or FAR where none is near. bodies:
    the voxels' distances to further bodies of the union. blend: the width over which bodies merge."""
    x, y, z = lattice.points(box)
    union = np.zeros((z.size, y.size, x.size), dtype=np.float32)

    def add(part: Box, distance: Field) -> None:
        union[part] += np.exp(np.clip(-distance / np.float32(blend), -60.0, 60.0))

    for distance in bodies:
        add((slice(None),) * 3, distance)
    for capsule in capsules:
        inner = _intersect(capsule_box(lattice, [capsule], _REACH * blend), box)
        xs, ys, zs = x[..., inner[2]], y[:, inner[1], :], z[inner[0]]
        if xs.size and ys.size and zs.size:
            add(inner, capsule_distance(capsule, xs, ys, zs))
    with np.errstate(divide="ignore"):
        return np.minimum(-np.float32(blend) * np.log(union), FAR)


def _intersect(part: Box, box: Box) -> Box:
    """Returns the intersection of two boxes, with indices that count from the first voxel of ``box``."""
    z, y, x = (
        slice(max(p.start, b.start) - b.start, max(min(p.stop, b.stop) - b.start, 0))
        for p, b in zip(part, box, strict=True)
    )
    return (z, y, x)


def texture(
    lattice: Lattice, wavelengths: tuple[float, float], waves: int, rng: np.random.Generator
) -> Field:
    """Draws isotropic noise (n, n, n) float32: ``waves`` random cosines whose sum has variance 1, averaged over each voxel.

    The cosines' wavelengths lie between the two ``wavelengths``. The draws from ``rng`` do not depend on the resolution."""
    direction = rng.standard_normal((waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    k = 2 * np.pi * direction / rng.uniform(*wavelengths, waves)[:, None]  # wave vectors, in rad per unit length
    phase = rng.uniform(0, 2 * np.pi, waves)
    mean = np.prod(np.sinc(k * lattice.step / (2 * np.pi)), axis=1)  # how much averaging over a voxel damps each cosine
    amplitude = np.sqrt(2.0 / waves) * mean
    axis = lattice.axis().astype(np.float64)
    ex, ey, ez = (np.exp(1j * np.outer(axis, k[:, i])).astype(np.complex64) for i in range(3))
    ez = ez * (amplitude * np.exp(1j * phase)).astype(np.complex64)
    n = lattice.count
    # cos(a + b + c) is the real part of e^ia e^ib e^ic, so a matrix product per slice replaces n^3 cosines.
    noise = np.empty((n, n, n), dtype=np.float32)
    for i in range(n):
        noise[i] = ((ey * ez[i]) @ ex.T).real
    return noise
