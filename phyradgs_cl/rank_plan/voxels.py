"""The methods on voxels over ranks: frames are shared out, volumes summed, the total variation is in slabs."""

from __future__ import annotations

from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.operators.rays import RayLayout
from phyradgs_cl.operators.rays_upright import columns_floats, upright_block
from phyradgs_cl.parallel import span
from phyradgs_cl.rank_plan.load import Load, RankPlan, size_text
from phyradgs_cl.reconstructors.shared_tv import tv_device_bytes

_CELL_BYTES, _LINE_BYTES = 120, 8  # of the tables of rays
_FLAG_BYTES = 4
_CPU_LANES = 16


def voxel_plan(scan: Scan, method: str, options: Any, ranks: int) -> RankPlan:
    """The plan of an iterative method on ``ranks`` ranks."""
    shape, frames = scan.grid.shape, scan.frames
    layout = RayLayout.of_scan(scan.grid, scan.geometry.detector_shape, scan.shutter.axis)
    own = -(-frames // ranks)
    volume_bytes, frame_bytes = 4 * int(np.prod(shape)), scan.projections[0].nbytes
    tables = [options.motion.cells(scan, frame) for frame in range(frames)]
    cells = sum(table.count for table in tables)
    turned = upright_block(scan.grid, tables, layout.width, _CPU_LANES) > 0
    device = {
        "volume, or a brick of it": 4 * layout.volume_floats,
        "volume with z along a row, on CPUs": 4 * columns_floats(scan.grid) if turned else 0,
        "frames, or as many as fit": 4 * layout.frames_floats(frames),
        "tables of time cells": _CELL_BYTES * cells + _LINE_BYTES * layout.lines * frames,
        "slab of the total variation": tv_device_bytes(
            shape, ranks, method, getattr(options, "tv_iterations", 0)
        ),
    }
    projections, sums = _calls(method, options, frames)
    exchange = {
        "projections of its own": projections * own * frame_bytes,
        "volumes, added up": sums * (2 * volume_bytes + 8 * shape[0]),
        "slabs of the total variation": _tv_exchange_bytes(scan, method, options, ranks),
        "asking whether to stop": _FLAG_BYTES,
    }
    facts = (
        f"frames: {own} of {frames} a rank at most are projected there, the others' are fetched",
        f"volume: whole on the host of every rank, {size_text(volume_bytes)} each time that it is kept",
        f"an iteration projects all frames {_times(projections)} and adds up a volume {_times(sums)}",
    )
    return RankPlan(method, ranks, "an iteration", facts, {"": Load(device, exchange if ranks > 1 else {})})


def _calls(method: str, options: Any, frames: int) -> tuple[int, int]:
    """(projections of all frames, sums of a volume) in an iteration."""
    if method in ("sirt", "cgls", "fista-tv"):
        return 1, 1
    return (2 if method == "asd-pocs" else 1), -(-frames // options.frames_per_subset)


def _tv_exchange_bytes(scan: Scan, method: str, options: Any, ranks: int) -> int:
    """Of a rank in the middle: what the others need of its slices, and its part of the result."""
    nz, ny, nx = scan.grid.shape
    own, slice_bytes = len(span(nz, ranks, ranks // 2)), 4 * ny * nx
    if method == "fista-tv":
        return slice_bytes * (own + 3 * _slices_for_others(nz, ranks, options.tv_iterations + 1))
    if method == "asd-pocs":
        return (
            options.tv_steps * (slice_bytes * _slices_for_others(nz, ranks, 1) + 8 * own) + slice_bytes * own
        )
    return 0


def _slices_for_others(depth: int, ranks: int, halo: int) -> int:
    """How many slices a rank in the middle hands over, so that all have their halo."""
    own, given = span(depth, ranks, ranks // 2), 0
    for rank in set(range(ranks)) - {ranks // 2}:
        slab = span(depth, ranks, rank)
        if len(slab):
            given += max(min(slab.stop + halo, own.stop) - max(slab.start - halo, own.start), 0)
    return given


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
