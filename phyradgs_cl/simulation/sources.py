"""Sources of frames: voxel volumes and phantoms in closed form, projected from the poses of a frame's time cells."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import TimeCells, pixel_centres
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.detector import average
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.phantoms import EllipsoidPhantom, MovingPhantom
from phyradgs_cl.runtime import DeviceArray, MemoryShortage, Runtime


class FrameSource(ABC):
    """An object that can be projected to the frame of a cell table, attenuation multiplied by ``factor``."""

    @abstractmethod
    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray: ...

    def frames(self, tables: Sequence[TimeCells], model: str, factor: float) -> Iterator[np.ndarray]:
        """Yields the frame of each table."""
        return (self.frame(cells, model, factor) for cells in tables)


class VolumeSource(FrameSource):
    """Frames of a voxel volume (z, y, x) in 1/mm by the ray-driven projector."""

    def __init__(
        self, rt: Runtime, volume: np.ndarray, grid: Grid, geometry: Geometry, axis: str, memory: RayMemory | None = None
    ) -> None:
        self._rt, self._grid, self._detector_shape = rt, grid, geometry.detector_shape
        self._memory = memory or RayMemory(rt, RayLayout.of_scan(grid, geometry.detector_shape, axis), 1)
        self._volume = volume
        self._factor: float | None = None

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        if factor != self._factor:
            self._scaled = self._where_it_fits((self._volume * np.float32(factor)).astype(np.float32))
            self._factor = factor
        operator = RayOperator(self._rt, self._grid, self._detector_shape, [cells], memory=self._memory)
        frames = operator.project(self._scaled, model)
        return (self._rt.download(frames) if isinstance(frames, DeviceArray) else frames)[0]

    def _where_it_fits(self, volume: np.ndarray) -> np.ndarray | DeviceArray:
        """On the device, beside the operator's padded copy; on the host where the device has no room for both."""
        if not self._rt.room().holds(volume.nbytes, 4 * self._memory.layout.volume_floats):
            return volume
        try:
            return self._rt.upload(volume)
        except MemoryShortage:  # the operator says so, and projects in bricks
            return volume


class AnalyticSource(FrameSource):
    """Frames of a phantom with closed-form line integrals, in float64, with moving bodies at the times of cells."""

    def __init__(self, phantom: EllipsoidPhantom | MovingPhantom, geometry: Geometry) -> None:
        self._phantom, self._geometry = phantom, geometry

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        frame = np.empty(self._geometry.detector_shape)
        by_row = cells.axis == "rows"
        for start, stop, members in line_groups(cells):
            pixels = pixel_centres(cells.pose[members], self._geometry.detector_shape)
            target = pixels[:, start:stop] if by_row else pixels[:, :, start:stop]
            origin = cells.pose[members][:, None, None, :3]
            if cells.is_parallel:  # from before the phantom to behind it, along the rays' direction
                along = (self._phantom.reach_mm + np.linalg.norm(target, axis=-1, keepdims=True)) * origin
                origin, target = target - along, target + along
            if isinstance(self._phantom, MovingPhantom):
                p = factor * self._phantom.line_integrals(origin, target, cells.time_s[members])
            else:
                p = factor * self._phantom.line_integrals(origin, target)
            mean = average(p, cells.weight[members], model)
            frame[(slice(start, stop),) if by_row else (slice(None), slice(start, stop))] = mean
        return frame.astype(np.float32)


class PixelAreaSource(FrameSource):
    """Frames whose pixels average over their area, from ``samples`` by ``samples`` rays of a finer panel."""

    def __init__(self, finer: FrameSource, samples: int) -> None:
        self._finer, self._samples = finer, samples

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        return self._averaged(self._finer.frame(cells.finer(self._samples), model, factor), model)

    def frames(self, tables: Sequence[TimeCells], model: str, factor: float) -> Iterator[np.ndarray]:
        fine = self._finer.frames([cells.finer(self._samples) for cells in tables], model, factor)
        return (self._averaged(frame, model) for frame in fine)

    def _averaged(self, fine: np.ndarray, model: str) -> np.ndarray:
        n = self._samples
        rows, columns = fine.shape[0] // n, fine.shape[1] // n
        rays = fine.reshape(rows, n, columns, n).transpose(1, 3, 0, 2).reshape(n * n, rows, columns)
        return average(rays, np.full(n * n, 1 / n**2), model).astype(np.float32)


def line_groups(cells: TimeCells) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yields (first line, line after the last, cells) for every run of lines with the same cells."""
    ranges = np.stack([cells.line_start, cells.line_stop], -1)
    for start, stop in np.unique(ranges, axis=0):
        yield int(start), int(stop), np.flatnonzero((ranges == (start, stop)).all(axis=1))


def on_panel(geometry: Geometry, pixel_samples: int, make: Callable[[Geometry], FrameSource]) -> FrameSource:
    """Makes a source for the panel; with several samples per pixel for a finer panel, averaged over its pixels."""
    checks.within("--pixel-samples", pixel_samples, 1, 32)
    if pixel_samples == 1:
        return make(geometry)
    return PixelAreaSource(make(geometry.finer(pixel_samples)), pixel_samples)
