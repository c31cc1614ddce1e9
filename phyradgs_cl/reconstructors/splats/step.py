"""One frame's part of a step: render, compare, go back, total variation, chain rule. The only place where they stand."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import ImageLoss, TotalVariation
from phyradgs_cl.operators import SplatProjector, Voxeliser
from phyradgs_cl.operators.splats.projector import DEFAULT_TIME_ERROR
from phyradgs_cl.optim import DeviceAdam
from phyradgs_cl.reconstructors.splats.cloud import DeviceCloud
from phyradgs_cl.reconstructors.splats.frames import DeviceFrames, Scale
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import DeviceArray, Runtime

Corner = tuple[int, int, int]
"""Where the sub-volume of the total variation starts, z y x."""


@dataclass(frozen=True)
class Batch:
    """The frames of one step, a corner for each (None where the total variation has no weight), and whether it is ``late``
    enough for the parameter terms.
    """

    frames: list[int]
    corners: list[Corner | None]
    late: bool


class FrameStep:
    """Frames, projector, loss, total variation and optimiser of a scan, in internal units; ``grid`` is the volume's."""

    def __init__(self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale, grid: Grid) -> None:
        self.rt, self.options, self.grid = rt, options, grid
        self.frames = DeviceFrames(rt, scan, options, scale)
        lines, width = self.frames.lines, self.frames.width
        self.projector = SplatProjector(
            rt,
            lines,
            width,
            affine=options.affine,
            cutoff_sigma=options.cutoff_sigma,
            time_error=getattr(options.motion, "time_error", DEFAULT_TIME_ERROR),
            pixel_footprint=options.pixel_footprint,
            intensity_unit=self.frames.intensity_unit,
        )
        weights = options.ssim_weight, options.l1_weight, options.poisson_weight
        self.loss = ImageLoss(rt, lines, width, self.projector.pitch, *weights)
        z, y, x = (min(options.tv_edge, n) for n in grid.shape)
        self.crop = Voxeliser(rt, (z, y, x), cutoff_sigma=options.cutoff_sigma)
        self.tv = TotalVariation(rt, self.crop.shape, self.crop.pitch)
        self.adam = DeviceAdam(rt, options.activation(grid))

    def draw_corner(self, rng: np.random.Generator) -> Corner | None:
        """A random sub-volume for the total variation, if it has a weight."""
        if self.options.tv_weight == 0:
            return None
        room = (n - edge + 1 for n, edge in zip(self.grid.shape, self.crop.shape, strict=True))
        z, y, x = (int(rng.integers(n)) for n in room)
        return z, y, x

    def gradient(
        self, cloud: DeviceCloud, frame: int, corner: Corner | None, late: bool, statistics: DeviceArray
    ) -> None:
        """Writes dL/draw of a frame into the gradients of an activated cloud; ``corner`` and ``late`` are as in ``Batch``.

        Adds to the ``statistics`` (2, stride) of density control.
        """
        options, gaussians, by_cloud = self.options, cloud.gaussians, cloud.gradients
        cells, measured, mask, pixels = self.frames.get(frame)
        rendered = self.projector.forward(gaussians, cells)
        by_image = self.loss.evaluate(rendered, measured, mask, pixels, self.frames.transmission(frame))
        self.projector.backward(gaussians, cells, by_image, by_cloud)
        if corner is not None:
            by_volume = self.tv.evaluate(self.crop.forward(gaussians, self.grid, corner))
            self.crop.backward(gaussians, self.grid, by_volume, by_cloud, add=True, weight=options.tv_weight)
        self.adam.chain(
            cloud.raw,
            gaussians.rows,
            by_cloud,
            statistics,
            cloud.count,
            gaussians.stride,
            density_weight=options.density_weight if late else 0.0,
            shape_weight=options.shape_weight if late else 0.0,
            shape_ratio=options.shape_ratio,
            shape_floor=options.shape_floor,
        )
