"""Scenes: an object as a source of frames, its grid and the truth. Sources project volumes and phantoms in closed form."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import TimeCells, pixel_centres
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.detector import average
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import Volume
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.phantoms import EllipsoidPhantom, make_phantom
from phyradgs_cl.runtime import DeviceArray, MemoryShortage, Runtime

_DENSE = 0.5  # of the largest attenuation: denser voxels may be bone in a beam of many energies
_RARE = 0.2  # of the most common attenuation's voxels: a more common one is a material that no threshold may divide
log = logging.getLogger(__name__)


class FrameSource(Protocol):
    """The interface of objects that can be projected to the frame of a cell table, attenuation multiplied by ``factor``."""

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray: ...


class VolumeSource:
    """Frames of a voxel volume (z, y, x) in 1/mm by the ray-driven projector."""

    def __init__(self, rt: Runtime, volume: np.ndarray, grid: Grid, geometry: Geometry, axis: str) -> None:
        self._rt, self._grid, self._detector_shape = rt, grid, geometry.detector_shape
        self._memory = RayMemory(rt, RayLayout.of_scan(grid, geometry.detector_shape, axis), 1)
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


class AnalyticSource:
    """Frames of a phantom with closed-form line integrals, in float64."""

    def __init__(self, phantom: EllipsoidPhantom, geometry: Geometry) -> None:
        self._phantom, self._geometry = phantom, geometry

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        frame = np.empty(self._geometry.detector_shape)
        by_row = cells.axis == "rows"
        for start, stop, members in line_groups(cells):
            pixels = pixel_centres(cells.pose[members], self._geometry.detector_shape)
            target = pixels[:, start:stop] if by_row else pixels[:, :, start:stop]
            origin = cells.pose[members][:, None, None, :3]
            if cells.is_parallel:  # from before the phantom to behind it, along the rays' direction
                along = (_reach_mm(self._phantom) + np.linalg.norm(target, axis=-1, keepdims=True)) * origin
                origin, target = target - along, target + along
            p = factor * self._phantom.line_integrals(origin, target)
            mean = average(p, cells.weight[members], model)
            frame[(slice(start, stop),) if by_row else (slice(None), slice(start, stop))] = mean
        return frame.astype(np.float32)


def _reach_mm(phantom: EllipsoidPhantom) -> float:
    """Returns the radius of a ball about the origin that holds every body of a phantom."""
    return max(float(np.linalg.norm(body.ends_mm, axis=1).max()) + body.reach_mm for body in phantom.ellipsoids)


class PixelAreaSource:
    """Frames whose pixels average over their area, from ``samples`` by ``samples`` rays of a finer panel."""

    def __init__(self, finer: FrameSource, samples: int) -> None:
        self._finer, self._samples = finer, samples

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        n = self._samples
        fine = self._finer.frame(cells.finer(n), model, factor)
        rows, columns = fine.shape[0] // n, fine.shape[1] // n
        rays = fine.reshape(rows, n, columns, n).transpose(1, 3, 0, 2).reshape(n * n, rows, columns)
        return average(rays, np.full(n * n, 1 / n**2), model).astype(np.float32)


def line_groups(cells: TimeCells) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yields (first line, line after the last, cells) for every run of lines with the same cells."""
    ranges = np.stack([cells.line_start, cells.line_stop], -1)
    for start, stop in np.unique(ranges, axis=0):
        yield int(start), int(stop), np.flatnonzero((ranges == (start, stop)).all(axis=1))


@dataclass(frozen=True, eq=False)
class Scene:
    """An object to scan: a source of frames, the grid to reconstruct, and the truth (nz, ny, nx) on it. source_shape: voxels
    (z, y, x) of a source that is a user's volume. bone: makes the source of its dense part."""

    source: FrameSource
    grid: Grid
    reference: np.ndarray
    title: str
    source_shape: tuple[int, int, int] | None = None
    bone: Callable[[], FrameSource] | None = None

    def warn_of_inverse_crime(self) -> None:
        """Warns where the projected voxels are no finer than the grid, which makes reconstructions look too good."""
        shape = self.source_shape
        if shape is None or any(n > m for n, m in zip(shape, self.grid.shape, strict=True)):
            return
        text = "%s: %s voxels are projected and a grid of %s is to be reconstructed: discretisation errors will not show "
        text += "(inverse crime); take a smaller --size or a finer volume"
        log.warning(text, self.title, *("×".join(map(str, counts)) for counts in (shape, self.grid.shape)))


def phantom_scene(
    rt: Runtime, of: str | EllipsoidPhantom, geometry: Geometry, box: Grid, size: int, axis: str,
    seed: int, pixel_samples: int = 1
) -> Scene:
    """Returns the scene of a phantom, or of one by its name, in the scanner's box, with ``size`` voxels per side.

    Closed forms are integrated exactly. Procedural phantoms are projected at twice ``size``, and the truth is their block
    mean. Pixels average ``pixel_samples``² rays over their area."""
    half_size_mm = min(box.size_mm) / 2
    phantom = make_phantom(of, half_size_mm, 2 * size, seed) if isinstance(of, str) else of
    if isinstance(phantom, EllipsoidPhantom):
        grid = _resized(box, size)
        source = _on_panel(geometry, pixel_samples, lambda panel: AnalyticSource(phantom, panel))
        return Scene(source, grid, phantom.voxelise(grid, 4), f"phantom {phantom.name}")
    fine = Grid.cube(2 * size, 2 * half_size_mm)
    if not (np.allclose(box.size_mm, fine.size_mm) and np.allclose(box.offset_mm, 0)):
        text = "phantom %s is drawn in a cube of %g mm about the axis: the shape and offset of the scanner's [volume] "
        log.warning(text + "are not used", of, 2 * half_size_mm)
    volume = phantom.voxelise(fine)
    source, bone = _voxel_sources(rt, volume, fine, geometry, axis, pixel_samples)
    truth = block_mean(volume, (size,) * 3)
    return Scene(source, Grid.cube(size, 2 * half_size_mm), truth, f"phantom {of}", bone=bone)


def volume_scene(
    rt: Runtime, loaded: Volume, name: str, geometry: Geometry, box: Grid, size: int | None, axis: str,
    pixel_samples: int = 1
) -> Scene:
    """Returns the scene of a volume, called ``name``, at its own resolution with ``pixel_samples``² rays per pixel.

    A volume with a grid keeps it and its unit 1/mm. A bare array is fitted into the scanner's box; its values are
    attenuation per half of the longest side."""
    volume, fine = loaded.values, loaded.grid
    if fine is None:
        voxel_mm = min(side / n for side, n in zip(box.size_mm, volume.shape, strict=True))
        fine = Grid(volume.shape, (voxel_mm,) * 3, box.offset_mm)
        volume = volume / np.float32(fine.half_longest_mm)
    grid = _resized(fine, size or max(fine.shape))
    source, bone = _voxel_sources(rt, volume, fine, geometry, axis, pixel_samples)
    return Scene(source, grid, block_mean(volume, grid.shape), name, fine.shape, bone)


def _voxel_sources(
    rt: Runtime, volume: np.ndarray, grid: Grid, geometry: Geometry, axis: str, pixel_samples: int
) -> tuple[FrameSource, Callable[[], FrameSource]]:
    """Returns the source of a volume's frames, and a function that makes the source of its bone."""

    def of(values: np.ndarray) -> FrameSource:
        return _on_panel(geometry, pixel_samples, lambda panel: VolumeSource(rt, values, grid, panel, axis))

    return of(volume), lambda: of(np.where(volume >= bone_from(volume), volume, 0).astype(np.float32))


def bone_from(volume: np.ndarray) -> float:
    """Returns the attenuation from which voxels (z, y, x) are bone. It is half the largest, or the end of the material that
    this value would divide."""
    largest = float(volume.max())
    counts, edges = np.histogram(volume, 64, (0.1 * largest, max(largest, 1e-20)))
    is_rare = (edges[1:] > _DENSE * largest) & (counts < _RARE * counts.max())
    return max(_DENSE * largest, float(edges[np.argmax(is_rare)])) if is_rare.any() else np.inf


def block_mean(volume: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Returns means float32 of a volume (z, y, x) over the voxels of a coarser or equal grid of the same box."""
    if volume.shape == tuple(shape):
        return volume.astype(np.float32)
    from skimage.transform import resize_local_mean  # imported here because it is slow to import

    mean = resize_local_mean(volume.astype(np.float32), shape, grid_mode=True, preserve_range=True)
    return mean.astype(np.float32)


def _resized(grid: Grid, count: int) -> Grid:
    if count < 1:
        raise InputError("--size", str(count), "at least 1 voxel")
    shape = [max(1, round(n * count / max(grid.shape))) for n in grid.shape]
    voxel = [side / n for side, n in zip(grid.size_mm, shape, strict=True)]
    return Grid((shape[0], shape[1], shape[2]), (voxel[0], voxel[1], voxel[2]), grid.offset_mm)


def _on_panel(geometry: Geometry, pixel_samples: int, make: Callable[[Geometry], FrameSource]) -> FrameSource:
    """Makes a source for the panel; with several samples per pixel for a finer panel, averaged over its pixels."""
    checks.within("--pixel-samples", pixel_samples, 1, 32)
    if pixel_samples == 1:
        return make(geometry)
    return PixelAreaSource(make(geometry.finer(pixel_samples)), pixel_samples)
