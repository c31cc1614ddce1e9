"""Cuts a volume that does not fit on a device into boxes ("bricks") that do: first along z, then along y, never along x."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.runtime import Room

Shape = tuple[int, int, int]


@dataclass(frozen=True)
class Brick:
    """A box of voxels of a volume: [start, start + shape), each (z, y, x)."""

    start: Shape
    shape: Shape

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """The slices (z, y, x) by which an array of the whole volume is indexed."""
        z, y, x = (slice(s, s + n) for s, n in zip(self.start, self.shape, strict=True))
        return z, y, x


def whole(shape: Shape) -> Brick:
    return Brick((0, 0, 0), shape)


def cut(
    shape: Shape, steps: tuple[int, int], needs: Callable[[Shape], tuple[int, ...]], room: Room,
    share: float = 1.0,
) -> list[Brick]:
    """Cuts a volume of ``shape`` into bricks, as large as ``share`` (0 to 1) of the free memory in ``room`` allows.

    The sides of bricks are multiples of ``steps`` (z, y) in voxels, except at the volume's end. needs: returns the bytes of
    each buffer that a brick of shape (z, y, x) takes. A brick of the smallest size may take all of the free memory. Raises
    OutOfMemoryError if not even such a brick fits."""
    nz, ny, nx = shape
    smallest = (min(steps[0], nz), min(steps[1], ny), nx)
    if not room.holds(*needs(smallest)):
        least = needs(smallest)
        found = f"{_mib(sum(least))} for the smallest part of {nz}×{ny}×{nx} voxels, {_mib(max(least))} in one buffer"
        expected = f"at most {_mib(room.free_bytes)}, {_mib(room.largest_bytes)} in one buffer"
        remedy = "allow more with --memory, or use a smaller problem"
        raise OutOfMemoryError("device memory", found, expected, remedy)
    target = room.scaled(share)
    dz, dy, _ = next((s for s in _candidates(shape, steps) if target.holds(*needs(s))), smallest)
    starts = [(z, y) for z in range(0, nz, dz) for y in range(0, ny, dy)]
    return [Brick((z, y, 0), (min(dz, nz - z), min(dy, ny - y), nx)) for z, y in starts]


def _candidates(shape: Shape, steps: tuple[int, int]) -> Iterator[Shape]:
    """Yields possible shapes (z, y, x) of bricks, from the whole volume down to one of ``steps`` (z, y)."""
    nz, ny, nx = shape
    for dz in _parts(nz, steps[0]):
        yield dz, ny, nx
    for dy in _parts(ny, steps[1]):
        yield min(steps[0], nz), dy, nx


def _parts(count: int, step: int) -> Iterator[int]:
    """Yields lengths of bricks along an axis of ``count`` voxels, longest first: ``count``, then multiples of ``step``."""
    last = count + 1
    for pieces in range(1, ceil_div(count, step) + 1):
        fair = ceil_div(count, pieces)
        length = count if pieces == 1 else ceil_div(fair, step) * step
        if length < last:
            last = length
            yield length


def _mib(nbytes: int) -> str:
    return f"{nbytes / 2**20:.3g} MiB"
