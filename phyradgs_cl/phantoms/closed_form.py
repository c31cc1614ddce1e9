"""Phantoms with exact line integrals: Shepp and Logan's head, circles of beads, and the moving sphere of the tests of RTK
(Reconstruction Toolkit)."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import at_least, one_of, positive, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms.ellipsoids import Array, Body, Ellipsoid, EllipsoidPhantom, Triple, rotation_about_z

# Shepp-Logan: centre x, y, z; semi-axes; rotation about z in degrees. Lengths are in units of ``half_size_mm``.
_BODIES = (
    (0.0, 0.0, 0.0, 0.69, 0.92, 0.9, 0.0),
    (0.0, 0.0, 0.0, 0.6624, 0.874, 0.88, 0.0),
    (-0.22, 0.0, -0.25, 0.41, 0.16, 0.21, 108.0),
    (0.22, 0.0, -0.25, 0.31, 0.11, 0.22, 72.0),
    (0.0, 0.35, -0.25, 0.21, 0.25, 0.5, 0.0),
    (0.0, 0.1, -0.25, 0.046, 0.046, 0.046, 0.0),
    (-0.08, -0.65, -0.25, 0.046, 0.023, 0.02, 0.0),
    (0.06, -0.65, -0.25, 0.046, 0.023, 0.02, 90.0),
    (0.06, -0.105, 0.625, 0.056, 0.04, 0.1, 90.0),
    (0.0, 0.1, 0.625, 0.056, 0.056, 0.1, 0.0),
)
_GREY_LEVELS = {
    "toft": (1.0, -0.8, -0.2, -0.2, 0.2, 0.2, 0.1, 0.1, 0.2, -0.2),
    "kak-slaney": (2.0, -0.98, -0.02, -0.02, 0.02, 0.02, 0.01, 0.01, 0.02, -0.02),
}
_OUTER, _INNER, _SWING = 60 / 64, 8 / 64, 8 / 64  # RTK's radii and swing in mm, divided by 64 mm, half its box's side
_STEPS = 8  # number of frames in which RTK's sphere goes forth and back


def shepp_logan(
    half_size_mm: float, variant: str = "toft", unit_attenuation_per_mm: float | None = None
) -> EllipsoidPhantom:
    """Returns Shepp and Logan's head in a cube of side 2 · ``half_size_mm`` about the origin.

    variant: "toft" (high contrast) or "kak-slaney". unit_attenuation_per_mm: the attenuation in 1/mm of grey level 1. None
    takes 1 / ``half_size_mm``, so that line integrals do not depend on the size.

    Raises InputError for a size or attenuation not above 0, and for another variant."""
    positive("half_size_mm", half_size_mm)
    one_of("Shepp-Logan variant", variant, _GREY_LEVELS)
    unit = 1.0 / half_size_mm if unit_attenuation_per_mm is None else unit_attenuation_per_mm
    positive("unit_attenuation_per_mm", unit)
    bodies = []
    for (x, y, z, a, b, c, angle_deg), grey in zip(_BODIES, _GREY_LEVELS[variant], strict=True):
        centre = (x * half_size_mm, y * half_size_mm, z * half_size_mm)
        axes = (a * half_size_mm, b * half_size_mm, c * half_size_mm)
        bodies.append(Ellipsoid(centre, axes, grey * unit, rotation_about_z(np.deg2rad(angle_deg))))
    return EllipsoidPhantom(tuple(bodies), "shepp-logan")


# The phantom of beads. Lengths are in units of ``half_size_mm``, densities in units of 1 / ``half_size_mm``.
_BEADS_PER_LAYER = 8
_LAYER_HEIGHT = 0.27
_CIRCLE_RADIUS = 0.52
_BEAD_RADII = (0.12, 0.06, 0.09, 0.045)  # radii that the beads of a circle take in turn
_BEAD_DENSITY = 0.85
_HOLDER_DENSITY = 0.15
_HOLDER_AXES = (0.85, 0.85, 0.7)  # the holder contains every bead and stays in the field of view


def sphere_phantom(half_size_mm: float) -> EllipsoidPhantom:
    """Returns two horizontal circles of dense beads in a light holder. Beads of one circle stand above gaps of the other.

    Their round edges show blur and distortion, as in the phantoms that calibrate cone-beam scanners. The cube of side 2 ·
    ``half_size_mm`` is about the origin. A bead attenuates 1 / ``half_size_mm``, the holder 0.15 times that."""
    positive("half_size_mm", half_size_mm)
    unit = 1.0 / half_size_mm
    ax, ay, az = (a * half_size_mm for a in _HOLDER_AXES)
    bodies = [Ellipsoid((0.0, 0.0, 0.0), (ax, ay, az), _HOLDER_DENSITY * unit)]
    for layer, height in enumerate((-_LAYER_HEIGHT, _LAYER_HEIGHT)):
        for i in range(_BEADS_PER_LAYER):
            angle = 2 * np.pi * (i + layer / 2) / _BEADS_PER_LAYER
            x, y = _CIRCLE_RADIUS * np.cos(angle), _CIRCLE_RADIUS * np.sin(angle)
            # The second circle begins with another radius, so that large beads do not stand above large ones.
            radius = _BEAD_RADII[(i + 2 * layer) % len(_BEAD_RADII)] * half_size_mm
            centre = (float(x) * half_size_mm, float(y) * half_size_mm, height * half_size_mm)
            bodies.append(Ellipsoid(centre, (radius,) * 3, _BEAD_DENSITY * unit))
    return EllipsoidPhantom(tuple(bodies), "spheres")


@dataclass(frozen=True)
class MovingBody:
    """A body that moves forth and back along a line at constant speed.

    body: the body when it is at the middle of the line. swing_mm: the vector (x, y, z) from the middle to the end that the
    body reaches after half a period. At time 0 the body is at the other end. period_s: the time forth and back. Raises
    InputError for a period that is not positive."""

    body: Body
    swing_mm: Triple
    period_s: float

    def __post_init__(self) -> None:
        shape("swing_mm", self.swing_mm, (3,))
        positive("period_s", self.period_s)

    def shift_mm(self, time_s: ArrayLike) -> Array:
        """Returns the body's displacement (n, 3), x y z in mm, from the middle of its line at times (n,) in s."""
        phase = np.atleast_1d(np.asarray(time_s, np.float64)) / self.period_s
        way = np.interp(phase, [0.0, 0.5, 1.0], [-1.0, 1.0, -1.0], period=1.0)
        return np.outer(way, self.swing_mm)

    def at(self, time_s: float) -> Body:
        """Returns the body where it is at a time in s."""
        shift_mm = self.shift_mm(time_s)[0]
        if isinstance(self.body, Ellipsoid):
            x, y, z = (np.asarray(self.body.centre_mm) + shift_mm).tolist()
            return replace(self.body, centre_mm=(x, y, z))
        first, last = (np.asarray(self.body.ends_mm) + shift_mm).tolist()
        return replace(self.body, ends_mm=(tuple(first), tuple(last)))


@dataclass(frozen=True)
class MovingPhantom:
    """A sum of bodies at rest and of bodies that move, with exact line integrals at any time.

    Raises InputError for bodies with different periods, and if no body moves."""

    resting: tuple[Body, ...]
    moving: tuple[MovingBody, ...]
    name: str
    kind: ClassVar[str] = "moving"

    def __post_init__(self) -> None:
        at_least(f"phantom {self.name}: moving bodies", len(self.moving), 1)
        periods = {body.period_s for body in self.moving}
        if len(periods) > 1:
            raise InputError(f"phantom {self.name}: periods", str(sorted(periods)), "one period for all bodies")

    @property
    def period_s(self) -> float:
        return self.moving[0].period_s

    @property
    def reach_mm(self) -> float:
        """The radius in mm of a ball about the origin that contains every body at all times."""
        ends = [body.at(part * body.period_s) for body in self.moving for part in (0.0, 0.5)]
        return EllipsoidPhantom((*self.resting, *ends), self.name).reach_mm

    @property
    def fastest_mm_per_s(self) -> float:
        """The speed of the fastest body in mm/s."""
        return max(4 * float(np.linalg.norm(body.swing_mm)) / body.period_s for body in self.moving)

    def at(self, time_s: float) -> EllipsoidPhantom:
        """Returns a phantom at rest that equals this one at a time in s."""
        return EllipsoidPhantom((*self.resting, *(body.at(time_s) for body in self.moving)), self.name)

    def line_integrals(self, source: ArrayLike, target: ArrayLike, time_s: ArrayLike) -> Array:
        """Integrates attenuation from ``source`` to ``target``, world points (n, ..., 3) in mm that broadcast.

        time_s (n,): the time of each entry along the first axis. Returns (n, ...) float64, dimensionless."""
        start, end = np.asarray(source, np.float64), np.asarray(target, np.float64)
        total = EllipsoidPhantom(self.resting, self.name).line_integrals(start, end)
        for body in self.moving:
            shift_mm = body.shift_mm(time_s)
            shift_mm = shift_mm.reshape(len(shift_mm), *(1,) * (end.ndim - 2), 3)
            total = total + EllipsoidPhantom((body.body,), self.name).line_integrals(start - shift_mm, end - shift_mm)
        return total

    def voxelise(self, grid: Grid, supersampling: int = 2) -> NDArray[np.float32]:
        """Returns mean attenuation (nz, ny, nx) float32 in 1/mm at time 0."""
        return self.at(0.0).voxelise(grid, supersampling)


def moving_sphere(half_size_mm: float, period_s: float = float(_STEPS)) -> MovingPhantom:
    """Returns a ball in which a small sphere, half as dense, moves along y. The cube of side 2 · ``half_size_mm`` is about
    the origin.

    A half-size of 64 mm gives the lengths of RTK's tests: a ball of radius 60 mm, and in it a sphere of radius 8 mm that
    moves by ±8 mm in 8 frames of 1 s (S. Rit et al., J. Phys. Conf. Ser. 489, 012079, 2014). The ball's attenuation is
    1 / ``half_size_mm`` and the small sphere's half of it, as with RTK's added densities of 2 and −1."""
    positive("half_size_mm", half_size_mm)
    outer, inner, swing = (share * half_size_mm for share in (_OUTER, _INNER, _SWING))
    ball = Ellipsoid((0.0, 0.0, 0.0), (outer,) * 3, 1 / half_size_mm)
    hole = Ellipsoid((0.0, 0.0, 0.0), (inner,) * 3, -0.5 / half_size_mm)
    return MovingPhantom((ball,), (MovingBody(hole, (0.0, swing, 0.0), period_s),), "moving-sphere")
