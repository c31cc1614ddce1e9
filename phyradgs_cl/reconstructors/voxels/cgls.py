"""CGLS: conjugate gradients on the normal equations (Hestenes and Stiefel, J. Res. NBS 49 (1952) 409)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.result import State, state_arrays
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System


@dataclass(frozen=True)
class CglsOptions(IterativeOptions):
    """CGLS does not clip: there is no ``nonnegative``.

    noise_stop: as of ``sart``.
    """

    iterations: int = 60
    nonnegative: bool = False
    noise_stop: float = 1.1  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nonnegative:
            raise InputError("nonnegative", "true", "false for --method cgls", "use sirt or fista-tv")


METHOD = voxel_method("cgls", CglsOptions(), lambda system, options, _: Cgls(system), volumes=7, frames=3)


class Cgls:
    """min ‖p − A x‖ over the Krylov spaces of AᵀA from x = 0.

    The residual that is reported is the new one. In the intensity model it is p − I(x), J takes A's place, and
    directions combine as in nonlinear conjugate gradients (Polak and Ribière 1969), which is the same where I is linear.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.volume = system.space.full(system.volume_shape, 0.0)
        self.finished: str | None = None
        self.residual = system.measured
        self.gradient = system.adjoint(self.residual)
        self.direction = self.gradient
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
        if self.gamma == 0 or energy == 0:
            self.finished = "exact solution"
            return space.norm(self.residual)
        linear = self.system.intensity is None
        slope = self.gamma if linear else space.inner(self.gradient, self.direction)
        alpha = slope / energy
        self.volume = space.add(self.volume, self.direction, alpha)
        self.residual = space.add(self.residual, projected, -alpha) if linear else self.system.residual(self.volume)
        gradient = self.system.back(self.residual)
        gamma = space.inner(gradient, gradient)
        turned = 0.0 if linear else space.inner(gradient, self.gradient)
        beta = max(gamma - turned, 0.0) / self.gamma
        self.direction = space.add(gradient, self.direction, beta)
        self.gradient, self.gamma = gradient, gamma
        return space.norm(self.residual)

    def state(self) -> dict[str, np.ndarray]:
        arrays = {
            "volume": self.volume,
            "residual": self.residual,
            "direction": self.direction,
            "gradient": self.gradient,
        }
        on_host = {name: self.system.space.numpy(array) for name, array in arrays.items()}
        return {**on_host, "gamma": np.array(self.gamma)}

    def restore(self, state: State) -> None:
        *arrays, gamma = state_arrays(state, ["volume", "residual", "direction", "gradient", "gamma"])
        self.volume, self.residual, self.direction, self.gradient = map(self.system.space.array, arrays)
        self.gamma = float(gamma)
        self.system.linearise_at(self.volume)
