"""Projector of a detector that averages intensities: I(x) = −ln Σ_k w_k exp(−A_k x), with its derivative J and Jᵀ.

A_k is the linear projector of the k-th time cell of every line, and p_k = A_k x. J = Σ_k s_k A_k, where a pixel's weight is
s_k = w_k exp(−p_k) / Σ_j w_j exp(−p_j), called softmax. Jᵀ y = Σ_k A_kᵀ (s_k y). The linear projector runs once per k;
together this takes as long as projecting all cells at once. Twins in twins/rays.py: ``ray_frame`` with its intensity model,
``intensity_volume``."""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, cast

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector import intensity_average
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.rays.layout import layered
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.operators.rays.subrays import SINGLE
from phyradgs_cl.runtime import Array, DeviceArray, DeviceSpace, HostSpace, Runtime, SameArray, Space

_HOST = HostSpace()


class IntensityOperator:
    """Computes frames I(x), and the derivative J and Jᵀ at the volume x last given to ``expected``. Before that x is 0,
    where J averages line integrals.

    Arguments and arrays are those of ``RayOperator``. The cells of a frame are divided into layers k in which every line has
    at most one cell. The softmax weights w_k exp(−p_k) / Σ_j w_j exp(−p_j), (F, rows, columns), are kept for each layer;
    w_k: weights of its cells, p_k = A_k x. projector: makes a layer's operator A_k."""

    def __init__(
        self, rt: Runtime, grid: Grid, detector_shape: tuple[int, int], tables: Sequence[TimeCells],
        projector: Callable[..., Any] = RayOperator, subrays: tuple[int, int] = SINGLE,
    ) -> None:  # fmt: skip
        ones, weights = layered(tables)
        self.frames_shape = (len(tables), *detector_shape)
        self._operators: list[Any] = []
        # All layers share one memory, since they run one after the other. The operator of all cells needs the most.
        memory = RayOperator(rt, grid, detector_shape, tables, subrays=subrays).memory
        for part in ones:
            self._operators.append(projector(rt, grid, detector_shape, part, memory=memory))
        self.volume_shape: tuple[int, ...] = self._operators[0].volume_shape
        self._by_row = tables[0].axis == "rows"
        self._device = DeviceSpace(rt)
        self._shares: list[Any] = []
        self._set(weights)

    @property
    def memory(self) -> RayMemory:
        """The buffers of the projectors, shared by all layers."""
        return cast(RayMemory, self._operators[0].memory)

    @property
    def holds(self) -> tuple[int, int]:
        """How many volumes and how many arrays of the frames' shape, such as each layer's line integrals and weights, the
        device holds besides ``memory``."""
        return 2, 2 * len(self._operators) + 3

    def expected(self, volume: SameArray, out: DeviceArray | None = None) -> SameArray:
        """Returns the expected measurement I(x), (F, rows, columns) float32, of a volume x (nz, ny, nx) in 1/mm. From then
        on J is the derivative at x."""
        self._shares = []  # frees the old weights' memory before new weights are computed
        frames: Array
        if isinstance(volume, DeviceArray):
            p = [operator.forward(volume, self._device.place(self.frames_shape)) for operator in self._operators]
            frames, self._shares = self._device_average(p)
        else:
            averaged, shares = intensity_average(
                [operator.forward(volume) for operator in self._operators], self._weights
            )
            frames = averaged.astype(np.float32)
            self._shares = [share.astype(np.float32) for share in shares]
        return cast(SameArray, self._given(frames, out))

    def forward(self, volume: SameArray, out: DeviceArray | None = None) -> SameArray:
        """Returns the change of the frames, J d (F, rows, columns) float32, for a change d of the volume (nz, ny, nx)."""
        space = self._space(volume)
        total: Any = None
        for share, operator in zip(self._shares_for(volume), self._operators, strict=True):
            part = operator.forward(volume, space.place(self.frames_shape))
            total = space.multiply(part, share) if total is None else space.add_product(total, part, share)
        return cast(SameArray, self._given(total, out))

    def adjoint(self, frames: SameArray, out: DeviceArray | None = None) -> SameArray:
        """Returns the transpose of ``forward``, a volume Jᵀ y (nz, ny, nx) float32, for frames y (F, rows, columns)."""
        space = self._space(frames)
        total: Any = None
        for share, operator in zip(self._shares_for(frames), self._operators, strict=True):
            part = operator.adjoint(space.multiply(frames, share), space.place(self.volume_shape))
            total = part if total is None else space.add(total, part)
        return cast(SameArray, self._given(total, out))

    def subset(self, frames: Sequence[int]) -> "IntensityOperator":
        """Returns the operator to the frames numbered ``frames``, in that order. Its J is at x = 0 until its own
        ``expected`` is called."""
        chosen = list(frames)
        part = copy(self)
        part.frames_shape = (len(chosen), *self.frames_shape[1:])
        part._operators = [operator.subset(chosen) for operator in self._operators]
        part._set([weight[chosen] for weight in self._weights])
        return part

    def _set(self, weights: list[np.ndarray]) -> None:
        """Sets the weights w_k of each layer k, (F, lines, 1) or (F, 1, lines), and J to the derivative at x = 0."""
        self._weights = weights
        self._line_weights: list[DeviceArray] = []
        self._shares = []

    def _space(self, like: Array) -> Space[Any]:
        return self._device if isinstance(like, DeviceArray) else _HOST

    def _given(self, result: Any, out: DeviceArray | None) -> Any:
        if out is not None:
            self._device.rt.copy(result, out)
        return result if out is None else out

    def _shares_for(self, like: Array) -> list[Any]:
        """Returns the softmax weights of each layer, on the device if ``like`` is there, else on the host."""
        is_there = isinstance(like, DeviceArray)
        if not self._shares and is_there:
            self._shares = [np.broadcast_to(weights, self.frames_shape) for weights in self._weights]
        # copies the weights if they are on the host and needed on the device, or the reverse
        if self._shares and isinstance(self._shares[0], DeviceArray) != is_there:
            brought = self._device.array if is_there else self._device.numpy
            self._shares = [brought(share) for share in self._shares]
        return self._shares or self._weights

    def _device_average(self, p: list[DeviceArray]) -> tuple[DeviceArray, list[DeviceArray]]:
        """Does on the device what ``intensity_average`` does on the host: returns frames (F, rows, columns) and the softmax
        weights of each layer. Overwrites the line integrals p."""
        least, total = self._device.full(self.frames_shape, np.inf), self._device.full(self.frames_shape, 0.0)
        for q, weights in zip(p, self._uploaded(), strict=True):
            self._launch("layer_least", q, weights, least)
        for q, weights in zip(p, self._uploaded(), strict=True):
            self._launch("layer_seen", q, weights, least, total)
        rt = self._device.rt
        rt.launch(
            rt.kernel("cell_layers", "layer_average"), total.size, np.int64(total.size), least, total, group=rt.group(64)
        )
        return least, [self._device.multiply(q, total) for q in p]

    def _launch(self, name: str, *arrays: DeviceArray) -> None:
        frames, rows, columns = self.frames_shape
        rt = self._device.rt
        sides = (np.int32(n) for n in (rows, columns, self._by_row))
        rt.launch(rt.kernel("cell_layers", name), (columns, rows, frames), *arrays, *sides, group=rt.group(on_cpu=16))

    def _uploaded(self) -> list[DeviceArray]:
        if not self._line_weights:
            shape = (self.frames_shape[0], -1)
            # Extends the list in place, because copies of this operator share it.
            self._line_weights.extend(self._device.rt.upload(w.reshape(shape), np.float32) for w in self._weights)
        return self._line_weights
