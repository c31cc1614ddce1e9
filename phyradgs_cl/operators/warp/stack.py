"""The states of an object that changes, in one stack: W_k picks state k of it, in place of a warp of one volume."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.operators.warp.volume import FrameStack
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD


@dataclass(frozen=True, eq=False)
class TimeStates:
    """States of an object at times (K,) in s, rising. The state nearest in time stands for any time."""

    times_s: np.ndarray

    @property
    def count(self) -> int:
        """The number of states K."""
        return len(self.times_s)

    def shares(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the fraction of each state (T, K) at times (T,): 1 for the nearest, else 0."""
        borders_s = (self.times_s[1:] + self.times_s[:-1]) / 2
        return np.asarray(np.eye(self.count)[np.searchsorted(borders_s, times_s, "right")])


class StateStack:
    """Picks states from a stack x (K, nz, ny, nx): W_k x = x_k, with the methods of a ``VolumeWarp``."""

    volumes = 2  # most stacks x on the device

    def __init__(self, rt: Runtime, volume_shape: tuple[int, int, int], states: TimeStates) -> None:
        self.rt, self.states, self.shape = rt, states, (states.count, *volume_shape)
        self._one_shape, self._voxels = volume_shape, int(np.prod(volume_shape))
        self._one = rt.zeros(self._voxels + GUARD)
        self._total: DeviceArray | None = None
        self.stack = FrameStack(rt, rt.kernel("warp", "add_frames", RANK=1))

    def is_still(self, state: int) -> bool:
        """Returns False: every state is copied from the stack."""
        return False

    def source(self, stack: DeviceArray) -> DeviceArray:
        return stack

    def forward(self, state: int, source: DeviceArray) -> DeviceArray:
        """Returns state k (nz, ny, nx) of the stack ``source``, valid until the next call."""
        self.rt.copy(source, self._one, nbytes=4 * self._voxels, source_offset=4 * self._voxels * state)
        return self.moved()

    def moved(self) -> DeviceArray:
        """Returns memory for a volume (nz, ny, nx) of one state; zeros follow its last voxel."""
        return DeviceArray(self._one.buffer, self._one_shape, self._one.dtype)

    def zeros(self) -> DeviceArray:
        """Returns a stack (K, nz, ny, nx) of zeros, valid until the next call."""
        if self._total is None:
            self._total = self.rt.empty(self.shape)
        self.rt.fill(self._total, 0)
        return self._total

    def adjoint(self, state: int, moved: DeviceArray, total: DeviceArray) -> None:
        """Writes W_kᵀ v into state k of ``total``, which must be zero: no two parts of an operator have the same state."""
        self.rt.copy(moved, total, nbytes=4 * self._voxels, target_offset=4 * self._voxels * state)

    def read(self, total: DeviceArray, result: DeviceArray) -> None:
        """Copies the stack ``total`` to ``result``."""
        self.rt.copy(total, result)
