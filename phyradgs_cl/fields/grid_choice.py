"""Options by which a user chooses another grid for a volume than the scan's."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.checks import option
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.volume import MOST_VOXELS, Grid, triple

_SIZE = "Voxels of the volume; a single number: along its longest side. The box stays."
_VOXEL = "Sides of a voxel, mm; the box stays."
_ROI = "Box of the volume about the axis, mm, or its sides about the scan's middle; the voxels stay."
_MARGIN = "Width around the box, mm, that is reconstructed and discarded: for objects larger than box or panel."
_SCAN = "the scan's"
_LARGEST_MM = 1e9  # largest length in mm that an option takes; the smallest is 1e-9 mm
_ROUNDING = 1e-6  # a box may exceed whole voxels by this fraction of a voxel, as rounding, without getting a further voxel
# The same fraction for a box that a user typed: it rarely ends at voxels' faces, since voxel sides are rarely round numbers.
_TYPED = 0.01


@dataclass(frozen=True)
class GridChoice:
    """How a volume's grid differs from the scan's. None keeps the scan's value, or takes the value that the others imply.

    - size: voxels (z, y, x), or one count along the longest side, with the others in proportion.
    - voxel_mm: sides of a voxel (z, y, x), or one length.
    - roi_mm: the box (z0, z1, y0, y1, x0, x1) in the world frame. Three sides (z, y, x), or the side of a cube, are a box
      about the middle of the scan's grid.
    - margin_mm: widths (z, y, x) around this box, or one width, that methods reconstruct too and then discard.

    Raises InputError for other values, a box that ends before it begins, and all of size, voxel_mm and roi_mm."""

    size: int | tuple[int, ...] | None = option(None, _SIZE, _SCAN, metavar="N|Z,Y,X")
    voxel_mm: float | tuple[float, ...] | None = option(None, _VOXEL, _SCAN, metavar="D|Z,Y,X")
    roi_mm: tuple[float, ...] | None = option(None, _ROI, _SCAN, metavar="D|Z,Y,X|Z0,Z1,Y0,Y1,X0,X1", flag="--roi")
    margin_mm: float | tuple[float, ...] | None = option(None, _MARGIN, "0", metavar="D|Z,Y,X", of_method=True)

    def __post_init__(self) -> None:
        if self.size is not None:
            counts = _numbers("--size", self.size, (1, 3), "64 or 48,64,64")
            if any(n != int(n) or not 1 <= n <= MOST_VOXELS for n in counts):
                raise InputError("--size", checks.short_repr(self.size), "whole numbers of voxels, at least 1")
            object.__setattr__(self, "size", triple(map(int, counts)) if len(counts) == 3 else int(counts[0]))
        if self.voxel_mm is not None:
            object.__setattr__(self, "voxel_mm", voxel_sides_mm("--voxel-mm", self.voxel_mm))
        if self.roi_mm is not None:
            ends_mm = _numbers("--roi-mm", self.roi_mm, (1, 3, 6), "40 (a cube) or -10,10,-20,20,-20,20 (Z0,Z1,Y0,Y1,X0,X1)")
            ends_mm = ends_mm * 3 if len(ends_mm) == 1 else ends_mm
            for end_mm in ends_mm:
                checks.within("--roi-mm", end_mm, -_LARGEST_MM if len(ends_mm) == 6 else 1 / _LARGEST_MM, _LARGEST_MM)
            if len(ends_mm) == 6 and any(b - a < 1 / _LARGEST_MM for a, b in zip(ends_mm[::2], ends_mm[1::2], strict=True)):
                raise InputError("--roi-mm", checks.short_repr(self.roi_mm), "Z0 below Z1, Y0 below Y1, X0 below X1")
            object.__setattr__(self, "roi_mm", ends_mm)
        if self.margin_mm is not None:
            widths_mm = _numbers("--margin-mm", self.margin_mm, (1, 3), "20 or 0,20,20")
            for width_mm in widths_mm:
                checks.within("--margin-mm", width_mm, 0, _LARGEST_MM)
            around_mm = widths_mm if len(widths_mm) == 3 else widths_mm * 3
            object.__setattr__(self, "margin_mm", around_mm if any(around_mm) else None)
        if self.size is not None and self.voxel_mm is not None and self.roi_mm is not None:
            expected = "at most two of --size, --voxel-mm and --roi-mm, which say the third"
            raise InputError("--size", "all three", expected, "leave one out")

    def of(self, grid: Grid) -> Grid:
        """Returns the chosen grid in place of ``grid``, or ``grid`` itself if nothing is chosen.

        With ``roi_mm`` alone, the chosen grid has the voxels of ``grid``, continued outside it, that overlap the box by more
        than a hundredth of a voxel. ``size`` alone keeps the box of ``grid``. ``voxel_mm`` alone keeps that box too, with
        its sides rounded up to whole voxels. Raises InputError for too many voxels, and for voxels so large that there is
        only one."""
        box_mm = self._box_mm(grid)
        sides_mm = box_mm[:, 1] - box_mm[:, 0]
        if self.size is not None:
            shape = self._counts(sides_mm / grid.voxel_size_mm)
        elif self.voxel_mm is not None:
            shape = np.maximum(np.ceil(sides_mm / self.voxel_mm - _ROUNDING), 1)
            if shape.max() == 1 < max(grid.shape):
                box = " × ".join(f"{side:.4g}" for side in sides_mm)
                expected = f"several voxels in the box of {box} mm (z, y, x)"
                raise InputError("--voxel-mm", checks.short_repr(self.voxel_mm), expected)
        elif self.roi_mm is not None:
            return self._cut(grid, box_mm)
        else:
            return grid
        voxel_mm = sides_mm / shape if self.voxel_mm is None else self.voxel_mm
        return Grid(self._whole(shape), triple(np.broadcast_to(voxel_mm, 3)), triple(box_mm.mean(1)))

    def with_margin(self, grid: Grid) -> Grid:
        """Returns ``grid`` with ``margin_mm`` on all sides, in whole voxels. Raises InputError for too many voxels."""
        if self.margin_mm is None:
            return grid
        around = np.ceil(np.divide(self.margin_mm, grid.voxel_size_mm) - _TYPED)
        return grid.part(triple(int(-n) for n in around), self._whole(grid.shape + 2 * around, "--margin-mm"))

    def _box_mm(self, grid: Grid) -> np.ndarray:
        if self.roi_mm is None:
            return grid.box_mm
        if len(self.roi_mm) == 6:
            return np.reshape(self.roi_mm, (3, 2))
        return np.array(grid.offset_mm)[:, None] + np.outer(self.roi_mm, (-0.5, 0.5))

    def _counts(self, proportion: np.ndarray) -> np.ndarray:
        if isinstance(self.size, tuple):
            return np.array(self.size, np.float64)
        return np.maximum(np.round(float(self.size or 1) * proportion / proportion.max()), 1)

    def _cut(self, grid: Grid, box_mm: np.ndarray) -> Grid:
        """Returns the grid of those voxels of ``grid``, continued outside it, that overlap a box (3, 2) in mm by more than a
        hundredth of a voxel."""
        low, high = (box_mm.T - grid.box_mm[:, 0]) / grid.voxel_size_mm
        start = np.floor(low + _TYPED)
        shape = self._whole(np.maximum(np.ceil(high - _TYPED) - start, 1))
        return grid.part(triple(int(n) for n in start), shape)

    def _whole(self, shape: np.ndarray, subject: str = "") -> tuple[int, int, int]:
        if np.prod(shape) > MOST_VOXELS:
            implied = "--voxel-mm" if self.voxel_mm is not None else "--size" if self.size is not None else "--roi-mm"
            subject = subject or implied
            found = " × ".join(f"{n:.6g}" for n in shape)
            raise InputError(subject, f"a grid of {found}", f"at most {MOST_VOXELS:.3g} voxels")
        return triple(int(n) for n in shape)


def voxel_sides_mm(option: str, value: Any) -> tuple[float, float, float]:
    """Returns voxel sides (z, y, x) in mm from one length or three. Raises InputError about ``option`` for other values."""
    sides_mm = _numbers(option, value, (1, 3), "0.5 or 1,0.5,0.5")
    for side_mm in sides_mm:
        checks.within(option, side_mm, 1 / _LARGEST_MM, _LARGEST_MM)
    return triple(sides_mm if len(sides_mm) == 3 else sides_mm * 3)


def _numbers(option: str, value: Any, counts: tuple[int, ...], example: str) -> tuple[float, ...]:
    """Returns a number or a sequence as floats. counts: allowed lengths. Raises InputError about ``option`` otherwise."""
    value = value.ravel().tolist() if isinstance(value, np.ndarray) else value  # an array may be (3, 2), as Grid.box_mm is
    parts = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    parts = [part.item() if isinstance(part, np.generic) else part for part in parts]
    fits = len(parts) in counts and all(isinstance(n, int | float) and not isinstance(n, bool) for n in parts)
    if not (fits and all(abs(n) < 1e300 for n in parts)):  # a comparison with NaN is false, so NaN is refused too
        many = " or ".join(str(count) for count in counts)
        expected = f"{many} finite numbers" if counts != (1, 3) else "a finite number, or three (z, y, x)"
        raise InputError(option, checks.short_repr(value), expected, f"write for example {example}")
    return tuple(float(n) for n in parts)
