"""Phantoms: objects whose attenuation is known, for simulations and for truth to compare with; `make_phantom` is the door.

All have `name`, `kind` and `voxelise(grid)`; an "analytic" one also `line_integrals(source, target)` in closed form, a
"voxel" one `volume` and `grid`. Attenuation scales with 1 / half-size, so that line integrals do not depend on the size.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.checks import one_of, positive
from phyradgs_cl.fields.volume import Grid
from phyradgs_cl.phantoms.ellipsoids import Cylinder, Ellipsoid, EllipsoidPhantom, rotation_about_z
from phyradgs_cl.phantoms.procedural_foot import foot
from phyradgs_cl.phantoms.procedural_jaw import jaw
from phyradgs_cl.phantoms.shepp_logan import shepp_logan
from phyradgs_cl.phantoms.spheres import sphere_phantom
from phyradgs_cl.phantoms.voxels import VoxelPhantom

__all__ = [
    "PHANTOMS", "Cylinder", "Ellipsoid", "EllipsoidPhantom", "Phantom", "VoxelPhantom", "foot", "jaw",
    "make_phantom", "rotation_about_z", "shepp_logan", "sphere_phantom"
]  # fmt: skip

Phantom = EllipsoidPhantom | VoxelPhantom
# (half_size_mm, resolution, seed) -> phantom; closed forms have no use for the last two.
Factory = Callable[[float, int, int], Phantom]


def _from_voxels(name: str, draw: Callable[[int, int], NDArray[np.float32]]) -> Factory:
    def make(half_size_mm: float, resolution: int, seed: int) -> Phantom:
        volume = draw(resolution, seed) / np.float32(half_size_mm)
        return VoxelPhantom(volume, Grid.cube(resolution, 2 * half_size_mm), name)

    return make


PHANTOMS: dict[str, Factory] = {
    "foot": _from_voxels("foot", foot),
    "jaw": _from_voxels("jaw", jaw),
    "shepp-logan": lambda half_size_mm, resolution, seed: shepp_logan(half_size_mm),
    "spheres": lambda half_size_mm, resolution, seed: sphere_phantom(half_size_mm),
}


def make_phantom(name: str, half_size_mm: float, resolution: int = 128, seed: int = 0) -> Phantom:
    """A phantom by its name, a key of `PHANTOMS`, in a cube of side 2 · `half_size_mm` about the origin.

    Voxel phantoms have `resolution` voxels per side; `seed` is of the procedural ones' shape and texture. Raises
    InputError for an unknown name (the message lists the known ones), or a size or count that is not positive.
    """
    one_of("phantom", name, PHANTOMS)
    positive("half_size_mm", half_size_mm)
    positive("resolution", resolution)
    return PHANTOMS[name](half_size_mm, int(resolution), seed)
