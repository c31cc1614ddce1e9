"""A volume and its truth on one grid: the rule by which every PSNR compares them."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.metrics.resample import resampled, shared_slices

Values = NDArray[np.floating]
VOXEL_BY_VOXEL = "voxel by voxel"


@dataclass(frozen=True, eq=False)
class Aligned:
    """A volume and a reference (nz, ny, nx), both on ``grid``. ``how``: in words, what was done to compare them; ``share``
    of the reference's box that is compared."""

    volume: Values
    reference: Values
    grid: Grid
    how: str = VOXEL_BY_VOXEL
    share: float = 1.0


def aligned(volume: Values, grid: Grid, reference: Values, reference_grid: Grid) -> Aligned | None:
    """Both volumes (nz, ny, nx) on one grid; None where no voxel centre of the reference lies in the volume's box.

    The volume's own grid, where its voxels are the reference's, or whole blocks of them: the reference is then averaged over
    the blocks. Any other volume is resampled, trilinearly, onto those of the reference's voxels that lie in its box.
    """
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


def reference_on(grid: Grid, reference: Values, reference_grid: Grid) -> Values | None:
    """The reference (nz, ny, nx) on a volume's ``grid``, by the rule of ``aligned``; None where the volume is resampled."""
    if grid.is_close(reference_grid):
        return reference
    blocks = _blocks(grid, reference_grid)
    return None if blocks is None else block_means(reference[blocks[1]], blocks[0])


def block_means(values: Values, factors: tuple[int, int, int]) -> Values:
    """Means over blocks of ``factors`` (z, y, x) voxels of a volume that whole blocks fill."""
    if factors == (1, 1, 1):
        return values
    split = [part for n, factor in zip(values.shape, factors, strict=True) for part in (n // factor, factor)]
    means: Values = values.reshape(split).mean((1, 3, 5), dtype=np.float64).astype(np.float32)
    return means


def in_words(grid: Grid) -> str:
    """A grid in a few words, x y z as everywhere where people read of sizes."""
    sizes, offsets = (v[::-1] for v in (grid.voxel_size_mm, grid.offset_mm))
    digits = 3 - math.floor(math.log10(min(sizes)))  # a thousandth of a voxel is no offset
    words = f"{_times(grid.shape)} voxels (x y z) of {'×'.join(f'{s:.4g}' for s in sizes)} mm"
    return f"{words} about ({', '.join(f'{round(o, digits) + 0.0:g}' for o in offsets)}) mm"


def _blocks(grid: Grid, finer: Grid) -> tuple[tuple[int, int, int], tuple[slice, slice, slice]] | None:
    """How many voxels of ``finer`` fill one of ``grid`` (z, y, x), and which fill all; None where whole voxels do not."""
    factors = triple(max(1, round(d / f)) for d, f in zip(grid.voxel_size_mm, finer.voxel_size_mm, strict=True))
    counts = triple(n * factor for n, factor in zip(grid.shape, factors, strict=True))
    if any(n > most for n, most in zip(counts, finer.shape, strict=True)):
        return None
    sides_mm = triple(d / factor for d, factor in zip(grid.voxel_size_mm, factors, strict=True))
    part = Grid(counts, sides_mm, grid.offset_mm).slices_in(finer)
    return None if part is None else (factors, part)


def _times(zyx: tuple[int, int, int]) -> str:
    return "×".join(map(str, zyx[::-1]))


def _of(share: float) -> str:
    return "" if share == 1 else f", on {100 * share:.3g} % of the reference"
