"""Ray-driven projector of one frame at a time, and its matched adjoint."""

import logging

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.launches import launch_adjoint, launch_forward
from phyradgs_cl.operators.rays.layout import RayCells, RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.runtime import DeviceArray, MemoryShortage, Runtime
from phyradgs_cl.runtime.layout import pad_rows, unpad_rows

log = logging.getLogger(__name__)


class RayProjector:
    """Line integrals of a voxel grid, weighted over a frame's cells: the merged frame, in one launch.

    Joseph's method: one bilinear sample per plane of each ray's own main axis; voxels outside are zero.
    """

    def __init__(self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], axis: str = "rows") -> None:
        self.rt, self.grid, self.axis = rt, grid, axis
        self._detector_shape = detector_shape
        self._layout = RayLayout.of_scan(grid, detector_shape, axis)
        self._only = rt.upload(np.zeros(1, np.int32))
        self._image = rt.zeros(self._layout.frames_floats(1))
        self._memory = RayMemory(rt, self._layout, 1)

    def upload_volume(self, volume: np.ndarray) -> DeviceArray | np.ndarray:
        """A volume (z, y, x) in the padded layout; as it is where the device has no room for all of it at a time."""
        room = self.rt.room()
        if room.holds(4 * self._layout.volume_floats):
            try:
                return self.rt.upload(self._layout.pad_volume(volume))
            except MemoryShortage as error:
                log.warning("%s; the volume is projected in bricks", str(error))
                self._memory.plan(0.25)
        return np.asarray(volume, np.float32)

    def _check(self, table: TimeCells) -> None:
        """Cells of another panel would be read past their ends."""
        expected = (self.axis, self._layout.lines)
        if (table.axis, table.lines) != expected:
            found = f"{table.lines} lines along {table.axis}"
            raise InputError("time cells", found, f"{expected[1]} lines along {expected[0]}, the projector's")

    def forward(
        self, volume: DeviceArray | np.ndarray, table: TimeCells, detector_model: str = "log"
    ) -> np.ndarray:
        """The merged frame (rows, columns) float32 of a volume in 1/mm, as ``upload_volume`` gave it.

        ``log`` averages line integrals over the cells; ``intensity`` takes −ln of the mean transmission.
        """
        self._check(table)
        if isinstance(volume, np.ndarray):
            operator = RayOperator(self.rt, self.grid, self._detector_shape, [table], memory=self._memory)
            return operator.project(volume, detector_model).squeeze(0)
        cells = RayCells.upload(self.rt, self.grid, [table])
        launch_forward(self.rt, self._layout, cells, self._only, volume, self._image, average=detector_model)
        image = unpad_rows(self.rt.download(self._image), self._layout.frames_shape(1))[0]
        return np.ascontiguousarray(table.readout.frames(image))

    def adjoint(self, frame: np.ndarray, table: TimeCells, volume: DeviceArray, *, add: bool = False) -> None:
        """Aᵀ of ``forward`` with the log model: a frame (rows, columns) onto a padded volume."""
        self._check(table)
        image = self.rt.upload(pad_rows(table.readout.frames(frame)))
        cells = RayCells.upload(self.rt, self.grid, [table])
        launch_adjoint(self.rt, self._layout, cells, self._only, image, volume, add=add)

    def backproject(self, frame: np.ndarray, table: TimeCells) -> np.ndarray:
        """Aᵀ frame as an array (z, y, x) float32."""
        self._check(table)
        operator = RayOperator(self.rt, self.grid, self._detector_shape, [table], memory=self._memory)
        return operator.adjoint(np.asarray(frame, np.float32)[None])
