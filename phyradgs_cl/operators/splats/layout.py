"""How Gaussians and time cells lie in device memory."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import pitch_of

STRIDE_OF = 16  # Gaussians are padded to a multiple of the widest vector
CELL_FLOATS = 24


@dataclass(eq=False)
class DeviceGaussians:
    """Parameter rows (11, stride) float32 on the device, of which the first ``count`` columns are real."""

    rows: DeviceArray
    count: int
    stride: int

    @classmethod
    def upload(cls, rt: Runtime, rows: np.ndarray) -> "DeviceGaussians":
        """From parameter rows (11, G); padding is a harmless unit Gaussian."""
        return cls(rt.upload(pad_columns(rows)), rows.shape[1], stride_of(rows.shape[1]))


def stride_of(count: int) -> int:
    return max(-(-count // STRIDE_OF), 1) * STRIDE_OF


def pad_columns(rows: np.ndarray) -> np.ndarray:
    """(11, G) rows to (11, stride) float32."""
    padded = np.zeros((rows.shape[0], stride_of(rows.shape[1])), np.float32)
    padded[3:7] = 1.0
    padded[10] = 1.0
    padded[:, : rows.shape[1]] = rows
    return padded


def split_coefficients(rt: Runtime, matrix: np.ndarray) -> DeviceArray:
    """Uploads float64 coefficients as they are, or as (high, low) float pairs where the device has no fp64."""
    matrix = np.ascontiguousarray(matrix, np.float64)
    if rt.fp64:
        return rt.upload(matrix)
    high = matrix.astype(np.float32)
    return rt.upload(np.stack([high, (matrix - high).astype(np.float32)], -1))


@dataclass(eq=False)
class DeviceCells:
    """The time cells of one frame on the device; lines are always the slow axis of the image.

    A frame read out along columns is handled as its transpose: only the poses' pixel steps change places.
    With motion, ``matrices`` has three poses per cell, middle and both ends, and ``line_times`` (C, 3, time_pitch) when
    every line integrates (TimeCells.line_times); without, it is a dummy. For the intensity model cells are spread over
    ``layers`` images in which no line has two; ``layer_weights`` (layers, lines) are their shares of a line's window.
    """

    cells: DeviceArray
    matrices: DeviceArray
    cell_lines: DeviceArray
    line_cells: DeviceArray
    line_times: DeviceArray
    layer_weights: DeviceArray
    count: int
    lines: int
    layers: int
    moving: bool = False

    @property
    def time_pitch(self) -> int:
        return pitch_of(self.lines)

    @classmethod
    def upload(cls, rt: Runtime, table: TimeCells) -> "DeviceCells":
        if table.line_share is not None:
            raise InputError("--motion", "cells with a weight for each line", "cells with one weight", "take micro-views")
        pose = table.readout.poses(table.pose)
        poses, times = pose, np.zeros(1, np.float32)
        if table.end_poses is not None and table.line_times is not None:
            poses = np.concatenate([pose[:, None], table.readout.poses(table.end_poses)], 1).reshape(-1, pose.shape[1])
            times = np.zeros((table.count, 3, pitch_of(table.lines)), np.float32)
            times[:, :, : table.lines] = table.line_times
        ranges = np.stack([table.line_start, table.line_stop], -1).astype(np.int32)
        weights = table.layer_weights
        return cls(
            cells=rt.upload(cell_constants(pose, table.weight, table.layer_numbers)),
            matrices=split_coefficients(rt, projection_matrices(poses)),
            cell_lines=rt.upload(ranges),
            line_cells=rt.upload(table.line_cells(), np.int32),
            line_times=rt.upload(times),
            layer_weights=rt.upload(weights, np.float32),
            count=table.count,
            lines=table.lines,
            layers=len(weights),
            moving=table.is_moving,
        )


def projection_matrices(pose: np.ndarray) -> np.ndarray:
    """Rows (C, 12) that turn a world point x into (u·z, v·z, z): pixel column, line and depth of its ray.

    x − source = z (d00 + u·eu + v·ev), with d00 from the source to pixel (0, 0).
    """
    source, first = pose[:, 0:3], pose[:, 3:6]
    basis = np.stack([pose[:, 6:9], pose[:, 9:12], first - source], -1)  # columns eu, ev, d00
    inverse = np.linalg.inv(basis)
    shift = -np.einsum("cij,cj->ci", inverse, source)
    return np.concatenate([inverse, shift[:, :, None]], -1).reshape(len(pose), 12)


def cell_constants(pose: np.ndarray, weight: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """The (C, 24) float32 table that cl/common/splat.h describes."""
    source, d00 = pose[:, 0:3], pose[:, 3:6] - pose[:, 0:3]
    eu, ev = pose[:, 6:9], pose[:, 9:12]
    table = np.zeros((len(pose), CELL_FLOATS))
    table[:, 0:3], table[:, 3:6], table[:, 6:9] = source, eu, ev
    table[:, 9] = np.einsum("ci,ci->c", np.cross(eu, ev), d00)
    table[:, 10] = weight
    for column, (a, b, factor) in enumerate(
        [(d00, d00, 1), (d00, eu, 2), (d00, ev, 2), (eu, eu, 1), (eu, ev, 2), (ev, ev, 1)], start=11
    ):
        table[:, column] = factor * np.einsum("ci,ci->c", a, b)
    table[:, 17] = layer
    return table.astype(np.float32)
