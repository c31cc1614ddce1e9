"""Frames of an object that moves: every line sees it at the times at which the line is open."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import TimeCells
from phyradgs_cl.fields import Deformation, Grid, deformed
from phyradgs_cl.simulation.sources import FrameSource

NEAREST = 0.1  # of a voxel to be reconstructed: the largest distance of matter from its place


class DeformedSource(FrameSource):
    """Frames of a deforming volume (z, y, x) in 1/mm on ``grid``.

    A frame at a single time sees the object exactly then. In other frames the weights φ_r of each time cell are rounded, so
    that all cells with the same rounded weights project one deformed volume. The rounding displaces no point by more than
    ``NEAREST`` of ``voxel_mm``. ``frames`` deforms once for each state of all its frames. make: the source of a volume's
    frames."""

    def __init__(
        self, volume: np.ndarray, grid: Grid, deformation: Deformation, voxel_mm: float,
        make: Callable[[np.ndarray], FrameSource],
    ) -> None:  # fmt: skip
        self._volume, self._grid, self._deformation = volume, grid, deformation
        reach_mm = np.maximum(deformation.reach_mm, np.finfo(float).tiny)
        self._step = 2 * NEAREST * voxel_mm / (deformation.rank * reach_mm)
        self._make = make

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        return next(self.frames([cells], model, factor))

    def frames(self, tables: Sequence[TimeCells], model: str, factor: float) -> Iterator[np.ndarray]:
        weights = [self._rounded_weights(cells) for cells in tables]
        states, state_of_cell = np.unique(np.concatenate(weights), axis=0, return_inverse=True)
        by_table = np.split(state_of_cell.ravel(), np.cumsum([cells.count for cells in tables])[:-1])
        sums = [_Average(cells, model) for cells in tables]
        for number, state in enumerate(states):
            numbers = [k for k, of_cell in enumerate(by_table) if (of_cell == number).any()]
            parts = [part_of(tables[k], by_table[k] == number) for k in numbers]
            source = self._make(deformed(self._volume, self._grid, self._deformation, state))
            frames = source.frames([part for part, _ in parts], model, factor)
            for k, frame, (_, share) in zip(numbers, frames, parts, strict=True):
                sums[k].add(frame, share)
        return (each.frame() for each in sums)

    def _rounded_weights(self, cells: TimeCells) -> np.ndarray:
        """Returns the weights (C, R) of the states that the cells are projected from."""
        weights = self._deformation.weights_at(cells.time_s)
        return np.round(weights / self._step) * self._step if np.ptp(weights, axis=0).any() else weights


class _Average:
    """A frame as the average of frames of some of its time cells."""

    def __init__(self, cells: TimeCells, model: str) -> None:
        self._readout, self._is_log = cells.readout, model == "log"
        self._sum: np.ndarray | None = None  # Σ w p, or ln Σ w exp(−p)

    def add(self, frame: np.ndarray, share: np.ndarray) -> None:
        """Adds line integrals (rows, columns), with the share (lines,) of each line's weight."""
        weight = self._readout.spread(share)
        if self._is_log:
            self._sum = weight * frame + (0.0 if self._sum is None else self._sum)
            return
        with np.errstate(divide="ignore"):  # no share of a line: ln 0
            log_part = np.log(weight) - frame
        self._sum = log_part if self._sum is None else np.logaddexp(self._sum, log_part)

    def frame(self) -> np.ndarray:
        """Returns the average (rows, columns); 0 on lines without light."""
        assert self._sum is not None
        mean = self._sum if self._is_log else np.where(np.isfinite(self._sum), -self._sum, 0)
        return mean.astype(np.float32)


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
