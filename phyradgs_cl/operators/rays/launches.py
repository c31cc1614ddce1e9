"""Launches of the ray-driven projector (Joseph) and its matched adjoint: cells of many frames at a time."""

import math
from collections.abc import Iterator

import numpy as np

from phyradgs_cl.operators.rays.layout import RayCells, RayLayout
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD

# voxels (x, y, z) of one owner where work-items are bricks; kept in local memory, with a border of 1 around
_BRICK = (32, 32, 8)
_SMALL_BRICK = (24, 24, 8)  # 27 kB of the 32 that OpenCL promises
_BLOCK = 4  # voxels per side of what a work-group takes where work-items are voxels; as in cl/rays.cl
_SAMPLES_PER_VOXEL = 4  # of a view that the adjoint takes, about
_LONG_FROM = 2**31  # floats: where 32-bit indices end
_MOST_SAMPLES = 2**29  # of a GPU's launch: a tenth of a second on a slow one, whose screen's driver ends long ones
AVERAGES = ("log", "intensity", "correction")  # correction: log minus intensity; in the order of cl/rays.cl


def launch_forward(
    rt: Runtime,
    layout: RayLayout,
    cells: RayCells,
    frame_list: DeviceArray,
    volume: DeviceArray,
    frames: DeviceArray,
    *,
    average: str = "log",
    add: bool = False,
) -> None:
    """The listed frames of a padded volume, into ``frames``; ``average``, one of AVERAGES, is over a line's cells.

    ``add`` lays them onto what is there: line integrals of several bricks, for ``log`` alone.
    """
    blocks = -(-layout.width // rt.lanes)
    kernel = rt.kernel("rays", "rays_forward", **_defines(rt, layout, average))
    for first, stop in _parts(rt, frame_list.size, layout.lines * layout.width * max(layout.brick.shape)):
        rt.launch(
            kernel,
            (blocks, layout.lines, stop - first),
            volume,
            cells.cells,
            cells.cell_lines,
            cells.line_cells,
            frame_list,
            cells.weights,
            cells.weight_at,
            *layout.constants(),
            np.int32(first),
            np.int32(add),
            frames,
            group=rt.group(on_cpu=min(blocks, 8)),
        )


def launch_adjoint(
    rt: Runtime,
    layout: RayLayout,
    cells: RayCells,
    frame_list: DeviceArray,
    frames: DeviceArray,
    volume: DeviceArray,
    *,
    add: bool = False,
) -> None:
    """Sums the listed frames onto a padded volume."""
    nz, ny, nx = layout.brick.shape
    bx, by, bz = (_BLOCK,) * 3 if rt.pixel_items else brick_of(rt)
    owners = (-(-nx // bx), -(-ny // by), -(-nz // bz))
    group = rt.group(on_cpu=1, on_gpu=_BLOCK**3)
    kernel = rt.kernel("rays", "rays_adjoint", **_defines(rt, layout, "log"))
    for first, stop in _parts(rt, frame_list.size, _SAMPLES_PER_VOXEL * nz * ny * nx):
        rt.launch(
            kernel,
            (owners[0] * group, *owners[1:]),
            frames,
            cells.cells,
            cells.cell_lines,
            cells.matrices,
            np.int32(cells.matrix_stride),
            cells.frame_cells,
            frame_list,
            cells.weights,
            cells.weight_at,
            np.int32(first),
            np.int32(stop),
            *layout.constants(),
            np.int32(add or first > 0),  # onto what the launch before has left: the same sums, bit for bit
            volume,
            group=group,
        )


def _parts(rt: Runtime, frames: int, samples_per_frame: int) -> Iterator[tuple[int, int]]:
    """First frame and the one after the last of each launch: all in one on a CPU, few enough on a GPU."""
    step = max(_MOST_SAMPLES // samples_per_frame, 1) if rt.pixel_items else frames
    for first in range(0, frames, step):
        yield first, min(first + step, frames)


def brick_of(rt: Runtime) -> tuple[int, int, int]:
    """Voxels (x, y, z) that a work-item of the adjoint owns: larger bricks share fewer rays, 14 % faster."""
    tile_bytes = 4 * math.prod(n + 2 for n in _BRICK)
    return _BRICK if rt.device.handle.local_mem_size >= tile_bytes else _SMALL_BRICK


def owner_steps(rt: Runtime) -> tuple[int, int]:
    """Voxels (z, y) of which the adjoint's owners are made: bricks that are multiples have the bits of the whole."""
    x, y, z = brick_of(rt)
    return (_BLOCK, _BLOCK) if rt.pixel_items else (z, y)


def _defines(rt: Runtime, layout: RayLayout, average: str) -> dict[str, int]:
    x, y, z = brick_of(rt)
    return {
        "AVERAGE": AVERAGES.index(average),
        "IMAGE_GUARD": GUARD,
        "BRICK_X": x,
        "BRICK_Y": y,
        "BRICK_Z": z,
        "RAY_VOXEL_ITEMS": int(rt.pixel_items),
        "RAY_LONG": int(layout.volume_floats >= _LONG_FROM),
    }
