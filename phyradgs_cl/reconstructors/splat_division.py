"""How the work of a splatting run is divided: what a division does, and the one of a process with everything to itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import voxelise
from phyradgs_cl.optim import Population, control_density
from phyradgs_cl.reconstructors.splat_objective import Corner

if TYPE_CHECKING:
    from phyradgs_cl.reconstructors.splat_run import SplatRun


@dataclass(frozen=True)
class Batch:
    """The frames of one step, where the sub-volume of each starts (none without a weight), and which terms count."""

    frames: list[int]
    corners: list[Corner]
    late: bool


class Division(Interface):
    """What depends on who has which frames and Gaussians. All ranks call the same methods in the same order."""

    keeps_frames: bool
    """Whether every rank has all measurements on its device."""

    def runs(self, gaussians: int) -> list[range]:
        """Which of all Gaussians this rank has, one cloud on the device for each run; neighbours, in their order."""
        ...

    def whole(self, columns: np.ndarray) -> np.ndarray:
        """The columns (..., own) of this rank's Gaussians to those of all."""
        ...

    def differentiate(self, run: SplatRun, batch: Batch) -> None:
        """Writes dL/draw of the batch into the run's gradients and adds to its statistics."""
        ...

    def loss(self, run: SplatRun) -> float:
        """Mean loss of the frames of the last batch."""
        ...

    def control(
        self, run: SplatRun, population: Population, statistic: np.ndarray, box: np.ndarray
    ) -> Population:
        """Density control of this rank's Gaussians, as part of the whole; those of its ``runs`` afterwards."""
        ...

    def voxelise(self, run: SplatRun, rows: np.ndarray, grid: Grid) -> np.ndarray:
        """The volume (nz, ny, nx) of all Gaussians, of which ``rows`` (11, own) are this rank's."""
        ...


class Undivided:
    """One process, one frame a step. Base of the other divisions."""

    keeps_frames = True

    def runs(self, gaussians: int) -> list[range]:
        return [range(gaussians)]

    def whole(self, columns: np.ndarray) -> np.ndarray:
        return columns

    def differentiate(self, run: SplatRun, batch: Batch) -> None:
        cloud, objective, frame = run.clouds[0], run.objective, batch.frames[0]
        cells = run.frames.cells(frame)
        rendered = objective.projector.forward(cloud.gaussians, cells)
        by_image = objective.evaluate(frame, rendered)
        objective.projector.backward(cloud.gaussians, cells, by_image, cloud.gradients)
        if batch.corners:
            volume = objective.crop.forward(cloud.gaussians, run.grid, batch.corners[0])
            objective.add_variation(cloud, objective.tv.evaluate(volume))
        objective.chain(cloud, cloud.statistics, late=batch.late)

    def loss(self, run: SplatRun) -> float:
        return run.objective.loss.value()

    def control(
        self, run: SplatRun, population: Population, statistic: np.ndarray, box: np.ndarray
    ) -> Population:
        return control_density(population, statistic, run.activation, run.options.control, box, run.rng)

    def voxelise(self, run: SplatRun, rows: np.ndarray, grid: Grid) -> np.ndarray:
        return voxelise(run.rt, rows, grid, cutoff_sigma=run.options.cutoff_sigma)
