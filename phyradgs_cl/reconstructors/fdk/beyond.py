"""Objects wider than the panel: rows that go on beyond it as a volume on a grid that holds the object has them.

The volume explains the frames by FISTA-TV. What the panel has seen stays as it was measured, so that FDK adds to that volume
what frames tell beyond it.
"""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import LineMiddles, Motion, PerRow, Scan
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.reconstructors.fdk.views import widened
from phyradgs_cl.reconstructors.result import Progress, ProgressReport, Report
from phyradgs_cl.reconstructors.voxels import fista_tv
from phyradgs_cl.reconstructors.voxels.fista_tv import FistaTvOptions
from phyradgs_cl.runtime import Runtime

_ITERATIONS = 30
_MOST = 2.0  # of the panel's columns, added at each side


def whole_object(scan: Scan, motion: Motion, rt: Runtime, report: ProgressReport) -> np.ndarray:
    """A volume (nz, ny, nx) in 1/mm on the scan's grid that explains its frames. Raises KeyboardInterrupt where it is
    stopped, as FDK has nothing to go on from."""

    def hook(progress: Progress) -> Progress:
        return replace(progress, quantity=f"rows beyond the panel: {progress.quantity}", state=None)

    at_times: Motion = PerRow(sub_intervals=2) if isinstance(motion, LineMiddles) else motion
    options, report = FistaTvOptions(motion=at_times, iterations=_ITERATIONS), Report.of(report)
    with report.through(hook):
        result = fista_tv.METHOD.run(scan, options, rt, report=report)
    if result.facts["interrupted_at"] is not None:
        raise KeyboardInterrupt
    return result.volume


def reprojected(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, axis: str, volume: np.ndarray, grid: Grid
) -> tuple[np.ndarray, int]:
    """Line integrals (F, v, u + 2 n) float32: ``frames`` (F, v, u), continued by those of a volume (nz, ny, nx) in 1/mm; and
    n. pose (F, 12) or (F, lines, 12) in mm, a pose for every line along ``axis``."""
    rows, columns = frames.shape[1:]
    count = _columns_beyond(pose.reshape(-1, 12), columns, grid)
    wide = widened(pose, axis, (count, count))
    by_line = wide[:, None] if wide.ndim == 2 else wide
    shape = rows, columns + 2 * count
    operator = RayOperator(rt, grid, shape, [_cells(poses, shape[axis == "columns"], axis) for poses in by_line])
    found = operator.forward(np.ascontiguousarray(volume, np.float32))
    found[..., count : count + columns] = frames
    return found, count


def _cells(pose: np.ndarray, lines: int, axis: str) -> TimeCells:
    """A pose (1, 12) of all lines, or (lines, 12) one of each, as still cells."""
    ends = np.linspace(0, lines, len(pose) + 1).round().astype(np.int32)
    return TimeCells(pose, np.zeros(len(pose)), ends[:-1], ends[1:], np.ones(len(pose)), lines, axis)


def _columns_beyond(pose: np.ndarray, columns: int, grid: Grid) -> int:
    """How many columns the panel of any pose (n, 12) lacks at a side to see all of the grid's box, within reason."""
    source, first, step_u, step_v = (pose[:, None, i : i + 3] for i in (0, 3, 6, 9))
    corners = np.stack(np.meshgrid(*grid.box_mm[::-1], indexing="ij"), -1).reshape(1, 8, 3)
    normal = np.cross(step_u, step_v)
    depth = ((corners - source) * normal).sum(-1) / ((first - source) * normal).sum(-1)  # 1 on the panel, 0 at the source
    across = np.cross(step_v, normal)
    hit = (corners - source) / np.maximum(depth, 1e-6)[..., None] - (first - source)
    column = (hit * across).sum(-1) / (step_u * across).sum(-1)
    beyond = max(-float(column.min()), float(column.max()) - (columns - 1))
    return int(np.clip(np.ceil(beyond), 0, round(_MOST * columns)))
