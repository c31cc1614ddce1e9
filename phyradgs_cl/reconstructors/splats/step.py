"""The gradient of one step: render a frame, compare, go back, total variation, chain rule; and its sum over ranks.

``FrameStep.gradient`` is the only place where these parts meet. Ranks have all Gaussians each, and some frames of the batch;
their gradients sum to bits that depend on the batch, not on the number of ranks."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.objective import ImageLoss, TotalVariation
from phyradgs_cl.operators import SplatProjector, Voxeliser
from phyradgs_cl.operators.splats.projector import DEFAULT_TIME_ERROR
from phyradgs_cl.operators.splats.states import CloudStates
from phyradgs_cl.optim import DeviceAdam
from phyradgs_cl.parallel import Communicator, exact_sum
from phyradgs_cl.reconstructors.splats.device import DeviceCloud, DeviceFrames, Scale
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import DeviceArray, Runtime

_ROWS = 11  # parameters of a Gaussian: rows of dL/d(parameters)
_STATISTICS = 2  # rows of a Gaussian's statistics for density control
_DERIVED = 13  # rows of ``cloud.gradients``: dL/d(parameters), then dL/d(centre on the detector), (u, v)
Corner = tuple[int, int, int]
"""First voxel (z, y, x) of the sub-volume of the total variation."""


@dataclass(frozen=True)
class Batch:
    """The frames of one step by number, a corner of a sub-volume for each (None if total variation has no weight), and
    ``late``: whether the density term applies."""

    frames: list[int]
    corners: list[Corner | None]
    late: bool


class FrameStep:
    """Computes gradients from single frames of a scan, in internal units; ``grid`` is the volume's. deformation: how the
    object moves, in mm."""

    def __init__(
        self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale, grid: Grid,
        deformation: Deformation | None = None,
    ) -> None:
        self.rt, self.options, self.grid, self.motion = rt, options, grid, options.motion
        self.frames = DeviceFrames(rt, scan, options, scale, deformation)
        states = None if deformation is None else CloudStates(rt, deformation.scaled(1 / scale.length_mm))
        if states is not None:
            states.check_inverse(grid)
        lines, width = self.frames.lines, self.frames.width
        self.projector = SplatProjector(
            rt, lines, width, affine=options.affine, cutoff_sigma=options.cutoff_sigma,
            time_error=getattr(options.motion, "time_error", DEFAULT_TIME_ERROR),
            intensity_unit=self.frames.intensity_unit, states=states,
        )
        self.loss = ImageLoss(rt, lines, width, self.projector.pitch, options.ssim_weight, options.l1_weight)
        z, y, x = (min(options.tv_edge, n) for n in grid.shape)
        self.crop = Voxeliser(rt, (z, y, x), cutoff_sigma=options.cutoff_sigma)
        self.tv = TotalVariation(rt, self.crop.shape, self.crop.pitch)
        self.adam = DeviceAdam(rt, options.activation(grid))

    def follow(self, motion: Motion) -> None:
        """Takes a motion model for the next steps."""
        if motion != self.motion:
            self.motion = motion
            self.frames.follow(motion)
            self.projector.time_error = getattr(motion, "time_error", DEFAULT_TIME_ERROR)

    def draw_corner(self, rng: np.random.Generator) -> Corner | None:
        """Draws the corner (z, y, x) of a sub-volume for total variation; None where that has no weight."""
        if self.options.tv_weight == 0:
            return None
        room = (n - edge + 1 for n, edge in zip(self.grid.shape, self.crop.shape, strict=True))
        z, y, x = (int(rng.integers(n)) for n in room)
        return z, y, x

    def gradient(
        self, cloud: DeviceCloud, frame: int, corner: Corner | None, late: bool, statistics: DeviceArray
    ) -> None:
        """Writes one frame's dL/d(raw parameters) into the gradients of an activated cloud, and adds to the
        ``statistics`` (2, stride) of density control. corner, late: as in ``Batch``."""
        options, gaussians, by_cloud = self.options, cloud.gaussians, cloud.gradients
        cells, measured, mask, pixels = self.frames.get(frame)
        rendered = self.projector.forward(gaussians, cells)
        by_image = self.loss.evaluate(rendered, measured, mask, pixels)
        self.projector.backward(gaussians, cells, by_image, by_cloud)
        if corner is not None:
            by_volume = self.tv.evaluate(self.crop.forward(gaussians, self.grid, corner))
            self.crop.backward(gaussians, self.grid, by_volume, by_cloud, add=True, weight=options.tv_weight)
        own = cloud.raw, gaussians.rows, by_cloud, statistics, cloud.count, gaussians.stride
        self.adam.chain(*own, density_weight=options.density_weight if late else 0.0)


class Alone:
    """One process, which takes one frame per step."""

    def differentiate(self, step: FrameStep, cloud: DeviceCloud, batch: Batch) -> None:
        """Writes dL/d(raw parameters) of the batch into the cloud's gradients, and adds to its statistics."""
        step.gradient(cloud, batch.frames[0], batch.corners[0], batch.late, cloud.statistics)

    def loss(self, step: FrameStep) -> float:
        """Returns the mean loss of the frames of the last batch."""
        return step.loss.value()


class SharedFrames(Alone):
    """Ranks that share several frames per step: rank r takes the frames r, r + ranks, … of the batch."""

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
        # dL/d(centre on the panel) is in the statistics already
        rt.write(cloud.gradients, np.pad(total[:_ROWS], ((0, _DERIVED - _ROWS), (0, 0))))
        rt.write(cloud.statistics, rt.download(cloud.statistics) + total[_ROWS:])

    def loss(self, step: FrameStep) -> float:
        losses = self._losses.copy()
        self.ranks.allreduce_sum(losses)
        return float(losses.mean())


def sharing_of(ranks: Communicator, batch: int) -> Alone:
    """Returns how ``ranks`` share steps of ``batch`` frames. Raises InputError where some rank would have no frame."""
    if ranks.size > batch:
        found = f"{batch} for {ranks.size} ranks"
        raise InputError("--batch", found, "a frame for every rank", "raise it, or take fewer ranks")
    return SharedFrames(ranks) if batch > 1 else Alone()
