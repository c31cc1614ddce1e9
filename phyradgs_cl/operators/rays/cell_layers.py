"""The cells of frames in layers of one cell per line, and what a detector that adds photons makes of them, on the host."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector import intensity_average


def layers(table: TimeCells) -> list[TimeCells]:
    """The cells of a frame in tables in which no line has more than one; cells sorted by line stay so."""
    numbers = table.layer_numbers
    return [_some(table, np.flatnonzero(numbers == k)) for k in range(int(numbers.max()) + 1)]


def layered(tables: Sequence[TimeCells]) -> tuple[list[list[TimeCells]], list[np.ndarray]]:
    """Of many frames (F tables): the tables of each layer with weights of 1, and the cells' own weights.

    Weights are float32, (F, lines, 1) or (F, 1, lines) by the readout's axis, 0 where a layer has no cell of a line.
    """
    split = [layers(table) for table in tables]
    ones, weights = [], []
    for k in range(max(len(parts) for parts in split)):
        parts = [p[k] if k < len(p) else _empty(p[0]) for p in split]
        weight = np.stack([part.line_weights() for part in parts]).astype(np.float32)
        weights.append(tables[0].readout.spread(weight))
        ones.append([replace(part, weight=np.ones(part.count), line_share=None) for part in parts])
    return ones, weights


def averaged(integrals: Sequence[np.ndarray], weights: Sequence[np.ndarray], average: str) -> np.ndarray:
    """Frames (F, rows, columns) float32 from line integrals p of each layer (the same) and weights as of ``layered``.

    ``intensity``: −ln Σ w exp(−p); ``gap``: what Σ w p is more than that. Lines without cells are 0. The twin of what
    cl/rays.cl does where a line's cells are at hand together; weights of a line sum to 1.
    """
    sums = np.sum(weights, axis=0, dtype=np.float64)  # 1 but for float32's rounding, which a small gap would show
    exact = [np.divide(w, sums, out=np.zeros_like(sums), where=sums > 0) for w in weights]
    frames, _ = intensity_average(integrals, exact)
    if average == "gap":
        frames = np.add.reduce([w * (p - frames) for p, w in zip(integrals, exact, strict=True)])
    return frames.astype(np.float32)


def _some(table: TimeCells, cells: Sequence[int] | np.ndarray) -> TimeCells:
    names = ["pose", "time_s", "line_start", "line_stop", "weight"]
    names += [] if table.line_share is None else ["line_share"]
    return replace(table, **{name: getattr(table, name)[cells] for name in names})


def _empty(table: TimeCells) -> TimeCells:
    """A table of a frame without cells: one that serves no line, because a table must not be empty."""
    one = _some(table, [0])
    return replace(one, line_stop=one.line_start.copy(), weight=np.zeros(1))
