"""Phantoms: objects of known attenuation, to simulate scans and to compare reconstructions with. See ``make_phantom``.

Every phantom has ``name``, ``kind`` and ``voxelise(grid)``. An "analytic" phantom also has exact ``line_integrals(source,
target)``, and a "moving" phantom ``line_integrals(source, target, time_s)``. A "voxel" phantom has ``volume`` and ``grid``.
Attenuation is inversely proportional to the phantom's size, so that line integrals do not depend on it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.checks import finite, one_of, positive, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms.closed_form import (
    MovingBody,
    MovingPhantom,
    moving_sphere,
    shepp_logan,
    sphere_phantom,
)
from phyradgs_cl.phantoms.ellipsoids import Cylinder, Ellipsoid, EllipsoidPhantom, rotation_about_z
from phyradgs_cl.phantoms.procedural_foot import foot
from phyradgs_cl.phantoms.procedural_jaw import jaw

__all__ = [
    "PHANTOMS", "Cylinder", "Ellipsoid", "EllipsoidPhantom", "MovingBody", "MovingPhantom", "Phantom", "VoxelPhantom",
    "foot", "jaw", "make_phantom", "moving_sphere", "rotation_about_z", "shepp_logan", "sphere_phantom"
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class VoxelPhantom:
    """Attenuation (nz, ny, nx) float32 in 1/mm on a grid. Raises InputError for shapes that differ, NaN and infinity."""

    volume: NDArray[np.float32]
    grid: Grid
    name: str
    kind: ClassVar[str] = "voxel"

    def __post_init__(self) -> None:
        shape(f"phantom {self.name}", self.volume, self.grid.shape)
        finite(f"phantom {self.name}", self.volume)
        object.__setattr__(self, "volume", np.ascontiguousarray(self.volume, dtype=np.float32))

    def voxelise(self, grid: Grid, supersampling: int = 1) -> NDArray[np.float32]:
        """Returns the volume (nz, ny, nx). Raises InputError for a grid other than the phantom's: it is not resampled."""
        if grid != self.grid:
            remedy = "make the phantom at this resolution and size"
            raise InputError(f"grid for phantom {self.name}", str(grid), str(self.grid), remedy)
        return self.volume


Phantom = EllipsoidPhantom | MovingPhantom | VoxelPhantom
# (half_size_mm, resolution, seed) -> phantom. Phantoms without voxels ignore ``resolution`` and ``seed``.
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
    "moving-sphere": lambda half_size_mm, resolution, seed: moving_sphere(half_size_mm),
}


def make_phantom(name: str, half_size_mm: float, resolution: int = 128, seed: int = 0) -> Phantom:
    """Returns the phantom ``name``, a key of ``PHANTOMS``, in a cube of side 2 · ``half_size_mm`` about the origin.

    Voxel phantoms have ``resolution`` voxels per side, and ``seed`` varies their shape and texture. Raises InputError for
    an unknown name, and for a size or number that is not positive."""
    one_of("phantom", name, PHANTOMS)
    positive("half_size_mm", half_size_mm)
    positive("resolution", resolution)
    return PHANTOMS[name](half_size_mm, int(resolution), seed)
