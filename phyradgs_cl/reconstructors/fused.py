"""Voxels and splats of one scan together: their errors differ, so that their mean is nearer to the truth than either.

Two estimates of about the same error whose errors correlate by ρ have a mean that is 10 log10(2/(1 + ρ)) dB better. First
``fista`` on voxels, then Gaussians that start from its volume, then the mean; half their difference says where neither is
sure.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Exact, Motion, PerRow, Scan, Static
from phyradgs_cl.acquisition.motion import check_motion
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    option_facts,
    state_arrays,
)
from phyradgs_cl.reconstructors.splats import phyradgs
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.voxels import fista
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions
from phyradgs_cl.runtime import Runtime

_VOXELS = "voxels"  # the finished volume in the state of a run that is at its splats


@dataclass(frozen=True)
class FusedOptions:
    """iterations: of the splats, whose presets' shares of it are kept; voxel_iterations: passes of ``fista`` before them.

    splat_weight: share of the splats' volume in the result. prior_weight: as of ``fista``. motion: static, or exact (the
    voxels' lines each at their own times, the splats moving).
    """

    MOTIONS: ClassVar[tuple[Motion, ...]] = (Static(), Exact())

    motion: Motion = Exact()
    iterations: int = 2000
    voxel_iterations: int = 30
    splat_weight: float = 0.5
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
    """The mean of both volumes in 1/mm, with the Gaussians of one; the seed is the splats'.

    Facts ``voxels`` and ``splats`` are the halves' own; ``disagreement_per_mm`` is half the RMS of their difference.
    """
    before, total = options.voxel_iterations, options.voxel_iterations + options.iterations
    at_splats = resume is not None and _VOXELS in resume
    if resume is not None and at_splats:
        (volume,) = state_arrays(resume, [_VOXELS])
        first = Reconstruction(volume, scan.grid)
    else:
        told = _part(report, 0, total, lambda state: state, lambda volume: volume)
        first = fista.METHOD.run(scan, options.voxels(), rt, seed=seed, report=told, resume=resume, initial=initial)
        if first.state is not None:  # interrupted
            return replace(first, facts=_facts(options, first, None, first.facts["interrupted_at"]))

    def both(volume: np.ndarray) -> np.ndarray:
        mean: np.ndarray = first.volume + np.float32(options.splat_weight) * (volume - first.volume)
        return mean

    told = _part(report, before, total, lambda state: {**state, _VOXELS: first.volume}, both)
    left = None if not at_splats or resume is None else {name: a for name, a in resume.items() if name != _VOXELS}
    second = phyradgs.METHOD.run(
        scan, options.splats(), rt, seed=seed, report=told, resume=left, initial=np.maximum(first.volume, 0)
    )
    at = second.facts["interrupted_at"]
    facts = _facts(options, first, second, None if at is None else before + at)
    record = first.record + [{**line, "iteration": before + line["iteration"]} for line in second.record]
    state = None if second.state is None else {**second.state, _VOXELS: first.volume}
    return Reconstruction(both(second.volume), scan.grid, second.gaussians, record, facts, state)


METHOD = Method(fused, {"default": FusedOptions()}, takes_initial=True)


def _facts(
    options: FusedOptions, first: Reconstruction, second: Reconstruction | None, interrupted_at: int | None
) -> dict[str, object]:
    halves = {"voxels": first.facts} if second is None else {"voxels": first.facts, "splats": second.facts}
    facts: dict[str, object] = {
        "method": "fused",
        "options": option_facts(options),
        **halves,
        "seconds": sum(half.get("seconds", 0.0) for half in halves.values()),
        "interrupted_at": interrupted_at,
    }
    if second is not None:
        facts["disagreement_per_mm"] = float(np.std(second.volume - first.volume, dtype=np.float64) / 2)
    return facts


def _part(
    report: ProgressReport,
    before: int,
    total: int,
    whole_state: Callable[[State], State],
    whole_volume: Callable[[np.ndarray], np.ndarray],
) -> ProgressReport:
    """Reports of one half as of the whole run."""

    def told(progress: Progress) -> None:
        state, volume = progress.state, progress.volume

        def present() -> tuple[np.ndarray, Grid]:
            assert volume is not None
            values, grid = volume()
            return whole_volume(values), grid

        report(
            replace(
                progress,
                iteration=before + progress.iteration,
                iterations=total,
                state=None if state is None else lambda: whole_state(state()),
                volume=None if volume is None else present,
            )
        )

    return told
