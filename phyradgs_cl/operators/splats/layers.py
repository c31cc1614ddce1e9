"""The cells of a frame in layers, one cell per line and layer, and the intensity model that merges them.

A detector adds photons: the merged frame is −ln Σ w_k exp(−p_k) over the cells k of a line. Projectors draw w_k p_k into
the k-th layer; merging also keeps the derivative by every layer, which is what the adjoint needs.
"""

import numpy as np

from phyradgs_cl.operators.splats.layout import DeviceCells
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime
from phyradgs_cl.runtime.layout import GUARD, padded_zeros, pitch_of


class Layers:
    """Layers of frames of ``lines`` by ``width`` pixels; ``unit`` is the line integral that is 1 in them."""

    def __init__(self, rt: Runtime, lines: int, width: int, unit: float) -> None:
        self.rt, self.lines, self.width, self.unit = rt, lines, width, unit
        self._count = 0
        self._merge = rt.kernel("intensity", "intensity_merge", IMAGE_GUARD=GUARD)
        self._split = rt.kernel("intensity", "intensity_split", IMAGE_GUARD=GUARD)

    def images(self, cells: DeviceCells) -> DeviceArray:
        """Memory for the layers of ``cells``: images of GUARD floats and (lines, pitch)."""
        if cells.layers > self._count:
            self._count = cells.layers
            self._drawn, self._shares, self._by_layers = (
                padded_zeros(self.rt, self.lines, self.width, self._count) for _ in range(3)
            )
        floats = cells.layers * (GUARD + self.lines * pitch_of(self.width)) + GUARD
        return DeviceArray(self._drawn.buffer, (floats,), self._drawn.dtype)

    def merge(self, cells: DeviceCells, merged: DeviceArray) -> None:
        """Writes −ln Σ w exp(−p) of the layers that were drawn last into ``merged``."""
        self._launch(
            self._merge,
            (self._drawn, cells.layer_weights),
            cells,
            (np.float32(self.unit), self._shares, merged),
        )

    def split(self, cells: DeviceCells, by_merged: DeviceArray) -> DeviceArray:
        """dL/dlayers of the last ``merge`` from dL/dmerged; valid until the next call."""
        self._launch(self._split, (by_merged, self._shares), cells, (self._by_layers,))
        return self._by_layers

    def _launch(
        self, kernel: Kernel, inputs: tuple[object, ...], cells: DeviceCells, rest: tuple[object, ...]
    ) -> None:
        rt = self.rt
        sizes = (np.int32(n) for n in (cells.layers, self.lines, self.width, pitch_of(self.width)))
        rt.launch(kernel, (-(-self.width // rt.lanes), self.lines), *inputs, *sizes, *rest, group=rt.group())
