"""CGLS: conjugate gradients on the normal equations (Hestenes and Stiefel, J. Res. NBS 49 (1952) 409)."""

from dataclasses import dataclass
from typing import Any

from phyradgs_cl.checks import ranged
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.voxels.run import Algorithm, IterativeOptions, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System


@dataclass(frozen=True)
class CglsOptions(IterativeOptions):
    """Options of CGLS. noise_stop: the run ends once the residual is at most this many times the estimated noise; 0: never.
    nonnegative must stay False, because CGLS does not clip."""

    iterations: int = 60
    nonnegative: bool = False
    noise_stop: float = ranged(1.1, 0, 1e6)  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nonnegative:
            raise InputError("nonnegative", "true", "false for --method cgls", "use sirt or fista-tv")


class Cgls(Algorithm):
    """Minimises ‖p − A x‖ over the Krylov spaces of AᵀA from x = 0. An iteration's residual is the one after its step.

    In the intensity model the residual is p − I(x), with I(x) the expected measurement, and the derivative J of I replaces
    A. Directions then combine as in nonlinear conjugate gradients (Polak and Ribière 1969). For a linear I both iterations
    are the same."""

    ARRAYS = ("volume", "residual", "direction", "gradient")
    NUMBERS = ("gamma",)

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self.residual = system.measured
        self.gradient = self.direction = system.adjoint(self.residual)
        self.gamma = system.space.inner(self.gradient, self.gradient)

    def start_from(self, volume: Any) -> None:
        self.volume = volume
        self.residual = self.system.residual(volume)
        self.gradient = self.direction = self.system.back(self.residual)
        self.gamma = self.system.space.inner(self.gradient, self.gradient)

    def step(self) -> float:
        space = self.system.space
        projected = self.system.derivative(self.direction)
        energy = space.inner(projected, projected)
        # with a gradient of 0, or a direction that no frame sees, nothing is left to minimise
        if self.gamma == 0 or energy == 0:
            self.finished = "exact solution"
            return space.norm(self.residual)
        is_linear = self.system.intensity is None
        slope = self.gamma if is_linear else space.inner(self.gradient, self.direction)
        alpha = slope / energy
        self.volume = space.add(self.volume, self.direction, alpha)
        self.residual = space.add(self.residual, projected, -alpha) if is_linear else self.system.residual(self.volume)
        gradient = self.system.back(self.residual)
        gamma = space.inner(gradient, gradient)
        overlap = 0.0 if is_linear else space.inner(gradient, self.gradient)
        beta = max(gamma - overlap, 0.0) / self.gamma
        self.direction = space.add(gradient, self.direction, beta)
        self.gradient, self.gamma = gradient, gamma
        return space.norm(self.residual)


METHOD = voxel_method("cgls", CglsOptions(), lambda system, options, _: Cgls(system), volumes=7, frames=3)
