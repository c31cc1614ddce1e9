"""Phantoms in closed form whose bodies move: the moving sphere of RTK's motion-compensation tests."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import at_least, positive, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms.ellipsoids import Array, Body, Ellipsoid, EllipsoidPhantom, Triple

_OUTER, _INNER, _SWING = 60 / 64, 8 / 64, 8 / 64  # RTK's mm over half of its box of 128 mm
_STEPS = 8  # frames of RTK's cycle, which the sphere crosses forth and back


@dataclass(frozen=True)
class MovingBody:
    """A body that goes from end to end of a line and back at constant speed.

    body: in the middle of its way. swing_mm: (x, y, z) from there to the end that it reaches after half a period; it starts
    at the other end. period_s: of the way there and back. Raises InputError for a period that is not positive."""

    body: Body
    swing_mm: Triple
    period_s: float

    def __post_init__(self) -> None:
        shape("swing_mm", self.swing_mm, (3,))
        positive("period_s", self.period_s)

    def shift_mm(self, time_s: ArrayLike) -> Array:
        """Returns the shift (n, 3) from the middle at times (n,)."""
        phase = np.atleast_1d(np.asarray(time_s, np.float64)) / self.period_s
        way = np.interp(phase, [0.0, 0.5, 1.0], [-1.0, 1.0, -1.0], period=1.0)
        return np.outer(way, self.swing_mm)

    def at(self, time_s: float) -> Body:
        """Returns the body where it is at a time."""
        shift_mm = self.shift_mm(time_s)[0]
        if isinstance(self.body, Ellipsoid):
            x, y, z = (np.asarray(self.body.centre_mm) + shift_mm).tolist()
            return replace(self.body, centre_mm=(x, y, z))
        first, last = (np.asarray(self.body.ends_mm) + shift_mm).tolist()
        return replace(self.body, ends_mm=(tuple(first), tuple(last)))


@dataclass(frozen=True)
class MovingPhantom:
    """A sum of bodies at rest and of bodies that move, with exact line integrals at any time. Raises InputError for bodies
    with different periods, and for none that moves."""

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
        """Radius of a ball about the origin that holds every body at any time."""
        ends = [body.at(part * body.period_s) for body in self.moving for part in (0.0, 0.5)]
        return EllipsoidPhantom((*self.resting, *ends), self.name).reach_mm

    @property
    def fastest_mm_per_s(self) -> float:
        """The speed of the fastest body."""
        return max(4 * float(np.linalg.norm(body.swing_mm)) / body.period_s for body in self.moving)

    def at(self, time_s: float) -> EllipsoidPhantom:
        """Returns the phantom as it is at a time."""
        return EllipsoidPhantom((*self.resting, *(body.at(time_s) for body in self.moving)), self.name)

    def line_integrals(self, source: ArrayLike, target: ArrayLike, time_s: ArrayLike) -> Array:
        """Integrates attenuation from ``source`` to ``target``, world points (n, ..., 3) in mm that broadcast, the n-th
        along the first axis at the n-th time (n,). Returns (n, ...) float64."""
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
    """Returns a ball in which a small hole goes to and fro along y, in a cube of side 2 · ``half_size_mm`` about the origin.

    With 64 mm it has the lengths of RTK's tests: a ball of 60 mm, in it one of 8 mm that moves by ±8 mm in 8 frames, where
    frames follow each other by 1 s (S. Rit et al., J. Phys. Conf. Ser. 489, 012079, 2014). The ball attenuates
    1 / ``half_size_mm``, in the hole half of that, as RTK's densities of 2 and −1."""
    positive("half_size_mm", half_size_mm)
    outer, inner, swing = (share * half_size_mm for share in (_OUTER, _INNER, _SWING))
    ball = Ellipsoid((0.0, 0.0, 0.0), (outer,) * 3, 1 / half_size_mm)
    hole = Ellipsoid((0.0, 0.0, 0.0), (inner,) * 3, -0.5 / half_size_mm)
    return MovingPhantom((ball,), (MovingBody(hole, (0.0, swing, 0.0), period_s),), "moving-sphere")
