"""Frames of an object that moves: every line sees it at the times at which the line is open."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import TimeCells
from phyradgs_cl.detector.attenuation import intensity_average
from phyradgs_cl.fields import Deformation, Grid, deformed
from phyradgs_cl.simulation.sources import FrameSource

NEAREST = 0.1  # of a voxel to be reconstructed: the largest distance of matter from its place
_MOST_BYTES = 1 << 29  # of deformed volumes that are kept for later frames


class DeformedSource:
    """Frames of a deforming volume (z, y, x) in 1/mm on ``grid``.

    A frame at a single time sees the object exactly then. In other frames the weights φ_r of each time cell are rounded, so
    that all cells with the same rounded weights project one deformed volume, which later frames use again. The rounding
    displaces no point by more than ``NEAREST`` of ``voxel_mm``. make: the source of a volume's frames."""

    def __init__(
        self, volume: np.ndarray, grid: Grid, deformation: Deformation, voxel_mm: float,
        make: Callable[[np.ndarray], FrameSource],
    ) -> None:  # fmt: skip
        self._volume, self._grid, self._deformation = volume, grid, deformation
        reach_mm = np.maximum(deformation.reach_mm, np.finfo(float).tiny)
        self._step = 2 * NEAREST * voxel_mm / (deformation.rank * reach_mm)
        self._make = make
        self._sources: OrderedDict[tuple[float, ...], FrameSource] = OrderedDict()
        self._most = max(1, _MOST_BYTES // max(1, volume.nbytes))

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        weights = self._deformation.weights_at(cells.time_s)
        if np.ptp(weights, axis=0).any():
            weights = np.round(weights / self._step) * self._step
        states, state_of_cell = np.unique(weights, axis=0, return_inverse=True)
        if len(states) == 1:
            return self._source(states[0]).frame(cells, model, factor)
        frames, shares = [], []
        for number, state in enumerate(states):
            part, share = part_of(cells, state_of_cell.ravel() == number)
            frames.append(self._source(state).frame(part, model, factor))
            shares.append(cells.readout.spread(share))
        if model == "log":
            return np.sum([share * frame for share, frame in zip(shares, frames, strict=True)], axis=0).astype(np.float32)
        return intensity_average(frames, shares)[0].astype(np.float32)

    def _source(self, state: np.ndarray) -> FrameSource:
        key = tuple(state.tolist())
        if key in self._sources:
            self._sources.move_to_end(key)
            return self._sources[key]
        while len(self._sources) >= self._most:
            self._sources.popitem(last=False)
        self._sources[key] = self._make(deformed(self._volume, self._grid, self._deformation, state))
        return self._sources[key]


def part_of(cells: TimeCells, members: np.ndarray) -> tuple[TimeCells, np.ndarray]:
    """Returns the table of some still cells, bool (C,), and the part (lines,) of each line's weight that they have. The
    weights of a line in the new table sum to 1, or are 0."""
    chosen = np.flatnonzero(members)
    names = ("pose", "time_s", "line_start", "line_stop", "weight")
    part = replace(cells, **{name: getattr(cells, name)[chosen] for name in names})
    if cells.line_share is not None:
        part = replace(part, line_share=cells.line_share[chosen])
    share = part.line_weights()
    factors = np.divide(1.0, share, out=np.zeros_like(share), where=share > 0)
    shares = np.ones((part.count, cells.lines)) if part.line_share is None else part.line_share
    return replace(part, line_share=shares * factors), share
