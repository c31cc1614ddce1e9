"""FDK's backprojection of an object that moves: a voxel reads each view where its matter was at the time of the view.

This displacement is interpolated between two states of the object. S. Rit et al., Comparison of analytic and algebraic
methods for motion-compensated cone-beam CT reconstruction of the thorax, IEEE Trans. Med. Imaging 28 (2009) 1513."""

from copy import copy
from functools import lru_cache
from typing import cast

import numpy as np

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.backproject import LINE_SAMPLES, Arguments, Views, in_bricks, volume_shape
from phyradgs_cl.operators.bricks import Brick
from phyradgs_cl.operators.rays.layout import voxel_matrices
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD

_MOST_STEPS = 100  # most iterations to invert a displacement field
_PROBED = 500  # most voxels at which the inverse of a displacement field is checked
_WRONG = 0.1  # largest accepted error of the inverse of a displacement field, in voxels
_HELD_STATES = 3  # most states whose displacements are kept on the device, each in the memory of three volumes


class MovingBackprojector:
    """Backprojects the frames of an object that moves, as FDK does.

    shares (F, K): the fraction of each of K states in a frame, at most two above 0. Keeps up to nine volumes on the device.
    Calls raise InputError if a displacement field has no inverse."""

    def __init__(self, rt: Runtime, states: MotionStates, shares: np.ndarray) -> None:
        self.rt, self.states, self.shares = rt, states, shares
        self._push = lru_cache(_HELD_STATES)(self._push_of)

    def of_views(self, views: np.ndarray) -> "MovingBackprojector":
        """Returns the backprojector for only the views numbered ``views`` (n,)."""
        some = copy(self)  # both share the displacements on the device
        some.shares = self.shares[views]
        return some

    def __call__(
        self, frames: np.ndarray, pose: np.ndarray, weight: np.ndarray, grid: Grid, axis: str = "rows", *,
        is_parallel: bool = False,
    ) -> np.ndarray:  # fmt: skip
        """Returns the backprojection (nz, ny, nx) float32, as ``backproject`` does, or ``backproject_lines`` with a pose per
        line. frames (F, rows, columns), pose (F, 12) or (F, lines, 12) mm, weight (F,)."""
        volume, pairs = np.zeros(grid.shape, np.float32), _pairs(self.shares)
        for first, second in np.unique(pairs, axis=0).tolist():
            views = np.flatnonzero((pairs == (first, second)).all(1))
            weights = np.stack([weight[views], self.shares[views, second]], -1)
            volume += self._of_pair((first, second), frames[views], pose[views], weights, grid, axis, is_parallel)
        return volume

    def _of_pair(
        self, pair: tuple[int, int], frames: np.ndarray, pose: np.ndarray, weights: np.ndarray, grid: Grid, axis: str,
        is_parallel: bool,
    ) -> np.ndarray:  # fmt: skip
        """Backprojects frames between the states ``pair``. weights (F, 2): FDK's weight, and the second state's fraction."""
        rt, fields = self.rt, [self._push(state) for state in pair]
        size, by_lines = np.array([*grid.shape[::-1], 0], np.int32), pose.ndim == 3
        turned = by_lines and axis == "columns"
        if by_lines:
            pose = Readout(axis).poses(pose)
        matrices = voxel_matrices(pose.reshape(-1, 12), grid, is_parallel).reshape(len(pose), -1)
        name, group = ("backproject_lines_moving", 16) if by_lines else ("backproject_moving", 1)
        kernel = rt.kernel("backproject_moving", name, IMAGE_GUARD=GUARD)

        def launch(images: Arguments, brick: Brick, volume: DeviceArray) -> None:
            nz, ny, nx = brick.shape
            across = (np.int32(turned),) if by_lines else ()
            items = (nx if by_lines else ceil_div(nx, rt.lanes), ny, nz)
            arguments = *images, *volume_shape(brick), *across, *fields, size, volume
            samples = LINE_SAMPLES * nx * ny * nz * int(images[3])
            rt.launch(kernel, items, *arguments, group=rt.group(on_cpu=group), samples=samples)

        return cast(np.ndarray, in_bricks(rt, Views(frames, turned, matrices, weights), grid, 1, launch))

    def _push_of(self, state: int) -> DeviceArray:
        """Returns how far the matter of each voxel of the reference has moved in a state: (3, nz, ny, nx) in voxels, x, y,
        z, then GUARD zeros. Raises InputError if the field has no inverse."""
        rt, grid = self.rt, self.states.grid
        pull_mm, wide, margin = self._wide_pull_mm(state)
        spacing_mm = np.array(grid.voxel_size_mm[::-1])
        pull = rt.upload(np.pad(np.moveaxis(pull_mm / spacing_mm, -1, 0).ravel(), (0, GUARD)), np.float32)
        push = rt.zeros(3 * int(np.prod(grid.shape)) + GUARD)
        nz, ny, nx = grid.shape
        sizes = (np.array([*triple[::-1], 0], np.int32) for triple in (wide.shape, margin, grid.shape))
        kernel = rt.kernel("backproject_moving", "push_displacement", IMAGE_GUARD=GUARD)
        items = ceil_div(nx, rt.lanes), ny, nz
        rt.launch(kernel, items, pull, *sizes, _MOST_STEPS, push, group=rt.group(), samples=_MOST_STEPS * nx * ny * nz)
        self._check_inverse(state, rt.download(push)[:-GUARD].reshape(3, -1).T * spacing_mm)
        return push

    def _wide_pull_mm(self, state: int) -> tuple[np.ndarray, Grid, tuple[int, int, int]]:
        """Returns the field w (…, 3) in mm on a wider grid, which matter of the grid does not leave; the wider grid; and the
        number of voxels (z, y, x) that it has before the grid's first."""
        grid, weights = self.states.grid, self.states.weights[state]
        reach_mm = np.abs(np.tensordot(weights, self.states.fields_mm, 1)).max((0, 1, 2))[::-1]
        margin = np.ceil(1.5 * reach_mm / grid.voxel_size_mm).astype(int) + 1
        z, y, x = (int(n) for n in margin)
        nz, ny, nx = grid.shape
        wide = Grid((nz + 2 * z, ny + 2 * y, nx + 2 * x), grid.voxel_size_mm, grid.offset_mm)
        return self.states.deformation.on_grid_mm(wide, weights), wide, (z, y, x)

    def _check_inverse(self, state: int, push_mm: np.ndarray) -> None:
        """Raises InputError if the displacements push_mm (voxels, 3) do not invert the deformation at one of the voxels that
        are tested, at most 500."""
        grid = self.states.grid
        probed = np.linspace(0, len(push_mm) - 1, min(_PROBED, len(push_mm))).astype(int)
        z, y, x = (axis[i] for axis, i in zip(grid.axes_mm(), np.unravel_index(probed, grid.shape), strict=True))
        there_mm = np.stack([x, y, z], -1) + push_mm[probed]
        off_mm = push_mm[probed] + self.states.deformation.displacement_mm(there_mm, self.states.weights[state])
        if (worst := float(np.abs(off_mm / grid.voxel_size_mm[::-1]).max())) > _WRONG:
            found = f"a field without an inverse: it is wrong by {worst:.2g} voxels"
            raise InputError("--object-motion", found, f"at most {_WRONG:g}", "use a smoother or smaller field")


def _pairs(shares: np.ndarray) -> np.ndarray:
    """Returns the two states (F, 2) whose fractions in a frame, shares (F, K), are above 0. A single one is given twice."""
    largest = np.argsort(-shares, axis=1, kind="stable")
    second = largest[:, min(1, shares.shape[1] - 1)]
    has_two = shares[np.arange(len(shares)), second] > 0
    # Sorted, so that all frames between the same two states are found and backprojected together.
    return np.sort(np.stack([largest[:, 0], np.where(has_two, second, largest[:, 0])], -1), axis=1)
