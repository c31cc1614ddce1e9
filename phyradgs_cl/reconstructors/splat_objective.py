"""The objective of one frame on the device, step by step: image terms, total variation, parameter terms."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import ImageLoss, TotalVariation
from phyradgs_cl.operators import SplatProjector, Voxeliser
from phyradgs_cl.optim import DeviceAdam
from phyradgs_cl.reconstructors.splat_cloud import DeviceCloud
from phyradgs_cl.reconstructors.splat_frames import DeviceFrames, Scale
from phyradgs_cl.reconstructors.splat_options import SplatOptions
from phyradgs_cl.runtime import DeviceArray, Runtime

Corner = tuple[int, int, int]


class FrameObjective:
    """Projector, loss and total variation of a scan's frames; each step uses what the one before it prepared."""

    def __init__(
        self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale, grid: Grid, keeps_frames: bool
    ) -> None:
        self.rt, self.options, self.grid = rt, options, grid
        self.frames = DeviceFrames(rt, scan, options, scale, keeps_frames)
        self.projector = SplatProjector(
            rt,
            self.frames.lines,
            self.frames.width,
            affine=options.affine,
            cutoff_sigma=options.cutoff_sigma,
            time_error=options.motion.time_error,
            pixel_footprint=options.pixel_footprint,
            intensity_unit=self.frames.intensity_unit,
        )
        self.loss = ImageLoss(
            rt,
            self.frames.lines,
            self.frames.width,
            self.projector.pitch,
            options.ssim_weight,
            options.l1_weight,
            options.poisson_weight,
        )
        edge = [min(options.tv_edge, n) for n in grid.shape]
        self.crop = Voxeliser(rt, (edge[0], edge[1], edge[2]), cutoff_sigma=options.cutoff_sigma)
        self.tv = TotalVariation(rt, self.crop.shape, self.crop.pitch)
        self.adam = DeviceAdam(rt, options.activation(grid))

    def evaluate(self, frame: int, rendered: DeviceArray) -> DeviceArray:
        """dL/drendered of the image terms of a frame, until the next call."""
        _, measured, mask, pixels = self.frames.get(frame)
        return self.loss.evaluate(rendered, measured, mask, pixels, self.frames.transmission(frame))

    def corner(self, rng: np.random.Generator) -> Corner:
        """Where a random sub-volume starts, z y x."""
        z, y, x = (
            int(rng.integers(n - edge + 1)) for n, edge in zip(self.grid.shape, self.crop.shape, strict=True)
        )
        return z, y, x

    def add_variation(self, cloud: DeviceCloud, by_volume: DeviceArray) -> None:
        """Adds the total variation's gradient; ``by_volume`` is that by the sub-volume that was prepared last."""
        weight = self.options.tv_weight
        self.crop.backward(cloud.gaussians, self.grid, by_volume, cloud.gradients, add=True, weight=weight)

    def chain(
        self, cloud: DeviceCloud, statistics: DeviceArray, *, late: bool, of: int | None = None
    ) -> None:
        """dL/dparameters to dL/draw in place, with the parameter terms (of ``of`` Gaussians) if it is ``late`` enough."""
        options = self.options
        self.adam.chain(
            cloud.raw,
            cloud.gaussians.rows,
            cloud.gradients,
            statistics,
            cloud.count,
            cloud.gaussians.stride,
            density_weight=options.density_weight if late else 0.0,
            shape_weight=options.shape_weight if late else 0.0,
            shape_ratio=options.shape_ratio,
            shape_floor=options.shape_floor,
            of=of,
        )
