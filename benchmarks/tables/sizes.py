"""Sizes of a benchmark: voxels and pixels along a side, and iterations of the splatting methods."""

from dataclasses import dataclass

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError


@dataclass(frozen=True)
class BenchSize:
    """A cube of ``voxels``³ seen by ``pixels``² pixels. Splatting methods take ``iterations`` iterations."""

    name: str
    voxels: int
    pixels: int
    iterations: int

    def __post_init__(self) -> None:
        checks.within("--iterations", self.iterations, 0, 10_000_000)


SIZES = {
    size.name: size
    for size in (
        BenchSize("XS", 32, 64, 600),
        BenchSize("S", 64, 128, 3_000),
        BenchSize("M", 128, 256, 3_000),
        BenchSize("L", 256, 512, 20_000),
        BenchSize("XL", 512, 2048, 20_000),
    )
}


def bench_size(name: str) -> BenchSize:
    """Returns a size by its name. InputError lists the known ones."""
    if name not in SIZES:
        known = ", ".join(f"{s.name} ({s.voxels}³ from {s.pixels}²)" for s in SIZES.values())
        raise InputError("--size", repr(name), f"one of {known}")
    return SIZES[name]
