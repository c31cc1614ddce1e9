"""Time cells of a few frames, and noise, for the tests of ray-driven operators."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.cells import common_time_cells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.time_cells import TimeCells

SHAPE = (13, 18)


def noise(shape: tuple[int, ...], seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float32)


def tables(
    motion: str,
    shape: tuple[int, int] = SHAPE,
    axis: str = "rows",
    direction: int = 1,
    frames: int = 3,
    source_mm: float = 5.0,
    beam: str = "cone",
) -> list[TimeCells]:
    """Frames around a turn of a detector with an offset that sees a volume of side 2; ``gapless``: exposed without a gap;
    ``overlapping``: a short exposure, and the first lines of a frame open before the last of the frame before are closed."""
    pixels_mm = (3.9 / shape[0], 4.1 / shape[1])
    geometry: Geometry = ConeGeometry(source_mm, source_mm + 2.5, shape, pixels_mm, (0.1, 0.3))
    if beam == "parallel":
        geometry = ParallelGeometry(shape, (pixels_mm[0] / 1.5, pixels_mm[1] / 1.5), (0.1, 0.2))
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


def leaning(cells: list[TimeCells], roll_deg: float, tilt_deg: float) -> list[TimeCells]:
    """The same frames on a panel turned about its middle: in its plane, and about its rows."""
    made = []
    for table in cells:
        pose = table.pose.copy()
        eu, ev = pose[:, 6:9], pose[:, 9:12]
        lines = (table.lines - 1) / 2
        middle = pose[:, 3:6] + lines * ev + 3 * eu
        du, dv = np.linalg.norm(eu, axis=1, keepdims=True), np.linalg.norm(ev, axis=1, keepdims=True)
        u_hat, v_hat, normal = eu / du, ev / dv, np.cross(eu / du, ev / dv)
        roll, tilted = np.deg2rad(roll_deg), np.deg2rad(tilt_deg)
        v_hat = np.cos(tilted) * v_hat + np.sin(tilted) * normal
        pose[:, 6:9] = du * (np.cos(roll) * u_hat + np.sin(roll) * v_hat)
        pose[:, 9:12] = dv * (np.cos(roll) * v_hat - np.sin(roll) * u_hat)
        pose[:, 3:6] = middle - lines * pose[:, 9:12] - 3 * pose[:, 6:9]
        made.append(replace(table, pose=pose))
    return made
