"""Options of the neural methods, with their ranges. This module loads without PyTorch."""

import math
from dataclasses import dataclass
from typing import ClassVar

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow
from phyradgs_cl.acquisition.motion import RAYS, MotionOptions, motions_for
from phyradgs_cl.acquisition.scan import MODELS_OF_METHODS
from phyradgs_cl.errors import InputError

JITTERS = ("ray", "sample", "none")
LAST_ACTIVATIONS = ("sigmoid", "leaky-relu")
TORCH_DEVICES = ("auto", "cpu", "cuda", "mps")
# Numbers of grid cells and samples per voxel, used unless options state the numbers.
CELLS_PER_VOXEL = 1.0  # grid cells of the encoding's finest level per voxel of the longest side
SAMPLES_PER_VOXEL = 1.5  # samples along a ray per voxel of the longest side: NAF takes 192 for 128 voxels
# If a pixel has rays at several times, fewer samples per ray are enough: only the mean over the rays must be exact.
SAMPLES_PER_TIME = 1.2
_FINEST = 2**24  # with more grid cells along a side, float32 coordinates have no fraction within a cell


@dataclass(frozen=True)
class NeuralOptions(MotionOptions):
    """Options of a field that is fitted to rays. The field consists of a hash encoding and a small network.

    - iterations: passes over all frames, with one step per frame. rays: pixels per step.
    - samples: number along each ray in the volume. 0: 1.5 per voxel of the longest side, 1.2 if a pixel has several times.
    - jitter: random shift of samples in their intervals: one shift per ``ray``, one per ``sample``, or ``none``.
    - times: how many of the times in a line's exposure a step uses, drawn for each pixel; 0: all of the times.
    - positive_only: use only pixels with a line integral above 0.
    - voxel_points: points along each side of a voxel. The voxel's value is the field's mean over all of its points.

    - levels (0: until the finest has one cell per voxel), features, base_resolution (cells along a side), level_growth,
      table_log2 (each level has at most 2^table_log2 entries): sizes of the hash encoding.
    - layers, width, last_activation: the network's shape. A sigmoid reaches at most density_bound, in units of FDK's 99.9th
      percentile. The field starts everywhere at first_share × density_bound.
    - rate: Adam's learning rate. It is multiplied by rate_factor after every rate_step passes. With rate_step 0 it falls
      smoothly over the run, to rate × rate_factor.
    - detector_model: what the detector averages over a line's times, or the model that the scan states (scan).
    - torch_device: the device of PyTorch."""

    MOTIONS: ClassVar[tuple[Motion, ...]] = motions_for(RAYS)

    motion: Motion = PerRow()
    detector_model: str = checks.option("scan", words=MODELS_OF_METHODS)
    iterations: int = checks.ranged(30, 0, 1_000_000)
    rays: int = checks.ranged(512, 1, 1_000_000)
    samples: int = checks.ranged(0, 0, 100_000)
    jitter: str = checks.option("ray", words=JITTERS)
    times: int = checks.ranged(0, 0, 10_000)
    positive_only: bool = False
    voxel_points: int = checks.ranged(2, 1, 16)
    levels: int = checks.ranged(0, 0, 32)
    features: int = checks.ranged(2, 1, 64)
    base_resolution: int = checks.ranged(8, 1, 4096)
    level_growth: float = checks.ranged(2.0, 1, 16)
    table_log2: int = checks.ranged(19, 4, 28)
    layers: int = checks.ranged(4, 2, 64)
    width: int = checks.ranged(32, 1, 4096)
    last_activation: str = checks.option("sigmoid", words=LAST_ACTIVATIONS)
    density_bound: float = checks.ranged(2.0, 1e-3, 1e6)
    first_share: float = checks.ranged(0.05, 1e-6, 0.999)
    rate: float = checks.ranged(1e-2, 1e-9, 10)
    rate_factor: float = checks.ranged(0.3, 1e-9, 1)
    rate_step: int = checks.ranged(0, 0, 1_000_000)
    torch_device: str = checks.option("auto", words=TORCH_DEVICES)

    def __post_init__(self) -> None:
        super().__post_init__()
        finest = self.base_resolution * self.level_growth ** max(self.levels - 1, 0)
        if finest > _FINEST:
            found = f"a finest level of {finest:.3g} cells along a side"
            remedy = "take fewer levels or a smaller level_growth"
            raise InputError("levels", found, f"at most {_FINEST}", remedy)

    def levels_for(self, longest_voxels: int) -> int:
        """Returns the encoding's number of levels for a volume of ``longest_voxels`` voxels along its longest side."""
        if self.levels or self.level_growth == 1:
            return max(self.levels, 1)
        steps = math.log(CELLS_PER_VOXEL * longest_voxels / self.base_resolution, self.level_growth)
        finest = math.log(_FINEST / self.base_resolution, self.level_growth)
        return 1 + max(math.ceil(min(steps, finest) - 1e-9), 0)

    def samples_for(self, longest_voxels: int, times: int = 1) -> int:
        """Returns the number of samples along each ray of a pixel that has rays at ``times`` times."""
        density = SAMPLES_PER_VOXEL if times == 1 else SAMPLES_PER_TIME
        return self.samples or max(round(density * longest_voxels), 2)

    def times_for(self, count: int, model: str) -> int:
        """Returns how many of the ``count`` times in a line's exposure a step uses. model: what the detector averages.

        Raises InputError for a subset of the times that would bias the loss. The log model must estimate a variance, which
        takes two times. In the intensity model, log(mean over all times) is not the mean of log(mean over a subset)."""
        if self.times == 0:
            return count
        if self.times < count and model == "intensity":
            found = f"{self.times} of {count} times in the intensity model"
            raise InputError("option times", found, f"0, or {count} and more: a subset is biased")
        if self.times == 1 and count > 1:
            raise InputError("option times", f"1 of {count} times", "0, or 2 and more: a single one is biased")
        return min(self.times, count)


@dataclass(frozen=True)
class LineOptions(NeuralOptions):
    """Options of a field with a transformer over line segments, fitted to windows of pixels and to scattered pixels.

    segment: number of samples in a line segment. heads, head_width, blocks: sizes of the attention within segments. windows:
    number of windows per step, each of ``window`` by ``window`` pixels."""

    segment: int = checks.ranged(2, 1, 256)
    heads: int = checks.ranged(8, 1, 256)
    head_width: int = checks.ranged(4, 1, 1024)
    blocks: int = checks.ranged(1, 1, 32)
    window: int = checks.ranged(8, 1, 1024)
    windows: int = checks.ranged(16, 0, 100_000)

    def samples_for(self, longest_voxels: int, times: int = 1) -> int:
        return checks.ceil_div(super().samples_for(longest_voxels, times), self.segment) * self.segment
