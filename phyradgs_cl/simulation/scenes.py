"""Scenes: a phantom or a volume on its grid, as a source of frames with the truth beside it."""

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import Volume
from phyradgs_cl.phantoms import EllipsoidPhantom, make_phantom
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation.sources import AnalyticSource, FrameSource, PixelAreaSource, VolumeSource

_DENSE = 0.5  # of the largest attenuation: from here on a voxel may be bone, in a beam of many energies
_RARE = 0.2  # of the most common attenuation's voxels: more are one material, which no threshold may divide
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is to be scanned: a source of frames, the grid asked for, and the truth on it (nz, ny, nx). source_shape:
    voxels (z, y, x) that are projected, where the source is a volume from outside. bone: the dense part of the source."""

    source: FrameSource
    grid: Grid
    reference: np.ndarray
    title: str
    source_shape: tuple[int, int, int] | None = None
    bone: Callable[[], FrameSource] | None = None

    def warn_of_inverse_crime(self) -> None:
        """Says so where the projected voxels are no finer than the grid: reconstructions there look better than they are."""
        shape = self.source_shape
        if shape is None or any(n > m for n, m in zip(shape, self.grid.shape, strict=True)):
            return
        text = "%s: %s voxels are projected and a grid of %s is to be reconstructed: discretisation errors will not show "
        told = text + "(inverse crime); take a smaller --size or a finer volume"
        log.warning(told, self.title, *("×".join(map(str, counts)) for counts in (shape, self.grid.shape)))


def phantom_scene(
    rt: Runtime,
    of: str | EllipsoidPhantom,
    geometry: ConeGeometry,
    box: Grid,
    size: int,
    axis: str,
    seed: int,
    pixel_samples: int = 1,
) -> Scene:
    """A phantom, one's own or by its name, in the scanner's box, with ``size`` voxels per side. Closed forms are integrated
    exactly; procedural phantoms are projected at twice ``size``, and the truth is their block mean. Pixels see
    ``pixel_samples``² rays over their area."""
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
    rt: Runtime,
    loaded: Volume,
    name: str,
    geometry: ConeGeometry,
    box: Grid,
    size: int | None,
    axis: str,
    pixel_samples: int = 1,
) -> Scene:
    """A volume, called ``name``, projected at its own resolution by ``pixel_samples``² rays per pixel. A bare array is
    fitted into the scanner's box, its values attenuation per half of the longest side; one with a grid keeps it and 1/mm."""
    volume, fine = loaded.values, loaded.grid
    if fine is None:
        voxel_mm = min(side / n for side, n in zip(box.size_mm, volume.shape, strict=True))
        fine = Grid(volume.shape, (voxel_mm,) * 3, box.offset_mm)
        volume = volume / np.float32(fine.half_longest_mm)
    grid = _resized(fine, size or max(fine.shape))
    source, bone = _voxel_sources(rt, volume, fine, geometry, axis, pixel_samples)
    return Scene(source, grid, block_mean(volume, grid.shape), name, fine.shape, bone)


def _voxel_sources(
    rt: Runtime, volume: np.ndarray, grid: Grid, geometry: ConeGeometry, axis: str, pixel_samples: int
) -> tuple[FrameSource, Callable[[], FrameSource]]:
    """Frames of a volume, and, made when they are asked for, of what is bone in it."""

    def of(values: np.ndarray) -> FrameSource:
        return _on_panel(geometry, pixel_samples, lambda panel: VolumeSource(rt, values, grid, panel, axis))

    return of(volume), lambda: of(np.where(volume >= bone_from(volume), volume, 0).astype(np.float32))


def bone_from(volume: np.ndarray) -> float:
    """The attenuation from which voxels (z, y, x) are bone: half the largest, or where the material ends that half would
    divide."""
    largest = float(volume.max())
    counts, edges = np.histogram(volume, 64, (0.1 * largest, max(largest, 1e-20)))
    is_rare = (edges[1:] > _DENSE * largest) & (counts < _RARE * counts.max())
    return max(_DENSE * largest, float(edges[np.argmax(is_rare)])) if is_rare.any() else np.inf


def block_mean(volume: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Means of a volume (z, y, x) over the voxels of a coarser (or equal) grid of the same box, float32."""
    if volume.shape == tuple(shape):
        return volume.astype(np.float32)
    from skimage.transform import resize_local_mean  # slow to import

    mean = resize_local_mean(volume.astype(np.float32), shape, grid_mode=True, preserve_range=True)
    return mean.astype(np.float32)


def _resized(grid: Grid, count: int) -> Grid:
    if count < 1:
        raise InputError("--size", str(count), "at least 1 voxel")
    shape = [max(1, round(n * count / max(grid.shape))) for n in grid.shape]
    voxel = [side / n for side, n in zip(grid.size_mm, shape, strict=True)]
    return Grid((shape[0], shape[1], shape[2]), (voxel[0], voxel[1], voxel[2]), grid.offset_mm)


def _on_panel(
    geometry: ConeGeometry, pixel_samples: int, make: Callable[[ConeGeometry], FrameSource]
) -> FrameSource:
    """What ``make`` gives for the panel, or for a finer one behind the area of its pixels."""
    checks.within("--pixel-samples", pixel_samples, 1, 32)
    if pixel_samples == 1:
        return make(geometry)
    return PixelAreaSource(make(geometry.finer(pixel_samples)), pixel_samples)
