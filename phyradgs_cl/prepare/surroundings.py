"""What lies around the box that is wanted: reconstructed on coarser voxels, projected and taken out of the frames,
discarded.

Ziegler, Nielsen and Grass, Med. Phys. 35 (2008) 1317. For methods that explain frames by what is in the box alone.
"""

from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.prepare.step import Facts, MakeModel


@dataclass(frozen=True)
class SurroundingOptions:
    """wider: sides of the box that is reconstructed over those of the one that is wanted; coarser: its voxels over the
    scan's."""

    wider: float = 2.0
    coarser: float = 2.0

    def __post_init__(self) -> None:
        checks.fields_within("surroundings.", self, {"wider": (1.01, 16), "coarser": (1, 16)})


def surrounding_grid(grid: Grid, wider: float, coarser: float) -> tuple[Grid, tuple[slice, slice, slice]]:
    """A grid about ``grid`` whose voxels are whole inside and outside of it, and where in it (z, y, x) ``grid`` is."""
    inner = [max(1, round(n / coarser)) for n in grid.shape]
    margin = [max(1, int(np.ceil((wider - 1) / 2 * m))) for m in inner]
    shape = [m + 2 * k for m, k in zip(inner, margin, strict=True)]
    voxel_mm = [size / m for size, m in zip(grid.size_mm, inner, strict=True)]
    part = [slice(k, k + m) for m, k in zip(inner, margin, strict=True)]
    about = Grid((shape[0], shape[1], shape[2]), (voxel_mm[0], voxel_mm[1], voxel_mm[2]), grid.offset_mm)
    return about, (part[0], part[1], part[2])


def subtract_surroundings(scan: Scan, options: SurroundingOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan as if there were nothing outside its grid."""
    about, inside = surrounding_grid(scan.grid, options.wider, options.coarser)
    model = make_model(scan.on_grid(about))
    volume = model.fitted()
    volume[inside] = 0
    outside = model.frames(volume)
    share = float(np.abs(outside).sum() / max(float(np.abs(scan.projections).sum()), 1e-20))
    facts = {"shape": list(about.shape), "voxel_mm": list(about.voxel_size_mm), "share": share}
    return replace(scan, projections=scan.projections - outside), facts
