"""Brings a volume and its reference, the true volume, onto one grid, by the same rule for every PSNR."""

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid, triple

Values = NDArray[np.floating]
VOXEL_BY_VOXEL = "voxel by voxel"
_ROUNDING = 1e-6  # a rounded voxel centre that lies at most this far outside a box, in voxel sides, counts as inside


@dataclass(frozen=True, eq=False)
class Aligned:
    """A volume and a reference, both (nz, ny, nx) on ``grid``. how: the way in which they came onto one grid, in words.
    share: fraction of the reference's voxels that is compared."""

    volume: Values
    reference: Values
    grid: Grid
    how: str = VOXEL_BY_VOXEL
    share: float = 1.0


def aligned(volume: Values, grid: Grid, reference: Values, reference_grid: Grid) -> Aligned | None:
    """Returns both volumes (nz, ny, nx) on one grid; None where their boxes share no voxel centre.

    If whole blocks of the reference's voxels fill every voxel of the volume, the reference is averaged over these blocks.
    Otherwise the volume is resampled trilinearly at those voxels of the reference whose centres lie in the volume's box."""
    if grid.is_close(reference_grid):
        return Aligned(volume, reference, grid)
    if (blocks := _blocks(grid, reference_grid)) is not None:
        factors, part = blocks
        share = reference[part].size / reference.size
        means = f"with means of the reference over {_times(factors)} voxels (x y z)"
        how = VOXEL_BY_VOXEL if factors == (1, 1, 1) else means
        return Aligned(volume, block_means(reference[part], factors), grid, how + _of(share), share)
    shared = shared_slices(reference_grid, grid)
    if shared is None:
        return None
    part_of_reference = reference[shared]
    share = part_of_reference.size / reference.size
    onto = reference_grid.part(triple(one.start for one in shared), triple(part_of_reference.shape))
    how = f"volume resampled (linear) from {in_words(grid)} onto the reference's {in_words(reference_grid)}"
    return Aligned(resampled(volume, grid, onto)[0], part_of_reference, onto, how + _of(share), share)


def overlap(one: Grid, other: Grid) -> tuple[float, float]:
    """Returns (space that the two grids' boxes share)/(box of ``one``), and (the same space)/(box of ``other``)."""
    low, high = np.maximum(one.box_mm[:, 0], other.box_mm[:, 0]), np.minimum(one.box_mm[:, 1], other.box_mm[:, 1])
    shared_mm3 = float(np.prod(np.maximum(high - low, 0)))
    return shared_mm3 / math.prod(one.size_mm), shared_mm3 / math.prod(other.size_mm)


def reference_on(grid: Grid, reference: Values, reference_grid: Grid) -> Values | None:
    """Returns the reference (nz, ny, nx) on ``grid``, averaged over blocks if its voxels are smaller; None where ``aligned``
    would resample the volume, or has nothing to compare."""
    if grid.is_close(reference_grid):
        return reference
    blocks = _blocks(grid, reference_grid)
    return None if blocks is None else block_means(reference[blocks[1]], blocks[0])


def block_means(values: Values, factors: tuple[int, int, int]) -> Values:
    """Returns the means of a volume over blocks of ``factors`` (z, y, x) voxels. Whole blocks must fill the volume."""
    if factors == (1, 1, 1):
        return values
    split = [part for n, factor in zip(values.shape, factors, strict=True) for part in (n // factor, factor)]
    return values.reshape(split).mean((1, 3, 5), dtype=np.float64).astype(np.float32)


def in_words(grid: Grid) -> str:
    """Describes a grid in a few words for users: voxels, voxel sides and centre, in the order x y z."""
    sizes, offsets = (v[::-1] for v in (grid.voxel_size_mm, grid.offset_mm))
    digits = 3 - math.floor(math.log10(min(sizes)))  # an offset below a thousandth of a voxel is not shown
    words = f"{_times(grid.shape)} voxels (x y z) of {'×'.join(f'{s:.4g}' for s in sizes)} mm"
    return f"{words} about ({', '.join(f'{round(o, digits) + 0.0:g}' for o in offsets)}) mm"


def _blocks(grid: Grid, finer: Grid) -> tuple[tuple[int, int, int], tuple[slice, slice, slice]] | None:
    """Returns how many voxels (z, y, x) of ``finer`` fill one voxel of ``grid``, and the block of ``finer`` that fills
    ``grid``; None if a voxel of ``finer`` would be cut, or a voxel of ``grid`` lies outside ``finer``."""
    factors = triple(max(1, round(d / f)) for d, f in zip(grid.voxel_size_mm, finer.voxel_size_mm, strict=True))
    counts = triple(n * factor for n, factor in zip(grid.shape, factors, strict=True))
    if any(n > most for n, most in zip(counts, finer.shape, strict=True)):
        return None
    sides_mm = triple(d / factor for d, factor in zip(grid.voxel_size_mm, factors, strict=True))
    part = Grid(counts, sides_mm, grid.offset_mm).slices_in(finer)
    return None if part is None else (factors, part)


def shared_slices(onto: Grid, grid: Grid) -> tuple[slice, slice, slice] | None:
    """Returns the block (z, y, x) of ``onto``'s voxels whose centres lie in the box of ``grid``; None if there are none."""
    block = []
    for centres_mm, (low_mm, high_mm), side_mm in zip(onto.axes_mm(), grid.box_mm, onto.voxel_size_mm, strict=True):
        rounding_mm = _ROUNDING * side_mm
        inside = np.flatnonzero((centres_mm >= low_mm - rounding_mm) & (centres_mm <= high_mm + rounding_mm))
        if not inside.size:
            return None
        block.append(slice(int(inside[0]), int(inside[-1]) + 1))
    return triple(block)


def resampled(volume: NDArray[np.floating], grid: Grid, onto: Grid) -> tuple[NDArray[np.float32], float]:
    """Samples a volume (nz, ny, nx) on ``grid`` trilinearly at the voxel centres of ``onto``. Outside the box of ``grid``
    the result is 0.

    Between the outermost voxel centres and the box's faces the value is constant. Also returns the fraction of the voxels of
    ``onto`` whose centres lie in the box of ``grid``."""
    step = np.divide(onto.voxel_size_mm, grid.voxel_size_mm)
    first = np.subtract(onto.first_centre_mm, grid.first_centre_mm) / grid.voxel_size_mm
    values = scipy.ndimage.affine_transform(
        volume.astype(np.float32, copy=False), step, first, output_shape=onto.shape, order=1, mode="nearest"
    )
    share = 1.0
    for axis, (at, ratio) in enumerate(zip(first, step, strict=True)):
        place = at + ratio * np.arange(onto.shape[axis])
        inside = (place >= -0.5 - _ROUNDING) & (place <= grid.shape[axis] - 0.5 + _ROUNDING)
        share *= float(inside.mean())
        values *= inside.reshape([-1 if a == axis else 1 for a in range(3)])
    return values, share


def _times(zyx: tuple[int, int, int]) -> str:
    return "×".join(map(str, zyx[::-1]))


def _of(share: float) -> str:
    return "" if share == 1 else f", on {100 * share:.3g} % of the reference"
