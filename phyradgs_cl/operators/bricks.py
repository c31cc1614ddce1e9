"""Volumes cut into bricks that fit a device: rows of x stay whole, z is cut first, then y."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.runtime import Room

Shape = tuple[int, int, int]


@dataclass(frozen=True)
class Brick:
    """The voxels [start, start + shape) of a volume, both z, y, x."""

    start: Shape
    shape: Shape

    @property
    def box(self) -> tuple[slice, slice, slice]:
        """The brick as an index of the volume (z, y, x)."""
        z, y, x = (slice(s, s + n) for s, n in zip(self.start, self.shape, strict=True))
        return z, y, x


def whole(shape: Shape) -> Brick:
    return Brick((0, 0, 0), shape)


def cut(
    shape: Shape,
    steps: tuple[int, int],
    needs: Callable[[Shape], tuple[int, ...]],
    room: Room,
    share: float = 1.0,
) -> list[Brick]:
    """Bricks as large as a share of the room allows, in the order z, y; all but the last of an axis are multiples of
    ``steps`` (z, y).

    ``needs``: bytes of every buffer that a brick of a shape (z, y, x) takes. Where the share is too little for the smallest
    brick, that one may take all of the room. Raises OutOfMemoryError where it does not fit even so.
    """
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
    """Shapes of bricks from the whole down to one of ``steps``."""
    nz, ny, nx = shape
    for dz in _parts(nz, steps[0]):
        yield dz, ny, nx
    for dy in _parts(ny, steps[1]):
        yield min(steps[0], nz), dy, nx


def _parts(count: int, step: int) -> Iterator[int]:
    """Lengths of the parts when ``count`` is cut into 1, 2, 3 … parts that are multiples of ``step``."""
    last = count + 1
    for pieces in range(1, -(-count // step) + 1):
        fair = -(-count // pieces)
        length = count if pieces == 1 else -(-fair // step) * step
        if length < last:
            last = length
            yield length


def _mib(nbytes: int) -> str:
    return f"{nbytes / 2**20:.3g} MiB"
