"""Voxels and splats of one scan together: their errors differ, so that their mean is nearer to the truth than either.

Two estimates of about the same error whose errors correlate by ρ have a mean that is 10 log10(2/(1 + ρ)) dB better. First
``fista`` on voxels, then Gaussians that start from its volume, then a mean in which the better voxels weigh more; half
their difference says where neither is sure.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.ndimage import uniform_filter

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Exact, Motion, PerRow, Scan, Static
from phyradgs_cl.acquisition.motion import check_motion
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    option_facts,
)
from phyradgs_cl.reconstructors.splats import phyradgs
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions, fista_stages
from phyradgs_cl.reconstructors.voxels.stages import Stage, run_stages
from phyradgs_cl.runtime import Runtime

_NEAR = 3  # voxels along each side: at a single one two estimates may agree by chance


@dataclass(frozen=True)
class FusedOptions:
    """iterations: of the splats, whose presets' shares of it are kept; voxel_iterations: passes of ``fista`` before them.

    splat_weight: share of the splats' volume in the result. prior_weight: as of ``fista``. motion: static, or exact (the
    voxels' lines each at their own times, the splats moving).
    """

    MOTIONS: ClassVar[tuple[Motion, ...]] = (Static(), Exact())

    motion: Motion = Exact()
    iterations: int = 1500
    voxel_iterations: int = FistaOptions.iterations
    splat_weight: float = 0.2
    prior_weight: float = FistaOptions.prior_weight
    detector_model: str = "scan"

    def __post_init__(self) -> None:
        checks.within("--iterations", self.iterations, 0, 1_000_000_000)
        checks.within("voxel_iterations", self.voxel_iterations, 0, 1_000_000)
        checks.within("splat_weight", self.splat_weight, 0, 1)
        checks.within("prior_weight", self.prior_weight, 0, 1e6)
        checks.one_of("detector_model", self.detector_model, ("scan", *DETECTOR_MODELS))
        check_motion(self.motion, self.MOTIONS)

    def voxels(self) -> FistaOptions:
        """The options of the first half."""
        motion: Motion = PerRow() if isinstance(self.motion, Exact) else self.motion
        return FistaOptions(
            motion=motion,
            iterations=self.voxel_iterations,
            detector_model=self.detector_model,
            prior_weight=self.prior_weight,
        )

    def splats(self) -> SplatOptions:
        """The options of the second half."""
        return SplatOptions(motion=self.motion, iterations=self.iterations, detector_model=self.detector_model)


def fused(
    scan: Scan,
    options: FusedOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
    initial: np.ndarray | None = None,
) -> Reconstruction:
    """The weighted mean of both volumes in 1/mm, with the Gaussians of one; the seed is the splats'.

    ``disagreement`` is the map of where they differ, None before there are splats. The fact ``stages`` has those of the
    parts; ``disagreement_per_mm`` is half the RMS of their difference.
    """
    voxels = fista_stages(scan, options.voxels(), rt)
    halves: dict[str, np.ndarray] = {}

    def splats(before: np.ndarray | None, told: ProgressReport, left: State | None) -> Reconstruction:
        assert before is not None
        start = np.maximum(before, 0)
        return phyradgs.METHOD.run(scan, options.splats(), rt, seed=seed, report=told, resume=left, initial=start)

    def both(volume: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        assert before is not None
        halves["difference"] = volume - before
        mean: np.ndarray = before + np.float32(options.splat_weight) * halves["difference"]
        return mean

    stages = [*voxels, Stage("splats", options.iterations, splats, both)]
    result = run_stages(stages, scan.grid, report, resume, initial)
    result.facts.update(method="fused", options=option_facts(options))
    if "difference" not in halves:
        return result
    squares = np.square(halves["difference"], dtype=np.float64)
    result.facts["disagreement_per_mm"] = float(np.sqrt(squares.mean()) / 2)
    return replace(result, disagreement=_half_of_nearby(squares))


def _half_of_nearby(squares: np.ndarray) -> np.ndarray:
    """Half the root of the means of squares (nz, ny, nx) over nearby voxels, float32."""
    means = np.maximum(uniform_filter(squares, _NEAR, mode="nearest"), 0)  # its running sums round
    return (np.sqrt(means) / 2).astype(np.float32)


METHOD = Method(fused, {"default": FusedOptions()}, takes_initial=True)
