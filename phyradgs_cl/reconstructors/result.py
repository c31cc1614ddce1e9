"""What every method returns, and how it reports on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from phyradgs_cl.fields import Gaussians, Grid


@dataclass(frozen=True, eq=False)
class SplatState:
    """An interrupted splatting run: raw (11, G), moments (2, 11, G), statistics (2, G) float32, and where it was."""

    raw: np.ndarray
    moments: np.ndarray
    statistics: np.ndarray
    iteration: int
    queue: list[int]
    rng: str


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume (nz, ny, nx) float32 in 1/mm on ``grid``.

    gaussians: the cloud in mm, for methods that have one; record: the convergence record, one dict a report;
    facts: what is needed to make it again (method, options, scales, seconds); state: how to go on, where a run
    was interrupted.
    """

    volume: np.ndarray
    grid: Grid
    gaussians: Gaussians | None = None
    record: list[dict[str, float]] = field(default_factory=list)
    facts: dict[str, object] = field(default_factory=dict)
    state: SplatState | None = None


@dataclass(frozen=True)
class Progress:
    """One report of a running method."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int
    seconds: float


ProgressReport = Callable[[Progress], None]


def ignore_progress(progress: Progress) -> None:
    """The default report: none."""
