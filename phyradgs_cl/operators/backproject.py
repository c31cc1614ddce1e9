"""Voxel-driven backprojection with FDK's distance weight."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.layout import GUARD, pad_rows, padded_zeros, pitch_of, unpad_rows
from phyradgs_cl.operators.rays import voxel_matrices
from phyradgs_cl.runtime import Runtime


def backproject(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid
) -> np.ndarray:
    """Σ_f weight_f / z² · frame_f(u, v) at every voxel centre, z the voxel's depth as a share of the ray.

    frames (F, rows, columns), bilinear and zero outside; pose (F, 12); weight (F,). Returns (z, y, x) float32.
    """
    views, rows, width = frames.shape
    nz, ny, nx = grid.shape
    stacked = np.stack([pad_rows(frame) for frame in frames])
    volume = padded_zeros(rt, nz * ny, nx)
    rt.launch(
        rt.kernel("backproject", "backproject", IMAGE_GUARD=GUARD),
        (-(-nx // rt.lanes), ny, nz),
        rt.upload(stacked),
        rt.upload(voxel_matrices(pose, grid), np.float32),
        rt.upload(weight, np.float32),
        np.int32(views),
        np.int32(rows),
        np.int32(width),
        np.int32(pitch_of(width)),
        np.int64(stacked.shape[1]),
        np.array([nx, ny, nz, 0], np.int32),
        np.int32(pitch_of(nx)),
        volume,
        group=rt.group(),
    )
    return unpad_rows(rt.download(volume), grid.shape)
