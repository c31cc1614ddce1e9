"""Scenes: an object that may move, ready to be projected, with the grid to reconstruct on and the true volume."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, deformed, triple
from phyradgs_cl.io import Volume
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.phantoms import EllipsoidPhantom, MovingPhantom, make_phantom
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation.sources import AnalyticSource, DeformedSource, FrameSource, VolumeSource, on_panel

_DENSE = 0.5  # in a beam of many energies, voxels above this fraction of the largest attenuation may be bone
# Bone begins at a bin of the histogram of attenuation with fewer voxels than this times the fullest bin's, so that bone's
# limit cuts no material in two.
_RARE = 0.2
log = logging.getLogger(__name__)
Moves = Callable[[Grid], Deformation]
"""A function from the object's box to its deformation."""


@dataclass(frozen=True, eq=False)
class Scene:
    """An object to scan: source of its frames, grid to reconstruct on, and true volume ``reference`` (nz, ny, nx) in 1/mm.

    - source_shape: voxels (z, y, x) of the user's volume that frames are projected from; None for a phantom. bone: makes the
      source of frames of the object's dense part alone.
    - deformation: how the object moves. state: returns the true volume of a moving object at a time in s.
    - period_s: the period of a phantom whose parts move by themselves.
    - fastest_mm_per_s: a bound on the speed of every part."""

    source: FrameSource
    grid: Grid
    reference: np.ndarray
    title: str
    source_shape: tuple[int, int, int] | None = None
    bone: Callable[[], FrameSource] | None = None
    deformation: Deformation | None = None
    state: Callable[[float], np.ndarray] | None = None
    period_s: float | None = None
    fastest_mm_per_s: float = 0.0

    def warn_of_inverse_crime(self) -> None:
        """Warns if along no axis the projected voxels are finer than the grid's: reconstructions then look too good."""
        shape = self.source_shape
        if shape is None or any(n > m for n, m in zip(shape, self.grid.shape, strict=True)):
            return
        text = "%s: %s voxels are projected and a grid of %s is to be reconstructed: discretisation errors will not show "
        text += "(inverse crime); take a smaller --size or a finer volume"
        log.warning(text, self.title, *("×".join(map(str, counts)) for counts in (shape, self.grid.shape)))


def phantom_scene(
    rt: Runtime, of: str | EllipsoidPhantom | MovingPhantom, geometry: Geometry, box: Grid, size: int, axis: str,
    seed: int, pixel_samples: int = 0, moves: Moves | None = None
) -> Scene:
    """Returns the scene of a phantom, given as an object or by name, in the scanner's box, with ``size`` voxels per side.

    Phantoms in closed form are integrated exactly unless they deform. Other phantoms are projected from voxels at twice
    ``size``, and the reference is their block mean. Pixels average ``pixel_samples``² rays over their area; 0 chooses the
    number by the size of the grid's voxels. axis: the panel's readout axis. moves: returns the deformation, if any. The
    reference of a phantom whose parts move is the state at time 0."""
    half_size_mm = min(box.size_mm) / 2
    phantom = make_phantom(of, half_size_mm, 2 * size, seed) if isinstance(of, str) else of
    if isinstance(phantom, MovingPhantom) and moves is not None:
        raise InputError("--motion-of-object", f"given for the phantom {phantom.name}", "an object that rests by itself")
    if isinstance(phantom, EllipsoidPhantom | MovingPhantom):
        grid, title, at = _resized(box, size), f"phantom {phantom.name}", getattr(phantom, "at", lambda time_s: phantom)
        deformation = None if moves is None else moves(grid)
        if deformation is not None and not deformation.is_still:
            fine = grid.finer(2)
            moving = rt, phantom.voxelise(fine, 4), fine, grid, title, deformation
            return _voxel_scene(*moving, geometry, axis, pixel_samples)
        return Scene(
            on_panel(geometry, grid, pixel_samples, lambda panel: AnalyticSource(phantom, panel)), grid,
            phantom.voxelise(grid, 4), title, deformation=deformation, state=lambda time_s: at(time_s).voxelise(grid, 4),
            period_s=getattr(phantom, "period_s", None), fastest_mm_per_s=getattr(phantom, "fastest_mm_per_s", 0.0),
        )
    fine = Grid.cube(2 * size, 2 * half_size_mm)
    if not (np.allclose(box.size_mm, fine.size_mm) and np.allclose(box.offset_mm, 0)):
        text = "phantom %s is drawn in a cube of %g mm about the axis: the shape and offset of the scanner's [volume] "
        log.warning(text + "are not used", of, 2 * half_size_mm)
    grid = Grid.cube(size, 2 * half_size_mm)
    deformation = None if moves is None else moves(grid)
    volume = phantom.voxelise(fine)
    return _voxel_scene(rt, volume, fine, grid, f"phantom {of}", deformation, geometry, axis, pixel_samples)


def volume_scene(
    rt: Runtime, loaded: Volume, name: str, geometry: Geometry, box: Grid, size: int | None, axis: str,
    pixel_samples: int = 0, moves: Moves | None = None
) -> Scene:
    """Returns the scene of a volume, called ``name``, at its own resolution, with ``pixel_samples``² rays per pixel.

    A volume with a grid keeps it, and its values are in 1/mm. A bare array is fitted into the scanner's box; its values are
    attenuation per half of the longest side. size: voxels along the reference's longest side; None: the volume's. box, axis,
    moves: as for ``phantom_scene``."""
    volume, fine = loaded.values, loaded.grid
    if fine is None:
        voxel_mm = min(side / n for side, n in zip(box.size_mm, volume.shape, strict=True))
        fine = Grid(volume.shape, (voxel_mm,) * 3, box.offset_mm)
        volume = volume / np.float32(fine.half_longest_mm)
    grid = _resized(fine, size or max(fine.shape))
    deformation = None if moves is None else moves(grid)
    scene = _voxel_scene(rt, volume, fine, grid, name, deformation, geometry, axis, pixel_samples)
    return replace(scene, source_shape=fine.shape)


def _voxel_scene(
    rt: Runtime, volume: np.ndarray, fine: Grid, grid: Grid, title: str, deformation: Deformation | None,
    geometry: Geometry, axis: str, pixel_samples: int,
) -> Scene:
    """Returns the scene of a volume (nz, ny, nx) on the grid ``fine``. The reference is its block means on ``grid``. axis,
    pixel_samples: as for ``phantom_scene``."""

    def source_of(values: np.ndarray) -> FrameSource:
        return on_panel(geometry, grid, pixel_samples, lambda panel: on_one_panel(values, panel))

    def on_one_panel(values: np.ndarray, panel: Geometry) -> FrameSource:
        memory = RayMemory(rt, RayLayout.of_scan(rt, fine, panel.detector_shape, axis), 1)

        def of_state(state: np.ndarray) -> FrameSource:
            return VolumeSource(rt, state, fine, panel, axis, memory)

        if deformation is None or deformation.is_still:
            return of_state(values)
        return DeformedSource(rt, values, fine, deformation, min(grid.voxel_size_mm), of_state)

    def bone() -> FrameSource:
        return source_of(np.where(volume >= bone_from(volume), volume, 0).astype(np.float32))

    def state(time_s: float) -> np.ndarray:
        assert deformation is not None
        return block_mean(deformed(volume, fine, deformation, deformation.weights_at(time_s)[0]), grid.shape)

    moving = None if deformation is None else state
    truth, fastest = block_mean(volume, grid.shape), 0.0 if deformation is None else deformation.fastest_mm_per_s
    source = source_of(volume)
    return Scene(
        source, grid, truth, title, bone=bone, deformation=deformation, state=moving, fastest_mm_per_s=fastest
    )


def bone_from(volume: np.ndarray) -> float:
    """Returns the attenuation in 1/mm from which voxels (nz, ny, nx) count as bone: half the largest value. If this would
    cut a material in two, returns the upper end of the material's attenuations, or infinity if they have no upper end."""
    largest = float(volume.max())
    counts, edges = np.histogram(volume, 64, (0.1 * largest, max(largest, 1e-20)))
    is_rare = (edges[1:] > _DENSE * largest) & (counts < _RARE * counts.max())
    return max(_DENSE * largest, float(edges[np.argmax(is_rare)])) if is_rare.any() else np.inf


def block_mean(volume: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Returns means, float32, of a volume (z, y, x) over the voxels of a coarser grid of ``shape`` in the same box."""
    if volume.shape == tuple(shape):
        return volume.astype(np.float32)
    from skimage.transform import resize_local_mean  # imported here because the import is slow

    mean = resize_local_mean(volume.astype(np.float32), shape, grid_mode=True, preserve_range=True)
    return mean.astype(np.float32)


def _resized(grid: Grid, count: int) -> Grid:
    if count < 1:
        raise InputError("--size", str(count), "at least 1 voxel")
    return grid.in_shape(triple(max(1, round(n * count / max(grid.shape))) for n in grid.shape))
