"""The ray-driven projector where detector columns are parallel to the volume's z and a pose serves many lines.

Rays of a column lie in one upright plane then, and share half of their work. The samples are those of ``rays``.
"""

from collections.abc import Sequence

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.layout import BORDER, RayCells, RayLayout, ray_constants
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, pitch_of

_LINES = 128  # of a detector column for a work-item
_VOXELS = 512  # of a column of the volume that they may meet in one slice
_OWNED = (8, 4, 128)  # voxels (x, y, z) of a work-item of the adjoint: neighbouring columns share what rays bring
_UPRIGHT = 1e-6  # voxels: how far a ray may lean over the whole detector
_TURN = 16  # voxels along x and z that are turned at a time; as in cl/rays_upright.cl


def upright_block(grid: Grid, tables: Sequence[TimeCells], width: int, lanes: int) -> int:
    """Lines of a detector column that a work-item may take; 0 where rays need the general kernel.

    It needs lines that differ in z alone, rays whose main axis is x or y, and poses that serve ``lanes`` lines each.
    """
    shared = sum(int((table.line_stop - table.line_start).sum()) for table in tables)
    if shared < lanes * sum(table.count for table in tables):
        return 0
    poses = np.concatenate([table.readout.poses(table.pose) for table in tables])
    cells = ray_constants(poses, np.ones(len(poses)), grid).astype(np.float64)
    d00, eu, ev = cells[:, 3:6], cells[:, 6:9], cells[:, 9:12]
    lines = tables[0].lines
    if np.abs(ev[:, :2]).max() * lines > _UPRIGHT or np.abs(eu[:, 2]).max() * width > _UPRIGHT:
        return 0
    steepest = np.maximum(np.abs(d00[:, 2]), np.abs(d00[:, 2] + (lines - 1) * ev[:, 2]))
    if (steepest > _least_horizontal(d00[:, :2], eu[:, :2], width) / np.sqrt(2)).any():
        return 0
    block = int(min(_LINES, lines, (_VOXELS - 4) // max(np.abs(ev[:, 2]).max(), 1e-3)))
    return block if block >= lanes else 0


def serve_one_line_each(tables: Sequence[TimeCells]) -> bool:
    """Whether no line has more than one cell: frames can then be weighed before they go back."""
    return all(int((table.line_stop - table.line_start).sum()) <= table.lines for table in tables)


def _least_horizontal(d00: np.ndarray, eu: np.ndarray, width: int) -> np.ndarray:
    """(C,) the least length of d00 + u eu for u in [0, width − 1]; all (C, 2)."""
    nearest = -np.sum(d00 * eu, 1) / np.maximum(np.sum(eu * eu, 1), 1e-30)
    length: np.ndarray = np.linalg.norm(d00 + np.clip(nearest, 0, width - 1)[:, None] * eu, axis=1)
    return length


def columns_floats(grid: Grid) -> int:
    """What the turned volume takes."""
    nz, ny, nx = grid.shape
    return 2 * GUARD + (ny + 2 * BORDER) * (nx + 2 * BORDER) * pitch_of(nz)


def launch_upright(
    rt: Runtime,
    layout: RayLayout,
    cells: RayCells,
    frame_list: DeviceArray,
    columns: DeviceArray,
    frames: DeviceArray,
    block: int,
) -> None:
    """The listed frames of a turned volume, into ``frames``; as ``rays.launch_forward`` with the log average."""
    shape, origin, _, *rest = layout.constants()
    rt.launch(
        rt.kernel("rays_upright", "rays_upright", **_defines()),
        (layout.width, -(-layout.lines // block), frame_list.size),
        columns,
        cells.cells,
        cells.cell_lines,
        cells.line_cells,
        frame_list,
        shape,
        origin,
        np.int32(pitch_of(layout.grid.shape[0])),
        *rest,
        np.int32(block),
        frames,
        group=1,
    )


def launch_upright_adjoint(
    rt: Runtime,
    layout: RayLayout,
    cells: RayCells,
    frame_list: DeviceArray,
    turned: DeviceArray,
    volume: DeviceArray,
    *,
    add: bool = False,
) -> None:
    """Sums the listed frames, turned and weighed, onto a padded volume; as ``rays.launch_adjoint``."""
    nz, ny, nx = layout.brick.shape
    shape, origin, pitch, *_ = layout.constants()
    rt.launch(
        rt.kernel("rays_upright_adjoint", "rays_upright_adjoint", **_adjoint_defines()),
        tuple(-(-n // own) for n, own in zip((nx, ny, nz), _OWNED, strict=True)),
        turned,
        cells.cells,
        cells.cell_lines,
        cells.matrices,
        np.int32(cells.matrix_stride),
        cells.frame_cells,
        frame_list,
        np.int32(frame_list.size),
        shape,
        origin,
        pitch,
        np.int32(layout.width),
        np.int32(pitch_of(layout.lines)),
        np.int32(add),
        volume,
        group=1,
    )


def weigh_columns(
    rt: Runtime, layout: RayLayout, cells: RayCells, frame_list: DeviceArray, turned: DeviceArray
) -> None:
    """Turned frames, each pixel times its ray's length per sample and its cell's weight."""
    _, _, _, pitch_mm, lines, width, _ = layout.constants()
    rt.launch(
        rt.kernel("rays_upright_adjoint", "weigh_columns", **_adjoint_defines()),
        (layout.width, frame_list.size),
        cells.cells,
        cells.cell_lines,
        cells.frame_cells,
        frame_list,
        pitch_mm,
        lines,
        width,
        np.int32(pitch_of(layout.lines)),
        turned,
        group=1,
    )


def turn_volume(rt: Runtime, layout: RayLayout, volume: DeviceArray, columns: DeviceArray) -> None:
    """A padded volume (z, y, x) to ``columns`` (y, x, z), whose padding is zero already and stays so."""
    nz, ny, nx = layout.grid.shape
    shape, _, pitch, *_ = layout.constants()
    size = (-(-nx // _TURN), ny, -(-nz // _TURN))
    kernel = rt.kernel("rays_upright", "turn_upright", **_defines())
    rt.launch(kernel, size, volume, shape, pitch, np.int32(pitch_of(nz)), columns, group=1)


def _defines() -> dict[str, int]:
    return {"IMAGE_GUARD": GUARD, "RAY_LONG": 0, "UPRIGHT_LINES": _LINES, "UPRIGHT_VOXELS": _VOXELS}


def _adjoint_defines() -> dict[str, int]:
    x, y, z = _OWNED
    return {"IMAGE_GUARD": GUARD, "RAY_LONG": 0, "ADJOINT_X": x, "ADJOINT_Y": y, "ADJOINT_Z": z}
