"""Projects objects for simulated frames: voxel volumes, at rest or deforming, and phantoms in closed form. Each line sees a
moving object at the times at which the line is open. A table of time cells says which pose each line has, and when."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import TimeCells, pixel_centres
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.detector import average
from phyradgs_cl.fields import Deformation, Grid, SplineVolume
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.operators.rays.layout import RayLayout, some_cells
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.warp.states import MotionStates, unit_fields_mm
from phyradgs_cl.operators.warp.volume import VolumeWarp
from phyradgs_cl.phantoms import EllipsoidPhantom, MovingPhantom
from phyradgs_cl.runtime import DeviceArray, MemoryShortage, Runtime

# One ray is enough for a pixel whose image at the axis is at most this many voxels wide. A pixel is 1.43 voxels wide in a
# common scanner with as many voxels as pixels along a side.
WIDEST_RAY = 1.5
_MOST_SAMPLES = 32  # most rays along each side of a pixel: the time grows with their square
NEAREST = 0.1  # moving matter is projected at most this far from its exact position, in voxels of the grid to reconstruct


class FrameSource:
    """Projects an object, its attenuation multiplied by ``factor``, to the frame of each table of time cells. model: what
    the detector averages, "log" (line integrals) or "intensity". A subclass overrides ``frame`` or ``frames``."""

    pixel_samples = 1  # rays along each side of a pixel

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        return next(self.frames([cells], model, factor))

    def frames(self, tables: Sequence[TimeCells], model: str, factor: float) -> Iterator[np.ndarray]:
        return (self.frame(cells, model, factor) for cells in tables)


class VolumeSource(FrameSource):
    """Projects a voxel volume (nz, ny, nx) in 1/mm with the ray-driven projector."""

    def __init__(
        self, rt: Runtime, volume: np.ndarray, grid: Grid, geometry: Geometry, axis: str, memory: RayMemory | None = None
    ) -> None:
        self._rt, self._grid, self._detector_shape = rt, grid, geometry.detector_shape
        self._memory = memory or RayMemory(rt, RayLayout.of_scan(rt, grid, geometry.detector_shape, axis), 1)
        self._volume = volume
        self._factor: float | None = None

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        if factor != self._factor:
            self._scaled = self._where_it_fits((self._volume * np.float32(factor)).astype(np.float32))
            self._factor = factor
        of_cells = self._rt, self._grid, self._detector_shape, [cells]
        if model == "intensity":
            frames = IntensityOperator(*of_cells).expected(self._scaled)
        else:
            frames = RayOperator(*of_cells, memory=self._memory).forward(self._scaled)
        return (self._rt.download(frames) if isinstance(frames, DeviceArray) else frames)[0]

    def _where_it_fits(self, volume: np.ndarray) -> np.ndarray | DeviceArray:
        """Returns the volume on the device if it and the operator's padded copy of it fit there, else on the host."""
        if not self._rt.room().holds(volume.nbytes, 4 * self._memory.layout.volume_floats):
            return volume
        try:
            return self._rt.upload(volume)
        except MemoryShortage:  # a volume on the host is projected part by part
            return volume


class AnalyticSource(FrameSource):
    """Projects a phantom by closed-form line integrals, computed in float64, to float32 frames.

    Parts that move are projected where they are at the time of each time cell."""

    def __init__(self, phantom: EllipsoidPhantom | MovingPhantom, geometry: Geometry) -> None:
        self._phantom, self._geometry = phantom, geometry

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        frame = np.empty(self._geometry.detector_shape)
        by_line, shape = cells.readout.frames(frame), cells.readout.shape(self._geometry.detector_shape)
        poses = cells.readout.poses(cells.pose)
        for start, stop, members in line_groups(cells):
            target = pixel_centres(poses[members], shape)[:, start:stop]
            origin = poses[members][:, None, None, :3]
            if cells.is_parallel:  # rays begin before the phantom and end behind it
                along = (self._phantom.reach_mm + np.linalg.norm(target, axis=-1, keepdims=True)) * origin
                origin, target = target - along, target + along
            if isinstance(self._phantom, MovingPhantom):
                p = factor * self._phantom.line_integrals(origin, target, cells.time_s[members])
            else:
                p = factor * self._phantom.line_integrals(origin, target)
            by_line[start:stop] = average(p, cells.weight[members], model)
        return frame.astype(np.float32)


class PixelAreaSource(FrameSource):
    """Averages each pixel over its area: over ``samples`` × ``samples`` pixels of the finer panel of source ``finer``."""

    def __init__(self, finer: FrameSource, samples: int) -> None:
        self._finer, self._samples = finer, samples
        self.pixel_samples = samples

    def frames(self, tables: Sequence[TimeCells], model: str, factor: float) -> Iterator[np.ndarray]:
        fine = self._finer.frames([cells.finer(self._samples, self._samples) for cells in tables], model, factor)
        return (self._averaged(frame, model) for frame in fine)

    def _averaged(self, fine: np.ndarray, model: str) -> np.ndarray:
        n = self._samples
        rows, columns = fine.shape[0] // n, fine.shape[1] // n
        rays = fine.reshape(rows, n, columns, n).transpose(1, 3, 0, 2).reshape(n * n, rows, columns)
        return average(rays, np.full(n * n, 1 / n**2), model).astype(np.float32)


def line_groups(cells: TimeCells) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yields (first line, line after the last, indices of cells) for each run of lines that share the same time cells."""
    ranges = np.stack([cells.line_start, cells.line_stop], -1)
    for start, stop in np.unique(ranges, axis=0):
        yield int(start), int(stop), np.flatnonzero((ranges == (start, stop)).all(axis=1))


def on_panel(geometry: Geometry, grid: Grid, pixel_samples: int, make: Callable[[Geometry], FrameSource]) -> FrameSource:
    """Returns the source that ``make`` builds for the panel. With several samples per pixel it averages a finer panel.

    pixel_samples: samples along each side of a pixel, at most 32. 0 takes one sample where a pixel's image at the axis is at
    most ``WIDEST_RAY`` voxels of the grid wide, else one sample per voxel: rays through the middles of wide pixels would
    miss parts of the object. Raises InputError for a number out of range."""
    checks.within("--pixel-samples", pixel_samples, 0, _MOST_SAMPLES)
    if pixel_samples == 0:
        voxels = max(geometry.pixel_size_mm) / geometry.magnification / min(grid.voxel_size_mm)
        pixel_samples = 1 if voxels <= WIDEST_RAY else min(math.ceil(voxels - 1e-6), _MOST_SAMPLES)
    if pixel_samples == 1:
        return make(geometry)
    return PixelAreaSource(make(geometry.finer(pixel_samples)), pixel_samples)


class DeformedSource(FrameSource):
    """Projects a deforming volume (nz, ny, nx) in 1/mm on ``grid``.

    A state of the object is a set of the fields' weights φ_r, for which the volume is deformed once. Weights are rounded, so
    that many time cells, also of other frames, share a state. The rounding moves no point by more than ``NEAREST`` ·
    ``voxel_mm``. Weights of a frame at a single time are not rounded. make: returns the source of a volume at rest."""

    def __init__(
        self, rt: Runtime, volume: np.ndarray, grid: Grid, deformation: Deformation, voxel_mm: float,
        make: Callable[[np.ndarray], FrameSource],
    ) -> None:  # fmt: skip
        self._rt, self._volume, self._grid, self._deformation = rt, volume, grid, deformation
        reach_mm = np.maximum(deformation.reach_mm, np.finfo(float).tiny)
        self._step = 2 * NEAREST * voxel_mm / (deformation.rank * reach_mm)
        self._make = make

    def frames(self, tables: Sequence[TimeCells], model: str, factor: float) -> Iterator[np.ndarray]:
        weights = [self._rounded_weights(cells) for cells in tables]
        states, state_of_cell = np.unique(np.concatenate(weights), axis=0, return_inverse=True)
        volume_of = self._volumes(states)
        by_table = np.split(state_of_cell.ravel(), np.cumsum([cells.count for cells in tables])[:-1])
        sums = [_Average(cells, model) for cells in tables]
        for number in range(len(states)):
            numbers = [k for k, of_cell in enumerate(by_table) if (of_cell == number).any()]
            parts = [part_of(tables[k], by_table[k] == number) for k in numbers]
            source = self._make(volume_of(number))
            frames = source.frames([part for part, _ in parts], model, factor)
            for k, frame, (_, share) in zip(numbers, frames, parts, strict=True):
                sums[k].add(frame, share)
        return (each.frame() for each in sums)

    def _volumes(self, weights: np.ndarray) -> Callable[[int], np.ndarray]:
        """Returns a function from a state's index to its volume (nz, ny, nx), for ``weights`` (K, R). The device deforms the
        volumes if all buffers fit into half of ``Runtime.room``, else the host."""
        volume, rank = self._volume, self._deformation.rank
        if not self._rt.room().scaled(0.5).holds(3 * rank * volume.nbytes, *[2 * volume.nbytes] * 2):
            spline = SplineVolume(volume, self._grid)
            return lambda k: spline.deformed(self._deformation, weights[k])
        fields_mm = unit_fields_mm(self._deformation, self._grid)
        warp = VolumeWarp(self._rt, MotionStates(self._deformation, self._grid, fields_mm, weights, np.eye(rank)))
        source, least = warp.source(self._rt.upload(volume)), min(float(volume.min()), 0.0)
        return lambda k: volume if warp.is_still(k) else np.maximum(self._rt.download(warp.forward(k, source)), least)

    def _rounded_weights(self, cells: TimeCells) -> np.ndarray:
        """Returns the weights (C, R) at the cells' times, rounded unless they are the same in all cells."""
        weights = self._deformation.weights_at(cells.time_s)
        return np.round(weights / self._step) * self._step if np.ptp(weights, axis=0).any() else weights


class _Average:
    """Averages a frame from partial frames, each of which is projected from some of the frame's time cells."""

    def __init__(self, cells: TimeCells, model: str) -> None:
        self._readout, self._is_log = cells.readout, model == "log"
        # So far: Σ w p in the log model, ln Σ w exp(−p) in the intensity model.
        self._sum = np.array(0.0 if self._is_log else -np.inf)

    def add(self, frame: np.ndarray, share: np.ndarray) -> None:
        """Adds line integrals (rows, columns) of some time cells. share (lines,): their part of each line's weight."""
        weight = self._readout.spread(share)
        if self._is_log:
            self._sum = weight * frame + self._sum
            return
        with np.errstate(divide="ignore"):  # lines without light from these cells have the weight 0, and its logarithm is −∞
            self._sum = np.logaddexp(self._sum, np.log(weight) - frame)

    def frame(self) -> np.ndarray:
        """Returns the average (rows, columns), 0 on lines without light."""
        mean = self._sum if self._is_log else np.where(np.isfinite(self._sum), -self._sum, 0)
        return mean.astype(np.float32)


def part_of(cells: TimeCells, members: np.ndarray) -> tuple[TimeCells, np.ndarray]:
    """Returns a table of the cells ``members``, bool (C,), and the fraction (lines,) of each line's weight in these cells.

    Weights are rescaled: in the new table a line's weights sum to 1, or are all 0. Each cell must have a single pose."""
    part = some_cells(cells, np.flatnonzero(members))
    share = part.line_weights()
    factors = np.divide(1.0, share, out=np.zeros_like(share), where=share > 0)
    shares = np.ones((part.count, cells.lines)) if part.line_share is None else part.line_share
    return replace(part, line_share=shares * factors), share
