"""Layout of Gaussians, time cells (poses with their lines) and layers of frames in device memory.

A detector that averages intensities records −ln Σ w_k exp(−p_k) over the time cells k of a line, with weights w_k and line
integrals p_k. So the projector draws w_k p_k into a separate image ("layer") for each k, and the layers are then merged.
Merging also keeps d(frame)/d(layer), which the adjoint needs."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime
from phyradgs_cl.runtime.layout import GUARD, padded_zeros, pitch_of

STRIDE_OF = 16  # the number of Gaussians is padded to a multiple of this, the width of the widest vector
CELL_FLOATS = 24  # number of floats of a time cell, as cl/common/splat.h describes it


@dataclass(eq=False)
class DeviceGaussians:
    """Parameters of Gaussians on the device, ``rows`` (11, stride) float32. Columns from ``count`` on are padding."""

    rows: DeviceArray
    count: int
    stride: int

    @classmethod
    def upload(cls, rt: Runtime, rows: np.ndarray) -> "DeviceGaussians":
        """Uploads parameter rows (11, G), padded with unit Gaussians, which are never drawn."""
        return cls(rt.upload(pad_columns(rows)), rows.shape[1], stride_of(rows.shape[1]))


def stride_of(count: int) -> int:
    return max(ceil_div(count, STRIDE_OF), 1) * STRIDE_OF


def pad_columns(rows: np.ndarray) -> np.ndarray:
    """Pads parameter rows (11, G) to (11, stride) float32 with unit Gaussians."""
    padded = np.zeros((rows.shape[0], stride_of(rows.shape[1])), np.float32)
    padded[3:7] = 1.0
    padded[10] = 1.0
    padded[:, : rows.shape[1]] = rows
    return padded


def split_coefficients(rt: Runtime, matrix: np.ndarray) -> DeviceArray:
    """Uploads a matrix's coefficients as float64, or as pairs of float32 (high, low) if the device lacks float64."""
    matrix = np.ascontiguousarray(matrix, np.float64)
    if rt.fp64:
        return rt.upload(matrix)
    high = matrix.astype(np.float32)
    return rt.upload(np.stack([high, (matrix - high).astype(np.float32)], -1))


@dataclass(eq=False)
class DeviceCells:
    """The C time cells of one frame on the device. A frame that is read column by column is projected transposed, with its
    poses' steps along u and v exchanged, so lines are always rows of the image.

    - matrices: one pose per cell. If ``moving``, three: the middle and both ends.
    - line_times (C, 3, time_pitch): ``TimeCells.line_times`` with padded lines if ``moving``, else one element.
    - layers: number of layers for averaging intensities. layer_weights (layers, lines): weights of the cells in each.
    - fixed_conic: ``cells`` describe the pose that gives splats their shape; ``matrices`` have that pose, then the cell's.
    - shares (S, R), cell_states (C, poses): for an object that moves, the weights of its R displacement fields in S states,
      and the state at each pose; else one element each."""

    cells: DeviceArray
    matrices: DeviceArray
    cell_lines: DeviceArray
    line_cells: DeviceArray
    line_times: DeviceArray
    layer_weights: DeviceArray
    shares: DeviceArray
    cell_states: DeviceArray
    count: int
    lines: int
    layers: int
    moving: bool = False
    fixed_conic: bool = False
    is_parallel: bool = False

    @property
    def time_pitch(self) -> int:
        return pitch_of(self.lines)

    @classmethod
    def upload(
        cls, rt: Runtime, table: TimeCells, states: tuple[np.ndarray, np.ndarray] | None = None
    ) -> "DeviceCells":
        """Uploads a frame's cells. states: what ``states_of`` returns for an object that moves. Raises InputError for cells
        with a weight of their own for each line (``line_share``)."""
        shares, cell_states = (np.zeros(1), np.zeros(1)) if states is None else states
        if table.line_share is not None:
            raise InputError("--motion", "cells with a weight for each line", "cells with one weight", "take micro-views")
        pose = table.readout.poses(table.pose)
        poses, times = pose, np.zeros(1, np.float32)
        if table.end_poses is not None and table.line_times is not None:
            poses = np.concatenate([pose[:, None], table.readout.poses(table.end_poses)], 1).reshape(-1, pose.shape[1])
            times = np.zeros((table.count, 3, pitch_of(table.lines)), np.float32)
            times[:, :, : table.lines] = table.line_times
        if table.conic_pose is not None:
            pose = np.broadcast_to(table.readout.poses(table.conic_pose[None]), pose.shape)
            poses = np.stack([pose, poses], 1).reshape(-1, pose.shape[1])
        ranges = np.stack([table.line_start, table.line_stop], -1).astype(np.int32)
        weights = table.layer_weights
        return cls(
            cells=rt.upload(cell_constants(pose, table.weight, table.layer_numbers, table.is_parallel)),
            matrices=split_coefficients(rt, projection_matrices(poses, table.is_parallel)),
            cell_lines=rt.upload(ranges),
            line_cells=rt.upload(table.line_cells(), np.int32),
            line_times=rt.upload(times),
            layer_weights=rt.upload(weights, np.float32),
            shares=rt.upload(shares, np.float32),
            cell_states=rt.upload(cell_states, np.int32),
            count=table.count,
            lines=table.lines,
            layers=len(weights),
            moving=table.is_moving,
            fixed_conic=table.conic_pose is not None,
            is_parallel=table.is_parallel,
        )


def projection_matrices(pose: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Returns matrices (C, 3 · 4) that map a world point x to (u·z, v·z, z), with its pixel column u, line v and depth z.

    x − source = z (d00 + u·eu + v·ev), where d00 goes from the source to pixel (0, 0). In a parallel beam
    x − pixel (0, 0) = u·eu + v·ev + t·direction, and z is 1."""
    if is_parallel:
        inverse = np.linalg.inv(np.stack([pose[:, 6:9], pose[:, 9:12], pose[:, 0:3]], -1))
        shift = -np.einsum("cij,cj->ci", inverse, pose[:, 3:6])
        matrix = np.concatenate([inverse, shift[:, :, None]], -1)
        matrix[:, 2] = [0, 0, 0, 1]
        return matrix.reshape(-1, 12)
    source, first = pose[:, 0:3], pose[:, 3:6]
    basis = np.stack([pose[:, 6:9], pose[:, 9:12], first - source], -1)  # columns eu, ev, d00
    inverse = np.linalg.inv(basis)
    shift = -np.einsum("cij,cj->ci", inverse, source)
    return np.concatenate([inverse, shift[:, :, None]], -1).reshape(len(pose), 12)


def cell_constants(
    pose: np.ndarray, weight: np.ndarray, layer: np.ndarray, is_parallel: bool = False
) -> np.ndarray:
    """Returns the table (C, 24) float32 that cl/common/splat.h describes, for cells with a pose (C, 12), weight (C,) and
    layer (C,)."""
    if is_parallel:  # kernels take minus the direction for the source, and the origin for pixel (0, 0)
        pose = np.concatenate([-pose[:, 0:3], np.zeros((len(pose), 3)), pose[:, 6:]], 1)
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


class Layers:
    """Memory for a frame's layers of ``lines`` × ``width`` pixels, and the kernels that merge them. unit: the line integral
    for which a value of 1 in a layer stands."""

    def __init__(self, rt: Runtime, lines: int, width: int, unit: float) -> None:
        self.rt, self.lines, self.width, self.unit = rt, lines, width, unit
        self._count = 0
        self._merge = rt.kernel("intensity", "intensity_merge", IMAGE_GUARD=GUARD)
        self._split = rt.kernel("intensity", "intensity_split", IMAGE_GUARD=GUARD)

    def images(self, cells: DeviceCells) -> DeviceArray:
        """Returns memory for the layers of ``cells``: for each layer GUARD zeros and an image (lines, pitch); GUARD zeros at
        the end."""
        if cells.layers > self._count:
            self._count = cells.layers
            self._drawn, self._shares, self._by_layers = (
                padded_zeros(self.rt, self.lines, self.width, self._count) for _ in range(3)
            )
        floats = cells.layers * (GUARD + self.lines * pitch_of(self.width)) + GUARD
        return DeviceArray(self._drawn.buffer, (floats,), self._drawn.dtype)

    def merge(self, cells: DeviceCells, merged: DeviceArray) -> None:
        """Writes −ln Σ w exp(−p) over the layers that were drawn last into ``merged``."""
        self._launch(
            self._merge, (self._drawn, cells.layer_weights), cells,
            (np.float32(self.unit), self._shares, merged),
        )

    def split(self, cells: DeviceCells, by_merged: DeviceArray) -> DeviceArray:
        """Returns dL/d(layers) from dL/d(merged) for the last ``merge``. The memory is valid until the next call."""
        self._launch(self._split, (by_merged, self._shares), cells, (self._by_layers,))
        return self._by_layers

    def _launch(
        self, kernel: Kernel, inputs: tuple[object, ...], cells: DeviceCells, rest: tuple[object, ...]
    ) -> None:
        rt = self.rt
        sizes = (np.int32(n) for n in (cells.layers, self.lines, self.width, pitch_of(self.width)))
        rt.launch(kernel, (ceil_div(self.width, rt.lanes), self.lines), *inputs, *sizes, *rest, group=rt.group())
