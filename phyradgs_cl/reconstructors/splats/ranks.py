"""How ranks share a step: each has all Gaussians and some frames of the batch; gradients are summed to the same bits.

The batch alone decides about the bits; how many ranks there are does not.
"""

from typing import Protocol

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.parallel import Communicator, exact_sum
from phyradgs_cl.reconstructors.splats.cloud import DeviceCloud
from phyradgs_cl.reconstructors.splats.step import Batch, FrameStep

_ROWS, _STATISTICS = 11, 2
_DERIVED = 13  # with the centre on the detector, which density control looks at


class Sharing(Protocol):
    """What all ranks do together, in the same order."""

    def differentiate(self, step: FrameStep, cloud: DeviceCloud, batch: Batch) -> None:
        """Writes dL/draw of the batch into the cloud's gradients and adds to its statistics."""
        ...

    def loss(self, step: FrameStep) -> float:
        """Mean loss of the frames of the last batch."""
        ...


class Alone:
    """One process, one frame per step."""

    def differentiate(self, step: FrameStep, cloud: DeviceCloud, batch: Batch) -> None:
        step.gradient(cloud, batch.frames[0], batch.corners[0], batch.late, cloud.statistics)

    def loss(self, step: FrameStep) -> float:
        return step.loss.value()


class SharedFrames:
    """Several frames per step, of which every rank has some: rank r has frames r, r + ranks, … of the batch."""

    def __init__(self, ranks: Communicator) -> None:
        self.ranks = ranks
        self._losses = np.zeros(1)

    def differentiate(self, step: FrameStep, cloud: DeviceCloud, batch: Batch) -> None:
        rt, stride, count = step.rt, cloud.gaussians.stride, len(batch.frames)
        self._losses = np.zeros(count)
        own = []
        for place in range(self.ranks.rank, count, self.ranks.size):
            statistics = rt.zeros((_STATISTICS, stride))
            step.gradient(cloud, batch.frames[place], batch.corners[place], batch.late, statistics)
            self._losses[place] = step.loss.value()
            own.append(np.concatenate([rt.download(cloud.gradients)[:_ROWS], rt.download(statistics)]))
        total = exact_sum(self.ranks, own, (_ROWS + _STATISTICS, stride), count)
        rt.write(cloud.gradients, np.pad(total[:_ROWS], ((0, _DERIVED - _ROWS), (0, 0))))
        rt.write(cloud.statistics, rt.download(cloud.statistics) + total[_ROWS:])

    def loss(self, step: FrameStep) -> float:
        losses = self._losses.copy()
        self.ranks.allreduce_sum(losses)
        return float(losses.mean())


def sharing_of(ranks: Communicator, batch: int) -> Sharing:
    """How ``ranks`` share steps of ``batch`` frames; InputError where some would have no frame."""
    if ranks.size > batch:
        found = f"{batch} for {ranks.size} ranks"
        raise InputError("--batch", found, "a frame for every rank", "raise it, or take fewer ranks")
    return SharedFrames(ranks) if batch > 1 else Alone()
