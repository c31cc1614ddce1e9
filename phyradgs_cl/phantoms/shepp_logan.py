"""The 3D Shepp-Logan head phantom in Kak and Slaney's table.

Geometry: A. C. Kak and M. Slaney, Principles of Computerized Tomographic Imaging, IEEE Press 1988, table 3.2 with the
authors' errata, as in TIGRE and RTK. "kak-slaney" has the table's own contrasts (details of 1-2 %), "toft" tens of per
cent, after P. Toft's PhD thesis, DTU 1996, in the values of H. Yu, Y. Ye and G. Wang (Proc. SPIE 5535, 550-557, 2004).
"""

import numpy as np

from phyradgs_cl.checks import one_of, positive
from phyradgs_cl.phantoms.ellipsoids import Ellipsoid, EllipsoidPhantom, rotation_about_z

# centre x, y, z | semi-axes a, b, c | rotation about z in degrees; lengths in half-sizes
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
    """The phantom inside a cube of side 2 · `half_size_mm` about the origin.

    `variant`: "toft" (high contrast) or "kak-slaney". `unit_attenuation_per_mm`: what grey level 1 means, by default
    1 / `half_size_mm`, so that line integrals do not depend on the size. InputError: size or variant.
    """
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
