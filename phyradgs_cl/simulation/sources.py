"""What can be projected: frames of volumes, of phantoms in closed form, and of pixels that have an area."""

from collections.abc import Iterator
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector import average
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayProjector
from phyradgs_cl.phantoms import EllipsoidPhantom
from phyradgs_cl.runtime import Runtime


class FrameSource(Interface):
    """Whatever can be projected: the merged frame of a cell table, attenuation multiplied by ``factor``."""

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray: ...


class VolumeSource:
    """Frames of a voxel volume (z, y, x) in 1/mm by the ray-driven projector."""

    def __init__(
        self, rt: Runtime, volume: np.ndarray, grid: Grid, geometry: ConeGeometry, axis: str
    ) -> None:
        self._projector = RayProjector(rt, grid, geometry.detector_shape, axis)
        self._volume = volume
        self._factor: float | None = None

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        if factor != self._factor:
            self._on_device = self._projector.upload_volume(self._volume * np.float32(factor))
            self._factor = factor
        return self._projector.forward(self._on_device, cells, model)


class AnalyticSource:
    """Frames of a phantom with closed-form line integrals, in float64."""

    def __init__(self, phantom: EllipsoidPhantom, geometry: ConeGeometry) -> None:
        self._phantom, self._geometry = phantom, geometry

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        frame = np.empty(self._geometry.detector_shape)
        by_row = cells.axis == "rows"
        for start, stop, members in line_groups(cells):
            pixels = pixel_centres(cells.pose[members], self._geometry.detector_shape)
            target = pixels[:, start:stop] if by_row else pixels[:, :, start:stop]
            p = factor * self._phantom.line_integrals(cells.pose[members][:, None, None, :3], target)
            mean = average(p, cells.weight[members], model)
            frame[(slice(start, stop),) if by_row else (slice(None), slice(start, stop))] = mean
        return frame.astype(np.float32)


class PixelAreaSource:
    """Frames of pixels that see the mean over their area: of ``samples`` by ``samples`` rays of a finer panel."""

    def __init__(self, finer: FrameSource, samples: int) -> None:
        self._finer, self._samples = finer, samples

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        n = self._samples
        fine = self._finer.frame(cells.finer(n), model, factor)
        rows, columns = fine.shape[0] // n, fine.shape[1] // n
        rays = fine.reshape(rows, n, columns, n).transpose(1, 3, 0, 2).reshape(n * n, rows, columns)
        return average(rays, np.full(n * n, 1 / n**2), model).astype(np.float32)


def line_groups(cells: TimeCells) -> Iterator[tuple[int, int, np.ndarray]]:
    """(first line, line after the last, cells) for every run of lines that the same cells serve."""
    ranges = np.stack([cells.line_start, cells.line_stop], -1)
    for start, stop in np.unique(ranges, axis=0):
        yield int(start), int(stop), np.flatnonzero((ranges == (start, stop)).all(axis=1))
