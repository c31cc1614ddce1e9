"""The intensity model around one volume: I(x) = −ln Σ w exp(−A_k x), its derivative J and Jᵀ, exactly.

A line's cells are numbered, and A_k is the projector of everyone's k-th cell. Then J = Σ_k s_k A_k with the softmax weight
s_k = w_k exp(−p_k) / Σ_j w_j exp(−p_j) of every pixel, and Jᵀ y = Σ_k A_kᵀ (s_k y): launches of the linear projector, one
per cell of a line, that cost together what one launch over all cells does. Twin: ``intensity_frame`` in twins/rays.py.
"""

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector import intensity_average
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.layout import layered
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.runtime import Array, DeviceArray, DeviceSpace, HostSpace, Runtime, SameArray, Space

_HOST = HostSpace()


class IntensityOperator:
    """I(x), and J and Jᵀ at the volume for which I was asked last (A and Aᵀ before that).

    Arguments as for ``RayOperator``, whose rule for NumPy's and device arrays holds here too. It holds frames (F, rows,
    columns) once for every cell of a line, which is what the softmax weights need.
    """

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells]
    ) -> None:
        ones, weights = layered(tables)
        self.volume_shape = grid.shape
        self.frames_shape = (len(tables), *detector_shape)
        self._operators: list[RayOperator] = []
        # one memory for all: they are used in turns; that of the operator over all cells has room for each
        memory = RayOperator(rt, grid, detector_shape, tables).memory
        for part in ones:
            self._operators.append(RayOperator(rt, grid, detector_shape, part, memory=memory))
        self._by_row = tables[0].axis == "rows"
        self._device = DeviceSpace(rt)
        self._shares: list[Any] = []
        self._set(weights)

    @property
    def memory(self) -> RayMemory:
        """That of all my projectors."""
        return self._operators[0].memory

    @property
    def holds(self) -> tuple[int, int]:
        """Volumes and stacks of frames that I take on a device beside ``memory``: p and share of every cell of a line."""
        return 2, 2 * len(self._operators) + 3

    def expected(self, volume: SameArray, out: SameArray | None = None) -> SameArray:
        """I(x) (F, rows, columns) float32 of a volume (nz, ny, nx) 1/mm, at which J stands from now on."""
        self._shares = []  # their memory is wanted again
        frames: Array
        if isinstance(volume, DeviceArray):
            p = [self._device.apply(operator.forward, volume, self.frames_shape) for operator in self._operators]
            frames, self._shares = self._device_average(p)
        else:
            averaged, shares = intensity_average(
                [operator.forward(volume) for operator in self._operators], self._weights
            )
            frames = averaged.astype(np.float32)
            self._shares = [share.astype(np.float32) for share in shares]
        same: SameArray = self._given(frames, out)
        return same

    def forward(self, volume: SameArray, out: SameArray | None = None) -> SameArray:
        """J d: a change of the volume (nz, ny, nx) to that of the frames (F, rows, columns) float32."""
        space = self._space(volume)
        total: Any = None
        for share, operator in zip(self._shares_for(volume), self._operators, strict=True):
            part = space.apply(operator.forward, volume, self.frames_shape)
            total = space.multiply(part, share) if total is None else space.add_product(total, part, share)
        same: SameArray = self._given(total, out)
        return same

    def adjoint(self, frames: SameArray, out: SameArray | None = None) -> SameArray:
        """Jᵀ y: frames (F, rows, columns) to a volume (nz, ny, nx) float32."""
        space = self._space(frames)
        total: Any = None
        for share, operator in zip(self._shares_for(frames), self._operators, strict=True):
            part = space.apply(operator.adjoint, space.multiply(frames, share), self.volume_shape)
            total = part if total is None else space.add(total, part)
        same: SameArray = self._given(total, out)
        return same

    def subset(self, frames: Sequence[int]) -> "IntensityOperator":
        """The same for some of the frames, in this order, with a volume of its own for J."""
        chosen = list(frames)
        part = copy(self)
        part.frames_shape = (len(chosen), *self.frames_shape[1:])
        part._operators = [operator.subset(chosen) for operator in self._operators]
        part._set([weight[chosen] for weight in self._weights])
        return part

    def _set(self, weights: list[np.ndarray]) -> None:
        """Weights (F, lines, 1) or (F, 1, lines) of each layer; shares are those of a volume of zeros."""
        self._weights = weights
        self._line_weights: list[DeviceArray] = []
        self._shares = []

    def _space(self, like: Array) -> Space[Any]:
        return self._device if isinstance(like, DeviceArray) else _HOST

    def _given(self, result: Any, out: SameArray | None) -> SameArray:
        """The result, in ``out`` if there is one."""
        if out is None:
            new: SameArray = result
            return new
        if isinstance(out, DeviceArray):
            self._device.rt.copy(result, out)
        else:
            out[...] = result
        return out

    def _shares_for(self, like: Array) -> list[Any]:
        is_there = isinstance(like, DeviceArray)
        if self._shares and isinstance(self._shares[0], DeviceArray) != is_there:  # ``expected`` had the other kind
            brought = self._device.array if is_there else self._device.numpy
            self._shares = [brought(share) for share in self._shares]
        if not self._shares and is_there:
            spread = [self._device.empty(self.frames_shape) for _ in self._operators]
            for weights, share in zip(self._uploaded(), spread, strict=True):
                self._launch("layer_weights", weights, share)
            self._shares = spread
        return self._shares or self._weights

    def _device_average(self, p: list[DeviceArray]) -> tuple[DeviceArray, list[DeviceArray]]:
        """``intensity_average`` of frames on the device, whose memory becomes that of the shares."""
        least, total = self._device.empty(self.frames_shape), self._device.empty(self.frames_shape)
        for k, (q, weights) in enumerate(zip(p, self._uploaded(), strict=True)):
            self._launch("layer_least", q, weights, least, first=k == 0)
        for k, (q, weights) in enumerate(zip(p, self._uploaded(), strict=True)):
            self._launch("layer_seen", q, weights, least, total, first=k == 0)
        rt = self._device.rt
        rt.launch(
            rt.kernel("cell_layers", "layer_average"), total.size, np.int64(total.size), least, total, group=rt.group(64)
        )
        return least, [self._device.multiply(q, total) for q in p]

    def _launch(self, name: str, *arrays: DeviceArray, first: bool | None = None) -> None:
        """A kernel over all pixels: its read-only arrays, shapes, whether it is the first layer, arrays to write."""
        frames, rows, columns = self.frames_shape
        rt, inputs = self._device.rt, 1 if first is None else 2
        words = [np.int32(n) for n in (rows, columns, self._by_row)] + ([] if first is None else [np.int32(first)])
        items = (columns, rows, frames)
        kernel = rt.kernel("cell_layers", name)
        rt.launch(kernel, items, *arrays[:inputs], *words, *arrays[inputs:], group=rt.group(on_cpu=16))

    def _uploaded(self) -> list[DeviceArray]:
        """Weights (F, lines) of each layer on the device, which keeps them."""
        if not self._line_weights:
            shape = (self.frames_shape[0], -1)
            # in place: a copy of me that stays at a volume has them too
            self._line_weights.extend(self._device.rt.upload(w.reshape(shape), np.float32) for w in self._weights)
        return self._line_weights
