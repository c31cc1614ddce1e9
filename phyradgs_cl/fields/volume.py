"""``Grid``, a regular voxel grid in world coordinates, and ``Metal``, the metal in an object."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

if TYPE_CHECKING:
    from xarray import DataArray

MOST_VOXELS = 2**38
"""The most voxels of a grid: a terabyte of float32. Larger numbers come from damaged files."""
_SAME_PLACE = 1e-3  # voxels of two grids closer than this, in voxels, are at the same place: float32 rounds stored grids
T = TypeVar("T")


def triple(values: Iterable[T]) -> tuple[T, T, T]:
    """Returns three values (z, y, x) as a tuple whose length type checkers know."""
    z, y, x = values
    return z, y, x


@dataclass(frozen=True)
class Grid:
    """A box of voxels centred at ``offset_mm``. All triples are (z, y, x), like the arrays.

    shape: numbers of voxels. voxel_size_mm: sides of a voxel. Raises InputError for a number of voxels that is below 1 or
    not whole, more than ``MOST_VOXELS`` voxels, lengths that are not finite, and sides that are not above 0."""

    shape: tuple[int, int, int]
    voxel_size_mm: tuple[float, float, float]
    offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        shape = checks.numbers("grid shape", self.shape, (3,))
        if (shape < 1).any() or (shape != np.floor(shape)).any():
            raise InputError("grid shape", str(self.shape), "three counts of at least 1 (z, y, x)")
        if math.prod(int(n) for n in self.shape) > MOST_VOXELS:
            raise InputError("grid shape", str(self.shape), f"at most {MOST_VOXELS:.3g} voxels")
        if (checks.numbers("grid voxel_size", self.voxel_size_mm, (3,)) <= 0).any():
            raise InputError("grid voxel_size", str(self.voxel_size_mm), "three positive lengths in mm (z, y, x)")
        checks.numbers("grid offset", self.offset_mm, (3,))
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        object.__setattr__(self, "voxel_size_mm", tuple(float(d) for d in self.voxel_size_mm))
        object.__setattr__(self, "offset_mm", tuple(float(d) for d in self.offset_mm))

    @classmethod
    def cube(cls, count: int, side_mm: float) -> "Grid":
        """Returns a cube of ``count``³ voxels and side ``side_mm`` about the origin. Raises InputError unless both are
        positive."""
        checks.whole("count", count, 1, MOST_VOXELS)
        checks.positive("side_mm", side_mm)
        return cls((count,) * 3, (side_mm / count,) * 3)

    @property
    def size_mm(self) -> tuple[float, float, float]:
        """The sides (z, y, x) of the whole box in mm."""
        return triple(n * d for n, d in zip(self.shape, self.voxel_size_mm, strict=True))

    @property
    def box_mm(self) -> np.ndarray:
        """Where the box begins and ends along z, y and x: (3, 2) float64 in mm."""
        half_mm, centre_mm = np.array(self.size_mm) / 2, np.array(self.offset_mm)
        return np.stack([centre_mm - half_mm, centre_mm + half_mm], -1)

    @property
    def half_longest_mm(self) -> float:
        """Half the longest side of the box in mm: the unit of length of splatting and neural methods."""
        return max(self.size_mm) / 2

    @property
    def first_centre_mm(self) -> tuple[float, float, float]:
        """The centre (z, y, x) of voxel (0, 0, 0) in mm."""
        sides = zip(self.shape, self.voxel_size_mm, self.offset_mm, strict=True)
        return triple(offset - (n - 1) / 2 * d for n, d, offset in sides)

    def axes_mm(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the coordinates of voxel centres in mm, z (nz,), y (ny,), x (nx,), float64."""
        sides = zip(self.first_centre_mm, self.shape, self.voxel_size_mm, strict=True)
        return triple(first + np.arange(n) * d for first, n, d in sides)

    def data_array(self, values: np.ndarray, unit: str, times_s: np.ndarray | None = None) -> "DataArray":
        """Returns values (nz, ny, nx), or (K, nz, ny, nx) at ``times_s`` (K,), as xarray's DataArray with coordinates in mm
        and s. ``unit``: the unit of the values. Raises InputError where xarray is not installed."""
        xarray = checks.package("xarray", "the package of labelled arrays", "xarray")
        axes = {name: (name, axis, {"units": "mm"}) for name, axis in zip("zyx", self.axes_mm(), strict=True)}
        if times_s is not None:
            axes = {"time": ("time", times_s, {"units": "s"}), **axes}
        facts = {"units": unit, "long_name": "CT number" if unit == "HU" else "attenuation"}
        return xarray.DataArray(values, axes, list(axes), facts["long_name"], facts)

    def is_close(self, other: "Grid") -> bool:
        """Returns whether two grids are equal, apart from the rounding of numbers stored in files."""
        near_mm = 1e-5 * max(self.size_mm)
        same_voxels = np.allclose(self.voxel_size_mm, other.voxel_size_mm, rtol=1e-5)
        return self.shape == other.shape and same_voxels and np.allclose(self.offset_mm, other.offset_mm, atol=near_mm)

    def part(self, start: tuple[int, int, int], shape: tuple[int, int, int]) -> "Grid":
        """Returns the grid of this grid's voxels [start, start + shape) (z, y, x). They may lie beyond this grid."""
        sides = zip(self.first_centre_mm, start, shape, self.voxel_size_mm, strict=True)
        return Grid(shape, self.voxel_size_mm, triple(first + (s + (n - 1) / 2) * d for first, s, n, d in sides))

    def slices_in(self, whole: "Grid") -> tuple[slice, slice, slice] | None:
        """Returns the slices (z, y, x) of ``whole`` that this grid occupies, or None if it is no part of ``whole``."""
        if not np.allclose(self.voxel_size_mm, whole.voxel_size_mm, rtol=1e-5):
            return None
        exact = np.subtract(self.first_centre_mm, whole.first_centre_mm) / whole.voxel_size_mm
        start = np.round(exact)
        if np.abs(exact - start).max() > _SAME_PLACE or (start < 0).any() or (start + self.shape > whole.shape).any():
            return None
        return triple(slice(int(s), int(s) + n) for s, n in zip(start, self.shape, strict=True))

    def in_shape(self, shape: tuple[int, int, int]) -> "Grid":
        """Returns the same box divided into ``shape`` (z, y, x) voxels."""
        checks.numbers("shape", shape, (3,))
        return Grid(shape, triple(side / n for side, n in zip(self.size_mm, shape, strict=True)), self.offset_mm)

    def finer(self, parts: int) -> "Grid":
        """Returns the same box with every voxel divided into ``parts`` along each axis."""
        checks.whole("parts", parts, 1, 1000)
        return Grid(triple(parts * n for n in self.shape), triple(d / parts for d in self.voxel_size_mm), self.offset_mm)

    def scaled(self, factor: float) -> "Grid":
        """Returns the grid with every length multiplied by ``factor``."""
        return Grid(self.shape, triple(d * factor for d in self.voxel_size_mm), triple(o * factor for o in self.offset_mm))


@dataclass(frozen=True, eq=False)
class Metal:
    """The metal in an object: attenuation (nz, ny, nx) float32 in 1/mm on ``grid``, 0 where there is none. Raises
    InputError for another shape."""

    values: np.ndarray
    grid: Grid

    def __post_init__(self) -> None:
        checks.shape("metal", checks.real_array("metal", self.values), self.grid.shape)
