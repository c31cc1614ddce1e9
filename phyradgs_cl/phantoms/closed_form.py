"""Phantoms in closed form: the 3D Shepp-Logan head and a double-layer sphere phantom.

Shepp-Logan: A. C. Kak and M. Slaney, Principles of Computerized Tomographic Imaging, IEEE Press 1988, table 3.2 with the
authors' errata, as in TIGRE and RTK. "kak-slaney" has the table's own contrasts (details of 1-2 %), "toft" tens of per
cent, after P. Toft's PhD thesis, DTU 1996, in the values of H. Yu, Y. Ye and G. Wang (Proc. SPIE 5535, 550-557, 2004)."""

import numpy as np

from phyradgs_cl.checks import one_of, positive
from phyradgs_cl.phantoms.ellipsoids import Ellipsoid, EllipsoidPhantom, rotation_about_z

# Shepp-Logan: centre x, y, z | semi-axes a, b, c | rotation about z in degrees; lengths in half-sizes
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


def shepp_logan(
    half_size_mm: float, variant: str = "toft", unit_attenuation_per_mm: float | None = None
) -> EllipsoidPhantom:
    """Returns the head in a cube of side 2 · ``half_size_mm`` about the origin.

    ``variant``: "toft" (high contrast) or "kak-slaney". ``unit_attenuation_per_mm``: attenuation of grey level 1, by default
    1 / ``half_size_mm``, so that line integrals do not depend on the size. Raises InputError for a wrong size or variant."""
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


# Spheres: lengths in half-sizes, densities in 1 / half-size.
_BEADS_PER_LAYER = 8
_LAYER_HEIGHT = 0.27
_CIRCLE_RADIUS = 0.52
_BEAD_RADII = (0.12, 0.06, 0.09, 0.045)  # repeated around a layer
_BEAD_DENSITY = 0.85
_HOLDER_DENSITY = 0.15
_HOLDER_AXES = (0.85, 0.85, 0.7)  # contains every bead and fits into the scanner's cylinder


def sphere_phantom(half_size_mm: float) -> EllipsoidPhantom:
    """Returns two horizontal circles of dense beads, the second turned by half a step, in a light holder.

    Round edges show blur and distortion, as in the phantoms that cone-beam scanners are calibrated with. In a cube of side
    2 · ``half_size_mm`` about the origin beads attenuate 1 / ``half_size_mm`` (holder included), the holder 0.15 times that.
    """
    positive("half_size_mm", half_size_mm)
    unit = 1.0 / half_size_mm
    ax, ay, az = (a * half_size_mm for a in _HOLDER_AXES)
    bodies = [Ellipsoid((0.0, 0.0, 0.0), (ax, ay, az), _HOLDER_DENSITY * unit)]
    for layer, height in enumerate((-_LAYER_HEIGHT, _LAYER_HEIGHT)):
        for i in range(_BEADS_PER_LAYER):
            angle = 2 * np.pi * (i + layer / 2) / _BEADS_PER_LAYER
            x, y = _CIRCLE_RADIUS * np.cos(angle), _CIRCLE_RADIUS * np.sin(angle)
            # The second layer starts elsewhere in the list, so that large beads do not sit above large ones.
            radius = _BEAD_RADII[(i + 2 * layer) % len(_BEAD_RADII)] * half_size_mm
            centre = (float(x) * half_size_mm, float(y) * half_size_mm, height * half_size_mm)
            bodies.append(Ellipsoid(centre, (radius,) * 3, _BEAD_DENSITY * unit))
    return EllipsoidPhantom(tuple(bodies), "spheres")
