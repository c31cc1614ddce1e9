"""Launches the general ray-driven projector (Joseph's method) and its exact transpose, for many frames at a time.

Kernels: ``cl/rays.cl``, ``rays_adjoint_gpu.cl``, ``rays_adjoint_cpu.cl``."""

import math
from collections.abc import Iterator

from phyradgs_cl.checks import ceil_div, few_sizes
from phyradgs_cl.operators.rays.layout import RayCells, RayLayout
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime
from phyradgs_cl.runtime.layout import GUARD

# On a CPU, each work-item of the adjoint sums for its own box of voxels (x, y, z), which it keeps in local memory.
_BRICK = (32, 32, 8)
_SMALL_BRICK = (24, 24, 8)  # takes 27 kB, for devices with only the 32 kB of local memory that OpenCL guarantees
_BLOCK = 4  # on a GPU, the adjoint's work-groups compute cubes of this side in voxels, less along z if groups are small
_SAMPLES_PER_VOXEL = 4  # estimated number of ray samples from one pose that touch a voxel
_LONG_FROM = 2**31  # a volume with this many floats needs indices of 64 bits


def launch_forward(
    rt: Runtime, layout: RayLayout, cells: RayCells, frame_list: DeviceArray, volume: DeviceArray,
    frames: DeviceArray, *, add: bool = False,
) -> None:
    """Projects a padded volume, or a part of one (brick), to the padded frames numbered ``frame_list``. add: adds to these
    frames, as needed for all bricks after the first; else overwrites them."""
    blocks = ceil_div(layout.width, rt.lanes)
    kernel = rt.kernel("rays", "rays_forward", **_defines(layout, cells))
    items = blocks, layout.lines, frame_list.size
    rt.launch(
        kernel, items, volume, cells.cells, cells.cell_lines, cells.line_cells, frame_list, cells.weights,
        cells.weight_at, *layout.constants(), add, frames, group=rt.group(on_cpu=few_sizes(blocks, 8)),
        samples=math.prod(items) * max(layout.brick.shape) * cells.most_per_line,
    )  # fmt: skip


def launch_adjoint(
    rt: Runtime, layout: RayLayout, cells: RayCells, frame_list: DeviceArray, frames: DeviceArray,
    volume: DeviceArray, *, add: bool = False,
) -> None:
    """Backprojects the padded frames numbered ``frame_list`` to a padded volume. add: adds to the volume's values; else
    overwrites them."""
    owned, kernel = _owners(rt, layout, cells)
    nz, ny, nx = layout.brick.shape
    columns, rows, slices = (ceil_div(n, side) for n, side in zip((nx, ny, nz), owned, strict=True))
    group = rt.group(1, math.prod(owned))
    each = _SAMPLES_PER_VOXEL * nz * ny * nx * cells.most_per_line
    for first, stop in _parts(rt, frame_list.size, each):
        adds = add or first > 0  # later launches add to the sums of earlier ones, as one launch would
        rt.launch(
            kernel, (columns * group, rows, slices), frames, cells.cells, cells.cell_lines, cells.matrices,
            cells.matrix_stride, cells.frame_cells, frame_list, cells.weights, cells.weight_at, first, stop,
            *layout.constants(), adds, volume, group=group, samples=(stop - first) * each,
        )  # fmt: skip


def _owners(rt: Runtime, layout: RayLayout, cells: RayCells) -> tuple[tuple[int, int, int], Kernel]:
    """Returns the box of voxels (x, y, z) that each work-item or work-group of the adjoint computes, and the kernel."""
    owned, defines = (_BLOCK,) * 3 if rt.pixel_items else brick_of(rt), _defines(layout, cells)
    if not rt.pixel_items:
        defines |= dict(zip(("BRICK_X", "BRICK_Y", "BRICK_Z"), owned, strict=True))
        return owned, rt.kernel("rays_adjoint_cpu", "rays_adjoint", **defines)
    defines["UPRIGHT"] = cells.upright
    kernel = rt.kernel("rays_adjoint_gpu", "rays_adjoint", **defines)
    if (thin := rt.group(1, _BLOCK**3, kernel) // _BLOCK**2) == _BLOCK:
        return owned, kernel
    return (_BLOCK, _BLOCK, thin), rt.kernel("rays_adjoint_gpu", "rays_adjoint", BLOCK_Z=thin, **defines)


def _parts(rt: Runtime, frames: int, samples_per_frame: int) -> Iterator[tuple[int, int]]:
    """Divides the frames among launches, so that no launch takes too long on a GPU. Yields [first, stop) of each launch."""
    step = max(rt.most_samples // samples_per_frame, 1) if rt.pixel_items else frames
    for first in range(0, frames, step):
        yield first, min(first + step, frames)


def brick_of(rt: Runtime) -> tuple[int, int, int]:
    """Returns the box of voxels (x, y, z) that a CPU's work-item of the adjoint computes. The larger of two boxes is 14 %
    faster, and is taken if local memory can hold it."""
    tile_bytes = 4 * math.prod(n + 2 for n in _BRICK)
    return _BRICK if rt.device.handle.local_mem_size >= tile_bytes else _SMALL_BRICK


def owner_steps(rt: Runtime) -> tuple[int, int]:
    """Returns the sides (z, y) of the box of voxels that one work-item or work-group of the adjoint computes. A volume cut
    into multiples of these sides gets the same bits as the whole volume."""
    x, y, z = brick_of(rt)
    return (_BLOCK, _BLOCK) if rt.pixel_items else (z, y)


def _defines(layout: RayLayout, cells: RayCells) -> dict[str, int]:
    is_long = layout.volume_floats >= _LONG_FROM
    how = {"RAY_PARALLEL": int(cells.is_parallel), "ACROSS": int(cells.is_across)}
    return {"IMAGE_GUARD": GUARD, "RAY_LONG": int(is_long), **how}
