"""Time cells of a few frames, and noise, for the tests of ray-driven operators."""

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import common_time_cells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells

SHAPE = (13, 18)


def noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)


def tables(
    motion: str,
    shape: tuple[int, int] = SHAPE,
    axis: str = "rows",
    direction: int = 1,
    frames: int = 3,
    source_mm: float = 5.0,
) -> list[TimeCells]:
    """Frames around a turn of a detector with an offset that sees a volume of side 2; ``gapless``: exposed without a gap;
    ``overlapping``: a short exposure, and the first lines of a frame open before the last of the frame before are closed."""
    pixels_mm = (3.9 / shape[0], 4.1 / shape[1])
    geometry = ConeGeometry(source_mm, source_mm + 2.5, shape, pixels_mm, (0.1, 0.3))
    orbit = CircularOrbit(geometry, ConstantSpeed(0.4, 0.9))
    shutter = Shutter(0.1, 0.45, axis, direction) if motion == "overlapping" else Shutter(0.5, 0.4, axis, direction)
    made = []
    start_s = 0.1 + (0.5 if motion in ("gapless", "overlapping") else 2.1) * np.arange(frames)
    for frame in range(frames):
        where = (orbit, shutter, frame, float(start_s[frame]), shutter.lines(shape))
        if motion == "static":
            made.append(static_cells(*where))
        elif motion == "micro-views":
            made.append(micro_view_cells(*where, 5, 2))
        elif motion in ("common", "gapless", "overlapping"):
            times = 2 if motion == "overlapping" else 3
            made.append(common_time_cells(orbit, shutter, frame, start_s, shutter.lines(shape), times))
        else:
            made.append(per_line_cells(*where, 1 if motion == "per line at one time" else 3))
    return made
