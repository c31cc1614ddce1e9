"""SIRT: every iteration corrects for all frames at once (Gilbert, J. Theor. Biol. 36 (1972) 105)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    state_arrays,
)
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, run_iterations
from phyradgs_cl.reconstructors.voxels.system import System, norm, reciprocal, row_weights
from phyradgs_cl.runtime import Runtime


@dataclass(frozen=True)
class SirtOptions(IterativeOptions):
    """relaxation: λ between 0 and 2. transmission_weights: transmission-weighted (PWLS), R = t/(A 1), C = 1/(Aᵀ t)."""

    iterations: int = 100
    relaxation: float = 1.0
    transmission_weights: bool = False  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.within("relaxation", self.relaxation, 1e-6, 2)


def sirt(
    scan: Scan,
    options: SirtOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
) -> Reconstruction:
    """The SIRT volume of a scan in 1/mm. ``seed`` is accepted for the common signature; SIRT draws nothing."""
    return run_iterations("sirt", lambda s: Sirt(s, options), scan, options, rt, report, resume)


METHOD = Method(sirt, {"default": SirtOptions()}, is_shared=True)


class Sirt:
    """x ← x + λ C Aᵀ R (p − A x), R = 1/(A 1), C = 1/(Aᵀ 1); Jᵀ and I(x) in the intensity model.

    The residual that is reported is the one before the correction: √R ‖·‖ of it falls without exception.
    """

    def __init__(self, system: System, options: SirtOptions) -> None:
        self.system, self.options = system, options
        self.volume = np.zeros(system.operator.volume_shape, np.float32)
        self.finished: str | None = None
        self._rows = row_weights(system)
        self._columns = reciprocal(system.column_sums()) * np.float32(options.relaxation)

    def step(self) -> float:
        residual = self.system.residual(self.volume)
        volume = self.volume + self._columns * self.system.back(self._rows * residual)
        self.volume = np.maximum(volume, 0) if self.options.nonnegative else volume
        return norm(residual)

    def state(self) -> dict[str, np.ndarray]:
        return {"volume": self.volume}

    def restore(self, state: State) -> None:
        (self.volume,) = state_arrays(state, ["volume"])
