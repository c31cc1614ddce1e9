"""A faster ray-driven projector for CPUs, for detector columns nearly along z and poses that serve many lines.

The rays to a detector column share most of their work. Each pose is projected once, into a buffer called slot, and frames
are weighted averages of slots (``slots.py``). The samples are those of ``general.py``. Kernels: ``cl/rays_upright.cl``,
``rays_upright_adjoint.cl``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.checks import ceil_div, few_sizes
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.layout import BORDER, RayLayout, ray_constants
from phyradgs_cl.operators.rays.slots import Slots, UprightPoses
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, pitch_of

_LINES = 128  # most pixels of a detector column that one work-item projects
# Least number of lines that a pose must serve on average: with fewer, slots cost more time than they save.
FEWEST_LINES = 8
_VOXELS = 512  # most voxels along z that the rays of a work-item may meet in one plane of voxels
# Boxes of voxels (x, y, z) that a work-item of the adjoint may sum: the largest is fastest, as its voxels share rays.
_OWNED = ((16, 16, 128), (8, 8, 128), (8, 4, 128))
_ITEMS_PER_UNIT = 4  # wanted work-items per compute unit: with fewer, some units would wait long for the last item
_UPRIGHT = 1e-6  # a column of pixels does not lean if x and y change by at most this many voxels over the detector
_MOST_LEAN = 0.25  # largest lean of a column, in voxels across per voxel along z: beyond, the general kernel is faster
# Detector columns in a work-group. All poses project them before the next group: near poses read the same voxels, which are
# still in the cache.
_GROUP = 16
_TURN = 16  # side of the tile (x and z) that a work-item transposes, in voxels; TURN in cl/rays_upright.cl


@dataclass(frozen=True)
class Upright:
    """How the upright kernels are built. block: number of pixels of a detector column per work-item. leans: detector columns
    are not exactly along z. is_parallel: rays are parallel."""

    block: int
    leans: bool
    is_parallel: bool


def upright_of(
    grid: Grid, tables: Sequence[TimeCells], detector_shape: tuple[int, int], lanes: int, fewest_lines: int | None = None
) -> Upright | None:
    """Returns how the upright kernels project the cells of ``tables``, or None if the general kernel is needed.

    The upright kernels need poses that serve several lines each, rays whose main axis is x or y, and detector columns
    nearly along z. If columns lean in a cone beam, the volume must lie between source and panel. fewest_lines: the number
    of lines that a pose must serve on average, by default ``lanes``, the width of a vector, and at least ``FEWEST_LINES``.
    If the panel is read column by column, that number is ``FEWEST_LINES``, or all lines of a panel with fewer."""
    served = sum(int((table.line_stop - table.line_start).sum()) for table in tables)
    lines = tables[0].lines
    fewest = fewest_lines or max(lanes, FEWEST_LINES)
    if tables[0].axis == "columns":
        fewest = min(FEWEST_LINES, lines)
    if served < fewest * sum(table.count for table in tables):
        return None
    rows, columns = detector_shape
    is_parallel = tables[0].is_parallel
    cells = ray_constants(np.concatenate([table.pose for table in tables]), grid, is_parallel).astype(np.float64)
    source, d00, eu, ev = cells[:, 0:3], cells[:, 3:6], cells[:, 6:9], cells[:, 9:12]
    leans = bool(np.abs(ev[:, :2]).max() * rows > _UPRIGHT or np.abs(eu[:, 2]).max() * columns > _UPRIGHT)
    across = np.linalg.norm(ev[:, :2], axis=1)
    if leans and (across > _MOST_LEAN * np.abs(ev[:, 2])).any():
        return None
    block = int(min(_LINES, rows, (_VOXELS - 4) // max(np.abs(ev[:, 2]).max(), 1e-3)))
    steep = (np.abs(source[:, 2]) == 1).any() if is_parallel else _is_steep(cells, rows, columns)
    if steep or block < lanes:
        return None
    if leans and not is_parallel and not _lies_between(grid, source, d00, eu, ev):
        return None
    return Upright(block, leans, is_parallel)


def _is_steep(cells: np.ndarray, rows: int, columns: int) -> bool:
    """Returns whether z may be the main axis of any ray of ``cells``, poses (C, 16) as in ``ray_constants``."""
    d00, eu, ev = cells[:, 3:6], cells[:, 6:9], cells[:, 9:12]
    across = np.linalg.norm(ev[:, :2], axis=1)
    ends_z = [np.abs(d00 + u * eu + v * ev)[:, 2] for u in (0, columns - 1) for v in (0, rows - 1)]
    nearest = _least_horizontal(d00[:, :2], eu[:, :2], columns) - across * rows
    return bool((np.max(ends_z, axis=0) > nearest / np.sqrt(2)).any())


def _least_horizontal(d00: np.ndarray, eu: np.ndarray, width: int) -> np.ndarray:
    """Returns the smallest horizontal length (C,) of rays d00 + u eu to columns u in [0, width − 1]; d00, eu: (C, 2)."""
    nearest = -np.sum(d00 * eu, 1) / np.maximum(np.sum(eu * eu, 1), 1e-30)
    return np.asarray(np.linalg.norm(d00 + np.clip(nearest, 0, width - 1)[:, None] * eu, axis=1))


def _lies_between(grid: Grid, source: np.ndarray, d00: np.ndarray, eu: np.ndarray, ev: np.ndarray) -> bool:
    """Returns whether the grid, with a voxel around it, lies between source and panel in every pose. The poses' source, d00,
    eu and ev are vectors (C, 3) in voxels, as in ``ray_constants``."""
    nz, ny, nx = grid.shape
    corners = np.array([(x, y, z) for x in (-1, nx) for y in (-1, ny) for z in (-1, nz)])
    normal = np.cross(eu, ev)
    depth = np.einsum("ckj,cj->ck", corners - source[:, None], normal) / np.sum(d00 * normal, 1)[:, None]
    return bool((depth > 0).all() and (depth < 1).all())


def columns_floats(grid: Grid) -> int:
    """Returns how many floats a padded volume takes that is transposed to (y, x, z)."""
    nz, ny, nx = grid.shape
    return 2 * GUARD + (ny + 2 * BORDER) * (nx + 2 * BORDER) * pitch_of(nz)


def launch_upright(
    rt: Runtime, layout: RayLayout, how: Upright, poses: UprightPoses, slots: Slots, columns: DeviceArray,
    target: tuple[DeviceArray, np.ndarray],
) -> None:
    """Projects a volume, transposed to ``columns`` (y, x, z), to slots. target: an array and its ``Slots.strides``. how: as
    ``upright_of`` returns it."""
    shape, origin, _, pitch_mm, *_ = layout.constants()
    array, strides = target
    rt.launch(
        rt.kernel("rays_upright", "rays_upright", **_defines(how)),
        (slots.count, slots.columns, ceil_div(slots.rows, how.block)), columns, poses.cells, slots.slots,
        shape, origin, pitch_of(layout.grid.shape[0]), pitch_mm, how.block, strides, array,
        group=(1, few_sizes(slots.columns, _GROUP)),
    )  # fmt: skip


def launch_upright_adjoint(
    rt: Runtime, layout: RayLayout, how: Upright, poses: UprightPoses, slots: Slots, values: DeviceArray,
    target: tuple[DeviceArray, Strides], *, add: bool = False,
) -> None:
    """Backprojects ``values``, the slots that ``split_slots`` wrote, to ``target``, a volume and its strides. add: adds
    to the volume, else overwrites it. how: as ``upright_of`` returns it."""
    shape, origin, *_ = layout.constants()
    (x, y, z), items = _owned(layout.brick.shape, rt.device.compute_units)
    rt.launch(
        rt.kernel("rays_upright_adjoint", "rays_upright_adjoint", ADJOINT_X=x, ADJOINT_Y=y, ADJOINT_Z=z, **slots.defines),
        items, values, slots.columns, slots.pitch, np.int64(slots.floats), poses.cells, slots.slots,
        slots.count, poses.matrices, poses.matrix_stride, shape, origin, target[1].vector(), add, target[0],
        group=1,
    )  # fmt: skip


def _owned(shape: tuple[int, int, int], units: int) -> tuple[tuple[int, int, int], tuple[int, ...]]:
    """Returns the box of voxels (x, y, z) that each work-item of the adjoint sums, and the number of work-items along x, y,
    z. Takes the first box of ``_OWNED`` that keeps all ``units`` compute units busy, or else the last."""
    for owned in _OWNED:
        items = tuple(ceil_div(n, own) for n, own in zip(shape[::-1], owned, strict=True))
        if math.prod(items) >= _ITEMS_PER_UNIT * units:
            break
    return owned, items


def turn_volume(
    rt: Runtime, layout: RayLayout, volume: tuple[DeviceArray, Strides], columns: DeviceArray
) -> None:
    """Transposes a volume (nz, ny, nx), given with its strides, to ``columns`` (y, x, z). The padding stays zero."""
    nz, ny, nx = layout.grid.shape
    shape, *_ = layout.constants()
    size = (ceil_div(nx, _TURN), ny, ceil_div(nz, _TURN))
    kernel = rt.kernel("rays_upright", "turn_upright", **_defines(Upright(_LINES, False, False)))
    rt.launch(kernel, size, volume[0], volume[1].vector(), shape, pitch_of(nz), columns, group=1)


def _defines(how: Upright) -> dict[str, int]:
    sizes = {"UPRIGHT_LINES": _LINES, "UPRIGHT_VOXELS": _VOXELS}
    return {"IMAGE_GUARD": GUARD, "RAY_LONG": 0, "LEAN": int(how.leans), "RAY_PARALLEL": int(how.is_parallel), **sizes}
