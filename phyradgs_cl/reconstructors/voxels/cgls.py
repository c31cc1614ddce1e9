"""CGLS: conjugate gradients on the normal equations (Hestenes and Stiefel, J. Res. NBS 49 (1952) 409)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import noise_level
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import (
    ProgressReport,
    Reconstruction,
    State,
    ignore_progress,
    state_arrays,
)
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, run_iterations
from phyradgs_cl.reconstructors.voxels.system import System, inner, norm
from phyradgs_cl.runtime import Runtime


@dataclass(frozen=True)
class CglsOptions(IterativeOptions):
    """CGLS does not clip: there is no ``nonnegative``.

    noise_stop: the run ends when the residual falls to this many times the noise of the measurement, which is estimated
    from it (discrepancy principle, Morozov 1966); below it CGLS fits the noise. 0 runs all iterations.
    """

    iterations: int = 60
    nonnegative: bool = False
    noise_stop: float = 1.1

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.within("noise_stop", self.noise_stop, 0, 1e6)
        if self.nonnegative:
            raise InputError("nonnegative", "true", "false for --method cgls", "use sirt or fista-tv")


def cgls(
    scan: Scan,
    options: CglsOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
) -> Reconstruction:
    """The least-squares volume of a scan in 1/mm, as far as the iterations get. CGLS draws nothing from ``seed``."""

    def make(system: System) -> Cgls:
        pixels = system.measured.size if system.valid is None else np.count_nonzero(system.valid)
        noise = noise_level(system.measured, system.valid) * np.sqrt(pixels)
        return Cgls(system, options.noise_stop * noise)

    return run_iterations("cgls", make, scan, options, rt, report, resume)


METHOD = Method(
    cgls, {"default": CglsOptions()}, is_shared=True, stops_itself=lambda options: options.noise_stop > 0
)


class Cgls:
    """min ‖p − A x‖ over the Krylov spaces of AᵀA from x = 0, until the residual's norm is ``enough`` or less.

    The residual that is reported is the new one. In the intensity model it is p − I(x), J takes A's place, and
    directions combine as in nonlinear conjugate gradients (Polak and Ribière 1969), which is the same where I is linear.
    """

    def __init__(self, system: System, enough: float = 0.0) -> None:
        self.system, self.enough = system, enough
        self.volume = np.zeros(system.operator.volume_shape, np.float32)
        self.finished: str | None = None
        self.residual = system.measured.astype(np.float32)
        self.gradient = system.operator.adjoint(self.residual)
        self.direction = self.gradient
        self.gamma = inner(self.gradient, self.gradient)

    def step(self) -> float:
        projected = self.system.derivative(self.direction)
        energy = inner(projected, projected)
        if self.gamma == 0 or energy == 0:
            self.finished = "exact solution"
            return norm(self.residual)
        linear = self.system.intensity is None
        slope = self.gamma if linear else inner(self.gradient, self.direction)
        alpha = np.float32(slope / energy)
        self.volume = self.volume + alpha * self.direction
        self.residual = self.residual - alpha * projected if linear else self.system.residual(self.volume)
        gradient = self.system.back(self.residual)
        gamma = inner(gradient, gradient)
        turned = 0.0 if linear else inner(gradient, self.gradient)
        beta = np.float32(max(gamma - turned, 0.0) / self.gamma)
        self.direction = gradient + beta * self.direction
        self.gradient, self.gamma = gradient, gamma
        length = norm(self.residual)
        if length <= self.enough:
            self.finished = "residual as small as the noise"
        return length

    def state(self) -> dict[str, np.ndarray]:
        return {
            "volume": self.volume,
            "residual": self.residual,
            "direction": self.direction,
            "gradient": self.gradient,
            "gamma": np.array(self.gamma),
        }

    def restore(self, state: State) -> None:
        arrays = state_arrays(state, list(self.state()))
        self.volume, self.residual, self.direction, self.gradient, gamma = arrays
        self.gamma = float(gamma)
        self.system.stand_at(self.volume)
