"""A volume as other programs see it: values, spacing and origin in their frame of patient directions.

The world's x, y, z are left, posterior, superior (LPS, the frame of DICOM and ITK): z, the rotation axis, is up in
every viewer, and a slice looks the same in viewers that know directions and in those that show row 0 at the top.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import StoredVolume, written_beside

Triple = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Placed:
    """Values (z, y, x) float32 in ``unit``; spacing and the centre of voxel (0, 0, 0) as (x, y, z) in mm, LPS."""

    values: np.ndarray
    spacing_mm: Triple
    origin_mm: Triple
    unit: str

    @property
    def is_hu(self) -> bool:
        """Whether the values are Hounsfield units."""
        return self.unit == "HU"

    @property
    def shape_xyz(self) -> tuple[int, int, int]:
        """Counts along x, y, z."""
        z, y, x = self.values.shape
        return x, y, z


def placed(stored: StoredVolume, mu_water_per_mm: float | None = None) -> Placed:
    """A volume in 1/mm, or in Hounsfield units where the attenuation of water is given."""
    values, unit = np.ascontiguousarray(stored.volume, np.float32), "1/mm"
    if mu_water_per_mm is not None:
        values, unit = hounsfield(values, mu_water_per_mm), "HU"
    return Placed(values, _xyz(stored.grid.voxel_size_mm), _xyz(stored.grid.first_centre_mm), unit)


def hounsfield(values: np.ndarray, mu_water_per_mm: float) -> np.ndarray:
    """1000 (μ/μ_water − 1) as float32: water 0, nothing −1000."""
    checks.within("--mu-water-per-mm", mu_water_per_mm, 1e-6, 1e3)
    with np.errstate(over="ignore"):
        hu = (1000.0 * (values.astype(np.float64) / mu_water_per_mm - 1.0)).astype(np.float32)
    if not np.isfinite(hu).all():
        expected = "water's attenuation in 1/mm, near 0.02"
        raise InputError("--mu-water-per-mm", f"{mu_water_per_mm:g}", expected)
    return hu


def write_whole(path: Path, head: bytes, values: np.ndarray) -> None:
    """A file of a header and float32 in little endian behind it, whole or not at all."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        file.write(head)
        file.write(np.ascontiguousarray(values, "<f4").data.cast("B"))


def _xyz(triple: Triple) -> Triple:
    z, y, x = triple
    return x, y, z
