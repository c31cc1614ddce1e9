"""The weighted mean of a voxel and a splat reconstruction of one scan, which is nearer to the truth than either.

Two estimates with equal errors that correlate by ρ have a mean that is 10 log10(2/(1 + ρ)) dB better. ``fista`` runs first;
Gaussians then start from its volume. Half the difference of the two volumes maps their disagreement."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from scipy.ndimage import uniform_filter

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Exact, Motion, PerRow, Scan, Static
from phyradgs_cl.acquisition.motion import check_motion
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import Reconstruction, option_facts
from phyradgs_cl.reconstructors.splats.method import reconstruct_splats
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions, fista_stages
from phyradgs_cl.reconstructors.voxels.run import MethodInputs
from phyradgs_cl.reconstructors.voxels.stages import Stage, run_stages
from phyradgs_cl.runtime import Runtime

_NEIGHBOURHOOD = 3  # voxels along each side; at a single voxel two estimates may agree by chance


@dataclass(frozen=True)
class FusedOptions:
    """iterations: of the splats; voxel_iterations: passes of ``fista`` before them.

    splat_weight: share of the splats' volume in the result. prior_weight: as in ``fista``. motion: static, or exact (lines
    at their own times for the voxels, moving splats)."""

    MOTIONS: ClassVar[tuple[Motion, ...]] = (Static(), Exact())

    motion: Motion = Exact()
    iterations: int = checks.ranged(1500, 0, 1_000_000_000, "--iterations")
    voxel_iterations: int = checks.ranged(FistaOptions.iterations, 0, 1_000_000)
    splat_weight: float = checks.ranged(0.2, 0, 1)
    prior_weight: float = checks.ranged(FistaOptions.prior_weight, 0, 1e6)
    detector_model: str = "scan"

    def __post_init__(self) -> None:
        checks.fields_within("", self)
        checks.one_of("detector_model", self.detector_model, ("scan", *DETECTOR_MODELS))
        check_motion(self.motion, self.MOTIONS)

    def voxels(self) -> FistaOptions:
        """The options of the first half."""
        motion: Motion = PerRow() if isinstance(self.motion, Exact) else self.motion
        return FistaOptions(
            motion=motion, iterations=self.voxel_iterations, detector_model=self.detector_model,
            prior_weight=self.prior_weight,
        )

    def splats(self) -> SplatOptions:
        """The options of the second half."""
        return SplatOptions(motion=self.motion, iterations=self.iterations, detector_model=self.detector_model)


def fused(scan: Scan, options: FusedOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    """Returns the weighted mean of both volumes in 1/mm, with the Gaussians. ``arguments``: the other ``MethodInputs``.

    ``disagreement`` maps where the volumes differ; it is None before there are splats. The fact ``disagreement_per_mm`` is
    half the RMS of their difference."""
    inputs = MethodInputs(scan, options, rt, **arguments)
    halves: dict[str, np.ndarray] = {}

    def splats(stage: MethodInputs) -> Reconstruction:
        assert stage.initial is not None
        start = np.maximum(stage.initial, 0)
        return reconstruct_splats(
            scan, options.splats(), rt, method="phyradgs",
            seed=stage.seed, report=stage.report, resume=stage.resume, initial=start, deformation=stage.deformation,
        )  # fmt: skip

    def mean_of_both(volume: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        assert before is not None
        halves["difference"] = volume - before
        return before + np.float32(options.splat_weight) * halves["difference"]

    stages = fista_stages(replace(inputs, options=options.voxels()))
    stages.append(Stage("splats", options.iterations, splats, mean_of_both))
    result = run_stages(stages, inputs)
    result.facts.update(method="fused", options=option_facts(options))
    if "difference" not in halves:
        return result
    squares = np.square(halves["difference"], dtype=np.float64)
    result.facts["disagreement_per_mm"] = float(np.sqrt(squares.mean()) / 2)
    means = np.maximum(uniform_filter(squares, _NEIGHBOURHOOD, mode="nearest"), 0)  # rounding may make a mean negative
    return replace(result, disagreement=(np.sqrt(means) / 2).astype(np.float32))


METHOD = Method(fused, {"default": FusedOptions()}, takes_initial=True, takes_deformation=True)
