"""A cloud too large for one device: Gaussians shared out by height, every rank with its own; what they draw is summed.

Line integrals and densities of parts of a cloud add up to those of the whole, so that no rank needs another's Gaussians at
the borders: every rank draws its own, the images (layers of them, where intensities are averaged, and sub-volumes) are
summed, and each goes back from the same image to its own Gaussians. The order of the Gaussians over all ranks is the one
that they would have on one. The number of parts decides about the bits; how many ranks there are does not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceGaussians, Voxeliser
from phyradgs_cl.operators.layout import pitch_of, unpad_rows
from phyradgs_cl.optim import Population, control_density
from phyradgs_cl.parallel import Communicator, exact_sum, sorted_columns, span
from phyradgs_cl.reconstructors.splat_cloud import DeviceCloud
from phyradgs_cl.reconstructors.splat_division import Batch, Undivided
from phyradgs_cl.reconstructors.splat_objective import Corner
from phyradgs_cl.runtime import DeviceArray

if TYPE_CHECKING:
    from phyradgs_cl.reconstructors.splat_run import SplatRun

_SLAB_BYTES = 1 << 26  # of voxels that are made and summed at one time
_ROWS = 11


class Domain(Undivided):
    """Every rank has some of the parts, runs of the Gaussians sorted by height, and takes part in every frame."""

    keeps_frames = False

    def __init__(self, ranks: Communicator, parts: int) -> None:
        self.ranks, self.parts = ranks, parts or ranks.size
        if self.parts < ranks.size:
            found = f"{parts} parts for {ranks.size} ranks"
            raise InputError("--parts", found, "a part for every rank", "raise it, or take fewer ranks")
        self._losses: list[float] = []

    def runs(self, gaussians: int) -> list[range]:
        return self._runs_of(gaussians, self.ranks.rank)

    def _runs_of(self, gaussians: int, rank: int) -> list[range]:
        return [span(gaussians, self.parts, part) for part in span(self.parts, self.ranks.size, rank)]

    def whole(self, columns: np.ndarray) -> np.ndarray:
        return self.ranks.gather(columns)

    def differentiate(self, run: SplatRun, batch: Batch) -> None:
        totals: list[np.ndarray] | None = None
        self._losses = []
        for place, frame in enumerate(batch.frames):
            self._differentiate_frame(run, frame, batch.corners[place] if batch.corners else None, batch.late)
            if len(batch.frames) > 1:
                self._losses.append(run.objective.loss.value())
                found = [run.rt.download(cloud.gradients) for cloud in run.clouds]
                totals = found if totals is None else [t + f for t, f in zip(totals, found, strict=True)]
        for cloud, total in zip(run.clouds, totals or [], strict=False):
            run.rt.write(cloud.gradients, total)

    def _differentiate_frame(self, run: SplatRun, frame: int, corner: Corner | None, late: bool) -> None:
        objective, projector, cells = run.objective, run.objective.projector, run.frames.cells(frame)
        self._draw(run, lambda cloud: projector.draw(cloud.gaussians, cells))
        by_image = objective.evaluate(frame, projector.merge(cells))
        for cloud in run.clouds:
            if len(run.clouds) > 1:  # the last one's are there
                projector.prepare(cloud.gaussians, cells)
            projector.backward(cloud.gaussians, cells, by_image, cloud.gradients)
        if corner is not None:
            volume = self._draw(run, lambda cloud: objective.crop.forward(cloud.gaussians, run.grid, corner))
            by_volume = objective.tv.evaluate(volume)
            for cloud in run.clouds:
                if len(run.clouds) > 1:
                    objective.crop.prepare(cloud.gaussians, run.grid, corner)
                objective.add_variation(cloud, by_volume)
        for cloud in run.clouds:
            objective.chain(cloud, cloud.statistics, late=late, of=run.count)

    def _draw(self, run: SplatRun, draw: Callable[[DeviceCloud], DeviceArray]) -> DeviceArray:
        """What all parts on all ranks draw into the same memory, summed there."""
        if self.parts == 1:
            return draw(run.clouds[0])
        drawn = [(array := draw(cloud), run.rt.download(array)[None])[1] for cloud in run.clouds]
        total = exact_sum(self.ranks, drawn, drawn[0].shape, self.parts)
        run.rt.write(array, total[0])
        return array

    def loss(self, run: SplatRun) -> float:
        return float(np.mean(self._losses)) if self._losses else run.objective.loss.value()

    def control(
        self, run: SplatRun, population: Population, statistic: np.ndarray, box: np.ndarray
    ) -> Population:
        control = run.options.control
        grown = control_density(population, statistic, run.activation, control, box, run.rng, self.ranks)
        moments = grown.moments.reshape(2 * _ROWS, -1)
        columns = np.concatenate([grown.raw, moments]).astype(np.float32)

        def run_of(count: int, rank: int) -> range:
            runs = self._runs_of(count, rank)
            return range(runs[0].start, runs[-1].stop)

        mine = sorted_columns(self.ranks, grown.raw[2], columns, run_of)
        return Population(mine[:_ROWS], mine[_ROWS:].reshape(2, _ROWS, -1))

    def voxelise(self, run: SplatRun, rows: np.ndarray, grid: Grid) -> np.ndarray:
        """Slab by slab, summed; rank 0 has the whole, the others an empty one (0, ny, nx)."""
        nz, ny, nx = grid.shape
        slab = max(1, min(nz, _SLAB_BYTES // (4 * ny * pitch_of(nx))))
        volume = np.empty((nz if self.ranks.rank == 0 else 0, ny, nx), np.float32)
        counts = np.cumsum([cloud.count for cloud in run.clouds])[:-1]
        clouds = [DeviceGaussians.upload(run.rt, part) for part in np.split(rows, counts, axis=1)]
        for start in range(0, nz, slab):
            shape = (min(slab, nz - start), ny, nx)
            made = Voxeliser(run.rt, shape, cutoff_sigma=run.options.cutoff_sigma)
            drawn = [run.rt.download(made.forward(cloud, grid, (start, 0, 0)))[None] for cloud in clouds]
            total = exact_sum(self.ranks, drawn, drawn[0].shape, self.parts)[0]
            if self.ranks.rank == 0:
                volume[start : start + shape[0]] = unpad_rows(total, shape)
        return volume
