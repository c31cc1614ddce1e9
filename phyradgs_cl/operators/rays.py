"""Ray-driven projector (Joseph) and its matched adjoint, over the time cells of a frame."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.acquisition.geometry import transpose_pose
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.layout import (
    GUARD,
    cells_of_lines,
    pad_rows,
    padded_zeros,
    pitch_of,
    projection_matrices,
    unpad_rows,
)
from phyradgs_cl.runtime import DeviceArray, Runtime

_RAY_CELL_FLOATS = 28


class RayProjector:
    """Line integrals of a voxel grid, weighted over a frame's cells: the merged frame, in one launch.

    Joseph's method: one bilinear sample a plane of each ray's own main axis; voxels outside are zero.
    """

    def __init__(self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], axis: str = "rows") -> None:
        self.rt, self.grid, self.axis = rt, grid, axis
        rows, columns = detector_shape
        self.lines, self.width = (rows, columns) if axis == "rows" else (columns, rows)
        nz, ny, nx = grid.shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        dz, dy, dx = grid.voxel_size_mm
        self._pitch4 = np.array([dx, dy, dz, 0], np.float32)
        self._image = padded_zeros(rt, self.lines, self.width)

    def upload_volume(self, volume: np.ndarray) -> DeviceArray:
        """A volume (z, y, x) in the padded layout."""
        return self.rt.upload(pad_rows(volume))

    def forward(self, volume: DeviceArray, table: TimeCells, detector_model: str = "log") -> np.ndarray:
        """The merged frame (rows, columns) float32 of a padded volume in 1/mm.

        ``log`` averages line integrals over the cells; ``intensity`` takes −ln of the mean transmission.
        """
        ranges = self._ranges(table)
        self.rt.launch(
            self.rt.kernel("rays", "rays_forward", IMAGE_GUARD=GUARD),
            (self.width, self.lines),
            volume,
            self.rt.upload(self._constants(table)),
            self.rt.upload(ranges),
            self.rt.upload(cells_of_lines(ranges, self.lines)),
            self._shape4,
            np.int32(pitch_of(self.grid.shape[2])),
            self._pitch4,
            np.int32(self.lines),
            np.int32(self.width),
            np.int32(pitch_of(self.width)),
            np.int32(detector_model == "intensity"),
            self._image,
            group=self.rt.group(on_cpu=16),
        )
        image = unpad_rows(self.rt.download(self._image), (self.lines, self.width))
        return image if self.axis == "rows" else np.ascontiguousarray(image.T)

    def adjoint(self, frame: np.ndarray, table: TimeCells, volume: DeviceArray, *, add: bool = False) -> None:
        """Aᵀ of ``forward`` with the log model: a frame (rows, columns) onto a padded volume."""
        nz, ny, nx = self.grid.shape
        image = frame if self.axis == "rows" else np.ascontiguousarray(frame.T)
        self.rt.launch(
            self.rt.kernel("rays", "rays_adjoint", IMAGE_GUARD=GUARD),
            (nx, ny, nz),
            self.rt.upload(pad_rows(image)),
            self.rt.upload(self._constants(table)),
            self.rt.upload(self._ranges(table)),
            np.int32(table.count),
            self._shape4,
            np.int32(pitch_of(nx)),
            self._pitch4,
            np.int32(self.lines),
            np.int32(self.width),
            np.int32(pitch_of(self.width)),
            np.int32(add),
            volume,
            group=self.rt.group(on_cpu=16),
        )

    def backproject(self, frame: np.ndarray, table: TimeCells) -> np.ndarray:
        """Aᵀ frame as an array (z, y, x) float32."""
        nz, ny, nx = self.grid.shape
        volume = padded_zeros(self.rt, nz * ny, nx)
        self.adjoint(frame, table, volume)
        return unpad_rows(self.rt.download(volume), self.grid.shape)

    def _ranges(self, table: TimeCells) -> np.ndarray:
        return np.stack([table.line_start, table.line_stop], -1).astype(np.int32)

    def _constants(self, table: TimeCells) -> np.ndarray:
        """Poses in voxel indices: the (C, 28) table that cl/rays.cl describes."""
        pose = transpose_pose(table.pose) if self.axis == "columns" else table.pose
        first = np.array(self.grid.first_centre_mm[::-1])
        pitch = np.array(self.grid.voxel_size_mm[::-1])
        constants = np.zeros((table.count, _RAY_CELL_FLOATS))
        constants[:, 0:3] = (pose[:, 0:3] - first) / pitch
        constants[:, 3:6] = (pose[:, 3:6] - pose[:, 0:3]) / pitch
        constants[:, 6:9] = pose[:, 6:9] / pitch
        constants[:, 9:12] = pose[:, 9:12] / pitch
        constants[:, 12] = table.weight
        constants[:, 13:25] = voxel_matrices(pose, self.grid)
        return constants.astype(np.float32)


def voxel_matrices(pose: np.ndarray, grid: Grid) -> np.ndarray:
    """Rows (C, 12) that turn a voxel index (x, y, z) into (u·z, v·z, z)."""
    matrix = projection_matrices(pose).reshape(-1, 3, 4)
    first = np.array(grid.first_centre_mm[::-1])
    pitch = np.array(grid.voxel_size_mm[::-1])
    shift = np.einsum("cij,j->ci", matrix[:, :, :3], first) + matrix[:, :, 3]
    return np.concatenate([matrix[:, :, :3] * pitch, shift[:, :, None]], -1).reshape(-1, 12)
