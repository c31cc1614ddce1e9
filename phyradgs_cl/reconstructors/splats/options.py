"""Options of the splatting methods, and their presets: ours and the paper's."""

import math
from dataclasses import dataclass
from typing import ClassVar

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Exact, MicroViews, Motion, Static
from phyradgs_cl.acquisition.motion import SPLATS, MotionOptions, motions_for
from phyradgs_cl.acquisition.scan import MODELS_OF_METHODS
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Activation, Grid
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA
from phyradgs_cl.optim import PUBLISHED_RATES, DensityControl, Rates
from phyradgs_cl.text import repr_of_changes

# Iterations before ``exact_from`` model motion coarsely, with little loss of quality (docs/results/motion_models.md).
_STATIC_SHARE = 0.4  # the first coarse iterations, this fraction of them, have one pose per frame
_COARSE_ERROR = 0.1  # the other coarse iterations have at least this ``time_error`` (relative RMS error)


@dataclass(frozen=True, repr=False)
class SplatOptions(MotionOptions):
    """Options of a splatting run. Unit of length: half the volume's longest side; of density: FDK's 99.9th percentile.

    - gaussians: number at the start; 0 chooses it from the grid. The *_weight options weight terms of the paper's Eq. 4.
      tv_edge: side in voxels of the random sub-volume for total variation. scale_min_voxels: (least scale)/(voxel side).
    - detector_model: what the detector averages over a line's times: line integrals (log), intensity, or what the scan
      states (scan).
    - exact_from: before this fraction of the run, the motion ``exact`` is coarse: first one pose for each frame, then one
      segment of few times. 0: it is exact throughout.
    - iterations: number of frames used, with repetitions. batch: frames per step of Adam, at learning rates × √batch; 0: one
      per rank. The same batch gives the same bits on any number of ranks (docs/cluster.md)."""

    MOTIONS: ClassVar[tuple[Motion, ...]] = motions_for(SPLATS)

    motion: Motion = Exact()
    affine: bool = False
    detector_model: str = checks.option("scan", words=MODELS_OF_METHODS)
    iterations: int = checks.ranged(3000, 0, 1_000_000_000, "--iterations")
    gaussians: int = checks.ranged(0, 0, 100_000_000, "--gaussians (0 chooses from the grid)")
    ssim_weight: float = checks.ranged(0.2, 0, 1e6)
    l1_weight: float = checks.ranged(1.0, 0, 1e6)
    tv_weight: float = checks.ranged(0.01, 0, 1e6)
    tv_edge: int = checks.ranged(32, 1, 4096)
    density_weight: float = checks.ranged(0.001, 0, 1e6)
    parameter_terms_from: int = checks.ranged(500, 0, 1_000_000_000)
    cutoff_sigma: float = checks.ranged(DEFAULT_CUTOFF_SIGMA, 0, 100)  # in standard deviations; 0 cuts nothing off
    initial_threshold: float = checks.ranged(0.05, 0, 1e6)
    initial_density: float = checks.ranged(0.15, 1e-6, 1e3)
    initial_scale: float = checks.ranged(1.0, 1e-6, 1e3)
    scale_min: float = checks.ranged(0.001, 1e-9, 10)
    scale_min_voxels: float = checks.ranged(0.0, 0, 100)
    scale_max: float = checks.ranged(1.0, 1e-6, 100)
    exact_from: float = checks.ranged(0.73, 0, 1)
    batch: int = checks.ranged(0, 0, 1_000_000, "batch (0: as many as ranks)")
    rates: Rates = Rates()
    control: DensityControl = DensityControl()

    __repr__ = repr_of_changes

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scale_max <= self.scale_min:
            raise InputError("scale_max", f"{self.scale_max:g}", f"more than scale_min ({self.scale_min:g})")

    def activation(self, grid: Grid) -> Activation:
        """Returns the map from raw to actual parameters, with the limits of scales on ``grid``, all in internal units."""
        smallest = max(self.scale_min, self.scale_min_voxels * min(grid.voxel_size_mm))
        return Activation(smallest, max(self.scale_max, 2 * smallest))

    def gaussians_for(self, grid: Grid) -> int:
        """Returns the number of Gaussians at the start: the option or, for 0, 1/16 of the voxels, from 1,000 to 50,000."""
        if self.gaussians:
            return self.gaussians
        return int(min(max(math.prod(grid.shape) / 16, 1000), 50_000))

    def motion_at(self, share: float) -> Motion:
        """Returns the motion model after the fraction ``share`` of the run. In place of ``exact`` it is a coarser one before
        ``exact_from``, where exact motion would gain little."""
        if not isinstance(self.motion, Exact) or share >= self.exact_from:
            return self.motion
        is_first = share < _STATIC_SHARE * self.exact_from
        return Static() if is_first else Exact(1, max(_COARSE_ERROR, self.motion.time_error))

    def batch_for(self, frames: int, ranks: int) -> int:
        """Returns how many frames a step takes: the option ``batch`` or, for 0, one per rank. Raises InputError for a batch
        of more frames than the scan has."""
        if self.batch > frames:
            raise InputError("batch", str(self.batch), f"no more than the scan's {frames} frames")
        return self.batch or min(ranks, frames)

    @property
    def asks_for_gaussians(self) -> bool:
        """Whether the user chose the number of Gaussians at the start. A number that is in a preset counts as not chosen."""
        return self.gaussians not in {0, *(preset.gaussians for preset in (*PRESETS.values(), R2_PUBLISHED))}


PUBLISHED_CONTROL = DensityControl(threshold=5e-5, prune_aspect=0.0)
_PAPER = SplatOptions(
    motion=MicroViews(8, 5), gaussians=50_000, iterations=20_000, rates=PUBLISHED_RATES,
    control=PUBLISHED_CONTROL,
)
# "quick": a sixth of the default's iterations, with its schedule in proportion, and two or three segments per frame.
_QUICK = SplatOptions(
    motion=Exact(time_error=0.02), iterations=500, parameter_terms_from=80,
    control=DensityControl(every=20, start_iteration=80),
)

PRESETS = {"default": SplatOptions(), "quick": _QUICK, "paper": _PAPER}
# R2-Gaussian's constants, but our default number of iterations, not its 30,000. The learning rates decay over our number.
R2_PUBLISHED = SplatOptions(
    motion=Exact(), affine=True, gaussians=50_000, ssim_weight=0.25, tv_weight=0.05, density_weight=0.0,
    rates=PUBLISHED_RATES, control=PUBLISHED_CONTROL,
)
