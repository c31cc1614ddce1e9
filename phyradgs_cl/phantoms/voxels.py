"""A phantom that is a volume on a grid."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.checks import finite, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.volume import Grid


@dataclass(frozen=True, eq=False)
class VoxelPhantom:
    """Attenuation (nz, ny, nx) float32 in 1/mm on a grid. InputError: shapes that differ, NaN or infinity."""

    volume: NDArray[np.float32]
    grid: Grid
    name: str
    kind: ClassVar[str] = "voxel"

    def __post_init__(self) -> None:
        shape(f"phantom {self.name}", self.volume, self.grid.shape)
        finite(f"phantom {self.name}", self.volume)
        object.__setattr__(self, "volume", np.ascontiguousarray(self.volume, dtype=np.float32))

    def voxelise(self, grid: Grid, supersampling: int = 1) -> NDArray[np.float32]:
        """The volume (nz, ny, nx) itself,  InputError for another grid: nothing is resampled."""
        if grid != self.grid:
            remedy = "make the phantom at this resolution and size"
            raise InputError(f"grid for phantom {self.name}", str(grid), str(self.grid), remedy)
        return self.volume
