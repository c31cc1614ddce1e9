"""Gaussians of an object that moves: from the reference to the object's states at other times, and gradients back
(cl/splat_states.cl).

In a state the object has at point y the attenuation that the reference has at y + w(y). So a Gaussian at m in the reference
is at the y with y + w(y) = m. Its covariance is G⁻¹ Σ G⁻ᵀ with G = I + ∂w/∂y. Its density stays: the field moves
attenuation, not mass."""

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.operators.splats.layout import DeviceCells, DeviceGaussians, stride_of
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime

STATE_ROWS = 12  # numbers of a Gaussian in a state: its centre x, y, z, and the 3 × 3 matrix that deforms its shape
_PROBED_SIDE = 9  # number of points along each axis of the grid at which the inverse of a field is checked
_PROBED_STATES = 16  # number of evenly spread times at which a field's inverse is checked, besides those of most motion
_WRONG = 0.01  # largest accepted error of a field's inverse, in voxels
_BEND = 0.25  # largest deviation in voxels of a point's path in a segment from a straight line; its RMS is 0.3 times this
_MOST_SEGMENTS = 32  # most segments of a frame, even if paths then deviate by more than _BEND


class CloudStates:
    """Moves Gaussians by ``deformation`` to their states at a frame's times. Both have the same unit of length."""

    def __init__(self, rt: Runtime, deformation: Deformation) -> None:
        self.rt, self.deformation = rt, deformation
        control = np.pad(deformation.control_mm, [(0, 0)] * 4 + [(0, 1)])
        spacing = np.broadcast_to(deformation.spacing_mm, 3)
        self._field = (
            rt.upload(control, np.float32), np.array([*control.shape[3:0:-1], 0], np.int32),
            np.array([*deformation.origin_mm, 0], np.float32), np.array([*1 / spacing, 0], np.float32),
        )  # fmt: skip
        self._states, self._by_states = rt.empty(1), rt.empty(1)

    def forward(self, gaussians: DeviceGaussians, shares: DeviceArray) -> DeviceArray:
        """Returns the Gaussians in S states, (S, 12, stride). The memory is valid until the next call. shares (S, R): the
        weights of the R displacement fields in each state."""
        rt, count, stride = self.rt, shares.shape[0], gaussians.stride
        if self._states.size < count * STATE_ROWS * stride:
            self._states = rt.empty(1)  # frees the old memory now, so that the device need not hold both
            self._states = rt.empty((count, STATE_ROWS, stride))
        kernel, field = self._kernel("splat_states"), (*self._field, shares, np.int32(count))
        rt.launch(kernel, stride, gaussians.rows, stride, *field, self._states, group=rt.group(on_cpu=16))
        return self._states

    def zeros(self, gaussians: DeviceGaussians, cells: DeviceCells) -> DeviceArray:
        """Returns zeros (S, 12, stride) for dL/d(states). The memory is valid until the next call."""
        floats = cells.shares.shape[0] * STATE_ROWS * gaussians.stride
        if self._by_states.size < floats:
            self._by_states = self.rt.empty(1)
            self._by_states = self.rt.empty(floats)
        self.rt.fill(self._by_states, 0)
        return self._by_states

    def back(self, gaussians: DeviceGaussians, cells: DeviceCells, gradients: DeviceArray) -> None:
        """Replaces dL/d(mean) in ``gradients`` (13, stride) by dL/d(mean in the reference). Reads dL/d(states) from the
        memory of ``zeros``. The last ``forward`` must be for the same Gaussians and cells."""
        rt, count = self.rt, cells.shares.shape[0]
        kernel, field = self._kernel("splat_states_back"), (*self._field, cells.shares, np.int32(count))
        rt.launch(
            kernel, gaussians.stride, self._states, gaussians.stride, *field, self._by_states, gradients,
            group=rt.group(on_cpu=16),
        )  # fmt: skip

    def check_inverse(self, grid: Grid) -> None:
        """Raises InputError if the displacement field has no inverse. Tests whether some points of ``grid``, moved to some
        states and back, return to where they were."""
        rt, (z, y, x) = self.rt, (np.linspace(axis[0], axis[-1], _PROBED_SIDE) for axis in grid.axes_mm())
        mean = np.stack(np.meshgrid(x, y, z, indexing="ij")).reshape(3, -1)
        rows = np.ones((11, mean.shape[1]))
        rows[:3] = mean
        # The inverse is tested in the states in which each field moves most, and in some spread evenly over the times.
        ends = np.concatenate([self.deformation.weights.argmax(0), self.deformation.weights.argmin(0)])
        chosen = np.linspace(0, len(self.deformation.times_s) - 1, _PROBED_STATES).astype(int)
        weights = self.deformation.weights[np.unique([*ends, *chosen])]
        moved = rt.download(self.forward(DeviceGaussians.upload(rt, rows), rt.upload(weights, np.float32)))
        moved = moved.ravel()[: len(weights) * STATE_ROWS * stride_of(rows.shape[1])].reshape(len(weights), STATE_ROWS, -1)
        places = moved[:, :3, : rows.shape[1]].astype(np.float64)
        for place, one in zip(places, weights, strict=True):
            off = place.T + self.deformation.displacement_mm(place.T, one) - mean.T
            if not (worst := float(np.abs(off / grid.voxel_size_mm[::-1]).max())) <= _WRONG:
                found = f"a field without an inverse: it is wrong by {worst:.2g} voxels"
                raise InputError("--object-motion", found, f"at most {_WRONG:g}", "use a smoother or smaller field")

    def _kernel(self, name: str) -> Kernel:
        return self.rt.kernel("splat_states", name, RANK=self.deformation.rank)


def segments_for_object(deformation: Deformation, lit_s: np.ndarray, voxel_mm: float) -> int:
    """Returns how many segments of time, up to ``_MOST_SEGMENTS``, a frame needs that is exposed from lit_s[0] to lit_s[1].

    Splats move straight in a segment. So in a segment no point of the object may leave a straight path by over 1/4 voxel."""
    for count in range(1, _MOST_SEGMENTS):
        weights = deformation.weights_at(np.linspace(lit_s[0], lit_s[1], 2 * count + 1))
        bend_mm = np.abs(weights[1::2] - (weights[:-1:2] + weights[2::2]) / 2) @ deformation.reach_mm
        if bend_mm.max() <= _BEND * voxel_mm:
            return count
    return _MOST_SEGMENTS


def states_of(table: TimeCells, deformation: Deformation) -> tuple[np.ndarray, np.ndarray]:
    """Returns the field weights (S, R) of the object's states at the times of a frame's cells, and which state each pose
    has, (C, poses). Raises InputError for cells in which splats keep their shape (``conic_pose``), and for moving cells
    without the times of their ends."""
    if table.conic_pose is not None:
        expected = "one in which also the shapes of splats move"
        raise InputError("--object-motion", "--motion centres", expected, "take exact or micro-views")
    times_s = table.time_s[:, None]
    if table.is_moving:
        if table.end_times_s is None:
            raise InputError("--object-motion", "cells with motion without end_times_s", "the times of both ends")
        times_s = np.concatenate([times_s, table.end_times_s], axis=1)
    distinct_s, places = np.unique(times_s, return_inverse=True)
    return deformation.weights_at(distinct_s), places.reshape(times_s.shape)
