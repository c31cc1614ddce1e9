"""The ray-driven projector where detector columns are nearly parallel to the volume's z and a pose serves many lines.

The rays of a column share most of their work then. Each pose is projected once, into a slot for the part of the panel that
it serves; frames are weighted averages of slots (``slots.py``). Samples are those of ``launches``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.layout import BORDER, RayLayout, ray_constants
from phyradgs_cl.operators.rays.slots import Slots, UprightPoses
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, pitch_of

_LINES = 128  # of a detector column for a work-item
_FEWEST_LINES = 8  # to a pose: fewer do not pay for its slot
_VOXELS = 512  # of a column of the volume that they may meet in one slice
_OWNED = (8, 4, 128)  # voxels (x, y, z) of a work-item of the adjoint: neighbouring columns share what rays bring
_UPRIGHT = 1e-6  # voxels: how far a column, or a row, may lean over the whole detector
_MOST_LEAN = 0.25  # of a column's voxels across to those along z: further the general kernel is faster
_TURN = 16  # voxels along x and z that are turned at a time; as in cl/rays_upright.cl


@dataclass(frozen=True)
class Upright:
    """How the upright kernels take a scan: lines of a detector column per work-item, and whether columns lean."""

    block: int
    leans: bool


def upright_of(
    grid: Grid, tables: Sequence[TimeCells], detector_shape: tuple[int, int], lanes: int
) -> Upright | None:
    """How the upright kernels take these cells; None where rays need the general kernel.

    They need poses that serve several lines each, rays whose main axis is x or y, and columns nearly along z. Columns
    that lean need the volume to lie between source and panel.
    """
    served = sum(int((table.line_stop - table.line_start).sum()) for table in tables)
    lines = tables[0].lines
    fewest = max(lanes, _FEWEST_LINES) if tables[0].axis == "rows" else min(_FEWEST_LINES, lines)
    if served < fewest * sum(table.count for table in tables):
        return None
    rows, columns = detector_shape
    cells = ray_constants(np.concatenate([table.pose for table in tables]), grid).astype(np.float64)
    source, d00, eu, ev = cells[:, 0:3], cells[:, 3:6], cells[:, 6:9], cells[:, 9:12]
    leans = bool(np.abs(ev[:, :2]).max() * rows > _UPRIGHT or np.abs(eu[:, 2]).max() * columns > _UPRIGHT)
    across = np.linalg.norm(ev[:, :2], axis=1)
    ends_z = [np.abs(d00 + u * eu + v * ev)[:, 2] for u in (0, columns - 1) for v in (0, rows - 1)]
    nearest = _least_horizontal(d00[:, :2], eu[:, :2], columns) - across * rows
    if (np.max(ends_z, axis=0) > nearest / np.sqrt(2)).any():
        return None
    if leans and ((across > _MOST_LEAN * np.abs(ev[:, 2])).any() or not _lies_between(grid, source, d00, eu, ev)):
        return None
    block = int(min(_LINES, rows, (_VOXELS - 4) // max(np.abs(ev[:, 2]).max(), 1e-3)))
    return Upright(block, leans) if block >= lanes else None


def _least_horizontal(d00: np.ndarray, eu: np.ndarray, width: int) -> np.ndarray:
    """(C,) the least length of d00 + u eu for u in [0, width − 1]; all (C, 2)."""
    nearest = -np.sum(d00 * eu, 1) / np.maximum(np.sum(eu * eu, 1), 1e-30)
    length: np.ndarray = np.linalg.norm(d00 + np.clip(nearest, 0, width - 1)[:, None] * eu, axis=1)
    return length


def _lies_between(grid: Grid, source: np.ndarray, d00: np.ndarray, eu: np.ndarray, ev: np.ndarray) -> bool:
    """Whether the grid and a voxel around it lie between the source and the panel of every pose (C, 3), in voxels."""
    nz, ny, nx = grid.shape
    corners = np.array([(x, y, z) for x in (-1, nx) for y in (-1, ny) for z in (-1, nz)])
    normal = np.cross(eu, ev)
    depth = np.einsum("ckj,cj->ck", corners - source[:, None], normal) / np.sum(d00 * normal, 1)[:, None]
    return bool((depth > 0).all() and (depth < 1).all())


def columns_floats(grid: Grid) -> int:
    """What the turned volume takes."""
    nz, ny, nx = grid.shape
    return 2 * GUARD + (ny + 2 * BORDER) * (nx + 2 * BORDER) * pitch_of(nz)


def launch_upright(
    rt: Runtime,
    layout: RayLayout,
    how: Upright,
    poses: UprightPoses,
    slots: Slots,
    columns: DeviceArray,
    target: tuple[DeviceArray, np.ndarray],
) -> None:
    """Line integrals of a turned volume, each slot's of its own part of the panel, into an array with strides as of
    ``Slots.strides``."""
    shape, origin, _, pitch_mm, *_ = layout.constants()
    array, strides = target
    rt.launch(
        rt.kernel("rays_upright", "rays_upright", **_defines(how)),
        (slots.columns, -(-slots.rows // how.block), slots.count),
        columns,
        poses.cells,
        slots.slots,
        shape,
        origin,
        np.int32(pitch_of(layout.grid.shape[0])),
        pitch_mm,
        np.int32(how.block),
        strides,
        array,
        group=min(slots.columns, 8),
    )


def launch_upright_adjoint(
    rt: Runtime,
    layout: RayLayout,
    how: Upright,
    poses: UprightPoses,
    slots: Slots,
    values: DeviceArray,
    target: tuple[DeviceArray, Strides],
    *,
    add: bool = False,
) -> None:
    """Sums slots, as ``split_slots`` leaves them, onto a volume with these strides."""
    nz, ny, nx = layout.brick.shape
    shape, origin, *_ = layout.constants()
    x, y, z = _OWNED
    rt.launch(
        rt.kernel("rays_upright_adjoint", "rays_upright_adjoint", ADJOINT_X=x, ADJOINT_Y=y, ADJOINT_Z=z, **slots.defines),
        tuple(-(-n // own) for n, own in zip((nx, ny, nz), _OWNED, strict=True)),
        values,
        np.int32(slots.columns),
        np.int32(slots.pitch),
        np.int64(slots.floats),
        poses.cells,
        slots.slots,
        np.int32(slots.count),
        poses.matrices,
        np.int32(poses.matrix_stride),
        shape,
        origin,
        target[1].vector(),
        np.int32(add),
        target[0],
        group=1,
    )


def turn_volume(
    rt: Runtime, layout: RayLayout, volume: tuple[DeviceArray, Strides], columns: DeviceArray
) -> None:
    """A volume (z, y, x) with these strides to ``columns`` (y, x, z), whose padding is zero already and stays so."""
    nz, ny, nx = layout.grid.shape
    shape, *_ = layout.constants()
    size = (-(-nx // _TURN), ny, -(-nz // _TURN))
    kernel = rt.kernel("rays_upright", "turn_upright", **_defines(Upright(_LINES, False)))
    rt.launch(kernel, size, volume[0], volume[1].vector(), shape, np.int32(pitch_of(nz)), columns, group=1)


def _defines(how: Upright) -> dict[str, int]:
    sizes = {"UPRIGHT_LINES": _LINES, "UPRIGHT_VOXELS": _VOXELS}
    return {"IMAGE_GUARD": GUARD, "RAY_LONG": 0, "LEAN": int(how.leans), **sizes}
