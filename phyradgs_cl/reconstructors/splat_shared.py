"""Frames of a batch shared out over ranks that each have all Gaussians; their gradients are summed to the same bits.

With more ranks than frames the lines of a frame are shared out, in parts whose gradients are rounded before they are added:
the sum is the frame's gradient but for that. Batch and parts decide about the bits; how many ranks there are does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.operators.layout import GUARD
from phyradgs_cl.parallel import Communicator, Shares, exact_sum, span
from phyradgs_cl.reconstructors.splat_division import Batch, Undivided
from phyradgs_cl.runtime import DeviceArray

if TYPE_CHECKING:
    from phyradgs_cl.reconstructors.splat_run import SplatRun

_ROWS, _STATISTICS = 11, 2
_DERIVED = 13  # with the centre on the detector, which density control looks at


class SharedFrames(Undivided):
    """Several ranks, several frames a step, or several parts of a frame."""

    def __init__(self, ranks: Communicator, batch: int, parts: int) -> None:
        if parts and ranks.size > batch * parts:
            found = f"{parts} parts of {batch} frames a step for {ranks.size} ranks"
            raise InputError("--parts", found, "a part for every rank", "raise it, or take fewer ranks")
        self.ranks = ranks
        self.parts = parts or -(-ranks.size // batch)
        """Of every frame, whether a step has all of its frames or is the last."""
        self._shares: dict[int, Shares] = {}
        self._losses = np.zeros(1)

    def differentiate(self, run: SplatRun, batch: Batch) -> None:
        cloud, count = run.clouds[0], len(batch.frames)
        stride = cloud.gaussians.stride
        if count not in self._shares:
            self._shares[count] = Shares.of(self.ranks, count)
        shares = self._shares[count]
        self._losses = np.zeros(count)
        given = []
        for place in shares.places:
            statistics = run.rt.zeros((_STATISTICS, stride))
            self._differentiate_frame(run, batch, place, shares.team, statistics)
            if shares.team.rank == 0:
                self._losses[place] = run.objective.loss.value()
                gradients = run.rt.download(cloud.gradients)[:_ROWS]
                given.append(np.concatenate([gradients, run.rt.download(statistics)]))
        total = exact_sum(self.ranks, given, (_ROWS + _STATISTICS, stride), count)
        run.rt.write(cloud.gradients, np.pad(total[:_ROWS], ((0, _DERIVED - _ROWS), (0, 0))))
        run.rt.write(cloud.statistics, run.rt.download(cloud.statistics) + total[_ROWS:])

    def _differentiate_frame(
        self, run: SplatRun, batch: Batch, place: int, team: Communicator, statistics: DeviceArray
    ) -> None:
        """dL/draw of one frame of the batch into the cloud's gradients, and its statistics; the same on the whole team."""
        cloud, objective, frame = run.clouds[0], run.objective, batch.frames[place]
        if self.parts == 1:
            cells = run.frames.cells(frame)
            by_image = objective.evaluate(frame, objective.projector.forward(cloud.gaussians, cells))
            objective.projector.backward(cloud.gaussians, cells, by_image, cloud.gradients)
        else:
            self._differentiate_parts(run, frame, team)
        if batch.corners:
            volume = objective.crop.forward(cloud.gaussians, run.grid, batch.corners[place])
            objective.add_variation(cloud, objective.tv.evaluate(volume))
        objective.chain(cloud, statistics, late=batch.late)

    def _differentiate_parts(self, run: SplatRun, frame: int, team: Communicator) -> None:
        """The image terms of a frame whose lines are cut into parts, of which each of the team has a run."""
        cloud, projector = run.clouds[0], run.objective.projector
        of_team = span(self.parts, team.size, team.rank)
        mine = [span(run.frames.lines, self.parts, part) for part in of_team]
        image = np.zeros(projector.image.size, np.float32)
        for lines in mine:
            drawn = run.rt.download(projector.forward(cloud.gaussians, run.frames.part(frame, lines)))
            body = slice(GUARD + lines.start * projector.pitch, GUARD + lines.stop * projector.pitch)
            image[body] = drawn[body]
        team.add(image)
        run.rt.write(projector.image, image)
        by_image = run.objective.evaluate(frame, projector.image)
        gradients = []
        for lines in mine:
            cells = run.frames.part(frame, lines)
            self._restore(run, frame, lines, mine)
            projector.backward(cloud.gaussians, cells, by_image, cloud.gradients)
            gradients.append(run.rt.download(cloud.gradients))
        shape = (_DERIVED, cloud.gaussians.stride)
        run.rt.write(cloud.gradients, exact_sum(team, gradients, shape, self.parts))

    def _restore(self, run: SplatRun, frame: int, lines: range, mine: list[range]) -> None:
        """What ``backward`` needs of these lines, layers included, which those drawn after them have overwritten."""
        if len(mine) > 1:
            run.objective.projector.forward(run.clouds[0].gaussians, run.frames.part(frame, lines))

    def loss(self, run: SplatRun) -> float:
        losses = self._losses.copy()
        self.ranks.add(losses)
        return float(losses.mean())
