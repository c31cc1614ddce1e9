"""Time cells: the poses of a frame, each with its weight and the detector lines that are projected from it.

A frame is a weighted sum of projections, one per cell. A cell adds ``weight`` times the projection from its pose to the
lines [line_start, line_stop). The weights of a line sum to 1. A *still* cell has one pose. A *moving* cell is a segment of
the frame's time, with a pose at either end. ``cells.py`` builds these tables."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition.geometry import POSE_LENGTH
from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.errors import InputError


@dataclass(frozen=True, eq=False)
class TimeCells:
    """The time cells of one frame, sorted by line_start.

    - pose (C, 12) in mm, for the detector's own rows and columns, whatever the readout axis. time_s (C,) in s. For moving
      cells, both hold in the middle of the cell's time.
    - line_start, line_stop (C,): the lines of a cell, counted along the readout ``axis``. The panel has ``lines`` lines.
      weight (C,).
    - line_share (C, lines): for still cells, a further factor of the weight: the fraction of each line's exposure that
      lies in the cell. None means 1.
    - end_poses (C, 2, 12) in mm, end_times_s (C, 2) in s: at both ends of moving cells, whose ``weight`` is 1; None for
      still cells. The times are needed if the object moves.
    - line_times (C, 3, lines): for moving cells, three numbers about the part of each line's exposure in the cell. They are
      (part's middle − cell's mid-time) / cell's length, part's half-length / cell's length, and part's length / exposure.
    - is_parallel: poses begin with the direction of parallel rays.
    - conic_pose (12,): for Gaussians only. Cells then move only the Gaussians' centres on the panel; their shapes and
      densities there are computed for this pose.

    Methods raise InputError for user-defined cells that do not fit the scan."""

    pose: np.ndarray
    time_s: np.ndarray
    line_start: np.ndarray
    line_stop: np.ndarray
    weight: "NDArray[np.float64]"
    lines: int
    axis: str = "rows"
    end_poses: np.ndarray | None = None
    line_times: "NDArray[np.float64] | None" = None
    line_share: "NDArray[np.float64] | None" = None
    is_parallel: bool = False
    conic_pose: np.ndarray | None = None
    end_times_s: np.ndarray | None = None

    @property
    def count(self) -> int:
        """The number of time cells C."""
        return len(self.weight)

    def line_weights(self) -> np.ndarray:
        """Returns the sum of each line's weights, (lines,). It is 1 if the table is complete."""
        total = np.zeros(self.lines)
        for cell, lines in enumerate(self.ranges):
            total[lines] += self.weights_of(cell)
        return total

    @property
    def ranges(self) -> list[slice]:
        """The lines that each cell serves, as slices."""
        return [slice(int(a), int(b)) for a, b in zip(self.line_start, self.line_stop, strict=True)]

    def weights_of(self, cell: int) -> np.ndarray:
        """Returns the weights (line_stop − line_start,) of cell number ``cell``, one for each line that it serves."""
        lines = slice(int(self.line_start[cell]), int(self.line_stop[cell]))
        share = self.line_share[cell, lines] if self.line_share is not None else np.ones(lines.stop - lines.start)
        if self.line_times is not None:
            share = self.line_times[cell, 2, lines]
        return np.asarray(self.weight[cell] * share)

    @property
    def readout(self) -> Readout:
        """The converter of frames and poses to the order (lines, width) in which the panel is read, and back."""
        return Readout(self.axis)

    @property
    def is_moving(self) -> bool:
        """Whether poses change within a cell. Only Gaussians can be projected over such cells."""
        return self.end_poses is not None

    @property
    def averages(self) -> bool:
        """Whether any line averages over several cells, which then belong to different layers (``layer_numbers``)."""
        return bool(self.layer_numbers.any())

    def scaled(self, factor: float) -> "TimeCells":
        """Returns the time cells with all lengths multiplied by ``factor``."""
        factors = np.full(POSE_LENGTH, factor)
        if self.is_parallel:
            factors[:3] = 1  # a parallel beam's direction is not a length, so it is not scaled
        ends, conic = (None if p is None else p * factors for p in (self.end_poses, self.conic_pose))
        return replace(self, pose=self.pose * factors, end_poses=ends, conic_pose=conic)

    def finer(self, rows: int, columns: int) -> "TimeCells":
        """Returns still cells for pixels divided into ``rows`` by ``columns``. The parts of a line keep the line's times."""
        pose, (of_line, _) = self.pose.copy(), self.readout.shape((rows, columns))
        pose[:, 6:9] /= columns
        pose[:, 9:12] /= rows
        pose[:, 3:6] -= (columns - 1) / 2 * pose[:, 6:9] + (rows - 1) / 2 * pose[:, 9:12]
        lines = {name: getattr(self, name) * of_line for name in ("line_start", "line_stop", "lines")}
        share = None if self.line_share is None else self.line_share.repeat(of_line, 1)
        return replace(self, pose=pose, line_share=share, **lines)

    def still(self) -> "TimeCells":
        """Returns the cells unchanged, for projectors of voxels. Raises InputError for moving cells and conic poses, which
        only Gaussians can use."""
        if self.is_moving:
            raise InputError("--motion", "cells with motion", "still cells: only splats move", "take --motion per-row")
        if self.conic_pose is not None:
            raise InputError("--motion", "cells with a conic pose", "none: only splats have conics", "take micro-views")
        return self

    def line_poses(self) -> np.ndarray:
        """Returns one pose per line, (lines, 12), of the cell nearest to the line's mid-exposure; (1, 12) for a single cell.

        Raises InputError for a line without a cell."""
        if self.count == 1:
            return self.pose
        lengths = self.line_stop - self.line_start
        cell = np.repeat(np.arange(self.count), lengths)
        line = np.arange(cell.size) + np.repeat(self.line_start - (np.cumsum(lengths) - lengths), lengths)
        order = np.lexsort((self.time_s[cell], line))
        cell, line = cell[order], line[order]
        weight = self.weight[cell] * (1 if self.line_share is None else self.line_share[cell, line])
        total = np.bincount(line, weight, self.lines)
        past = np.cumsum(weight) - weight / 2 - (np.cumsum(total) - total)[line]
        nearest = np.lexsort((np.abs(past - total[line] / 2), line))
        served, first = np.unique(line[nearest], return_index=True)
        if served.size < self.lines:
            raise InputError("--motion", "a line without a time cell", "weights of every line that sum to 1")
        return self.pose[cell[nearest[first]]]

    def line_cells(self) -> np.ndarray:
        """Returns a range [first, stop) of cells for each line, (lines, 2). The range has all cells that serve the line, and
        maybe others."""
        line = np.arange(self.lines)
        first = np.searchsorted(np.maximum.accumulate(self.line_stop), line, side="right")
        return np.stack([first, np.searchsorted(self.line_start, line, side="right")], -1)

    @cached_property
    def layer_numbers(self) -> np.ndarray:
        """The layer of each cell, a number (C,) from 0 on. Cells of a layer share no line; layers are as few as possible.

        To average intensities, a frame's layers are projected one by one."""
        numbers = np.zeros(self.count, np.int64)
        free_from: list[int] = []
        for cell, (start, stop) in enumerate(zip(self.line_start, self.line_stop, strict=True)):
            layer = next((k for k, line in enumerate(free_from) if line <= start), len(free_from))
            if layer == len(free_from):
                free_from.append(0)
            numbers[cell] = layer
            free_from[layer] = int(stop)
        return numbers

    @cached_property
    def layer_weights(self) -> np.ndarray:
        """For each layer and line, (layers, lines): the weight of the layer's cell that serves the line; 0 without one."""
        weights = np.zeros((int(self.layer_numbers.max(initial=-1)) + 1, self.lines))
        for cell, lines in enumerate(self.ranges):
            weights[self.layer_numbers[cell], lines] = self.weights_of(cell)
        return weights
