"""A double-layer sphere phantom, like those that cone-beam scanners are calibrated with.

Two horizontal circles of dense beads of several diameters, turned by half a step, in a light holder: sharp round edges
show blur and distortion at once.
"""

import numpy as np

from phyradgs_cl.checks import positive
from phyradgs_cl.phantoms.ellipsoids import Ellipsoid, EllipsoidPhantom

# All lengths in half-sizes, all densities in 1 / half-size.
_BEADS_PER_LAYER = 8
_LAYER_HEIGHT = 0.27
_CIRCLE_RADIUS = 0.52
_BEAD_RADII = (0.12, 0.06, 0.09, 0.045)  # repeated around a layer
_BEAD_DENSITY = 0.85
_HOLDER_DENSITY = 0.15
_HOLDER_AXES = (0.85, 0.85, 0.7)  # holds every bead entirely; inside the scanner's cylinder


def sphere_phantom(half_size_mm: float) -> EllipsoidPhantom:
    """The phantom inside a cube of side 2 · `half_size_mm` (else InputError) about the origin: beads of attenuation 1 /
    `half_size_mm` (holder included), the holder 0.15 / `half_size_mm`."""
    positive("half_size_mm", half_size_mm)
    unit = 1.0 / half_size_mm
    ax, ay, az = (a * half_size_mm for a in _HOLDER_AXES)
    bodies = [Ellipsoid((0.0, 0.0, 0.0), (ax, ay, az), _HOLDER_DENSITY * unit)]
    for layer, height in enumerate((-_LAYER_HEIGHT, _LAYER_HEIGHT)):
        for i in range(_BEADS_PER_LAYER):
            angle = 2 * np.pi * (i + layer / 2) / _BEADS_PER_LAYER
            x, y = _CIRCLE_RADIUS * np.cos(angle), _CIRCLE_RADIUS * np.sin(angle)
            # The second layer starts elsewhere in the list: large beads do not sit above large ones.
            radius = _BEAD_RADII[(i + 2 * layer) % len(_BEAD_RADII)] * half_size_mm
            centre = (float(x) * half_size_mm, float(y) * half_size_mm, height * half_size_mm)
            bodies.append(Ellipsoid(centre, (radius,) * 3, _BEAD_DENSITY * unit))
    return EllipsoidPhantom(tuple(bodies), "spheres")
