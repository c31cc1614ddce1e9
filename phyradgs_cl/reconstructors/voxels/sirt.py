"""SIRT: every iteration corrects for all frames at once (Gilbert, J. Theor. Biol. 36 (1972) 105)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.reconstructors.result import State, state_arrays
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System, column_weights, row_weights


@dataclass(frozen=True)
class SirtOptions(IterativeOptions):
    """relaxation: λ between 0 and 2. transmission_weights: transmission-weighted (PWLS), R = t/(A 1), C = 1/(Aᵀ t)."""

    iterations: int = 100
    relaxation: float = 1.0
    transmission_weights: bool = False  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.within("relaxation", self.relaxation, 1e-6, 2)


METHOD = voxel_method("sirt", SirtOptions(), lambda system, options, _: Sirt(system, options), volumes=4, frames=1)


class Sirt:
    """x ← x + λ C Aᵀ R (p − A x), R = 1/(A 1), C = 1/(Aᵀ 1); Jᵀ and I(x) in the intensity model.

    The residual that is reported is the one before the correction: √R ‖·‖ of it falls without exception.
    """

    def __init__(self, system: System, options: SirtOptions) -> None:
        self.system, self.options = system, options
        self.volume = system.space.full(system.volume_shape, 0.0)
        self.finished: str | None = None
        self._rows, self._columns = row_weights(system), column_weights(system)

    def start_from(self, volume: Any) -> None:
        self.volume = volume

    def step(self) -> float:
        space, options = self.system.space, self.options
        residual = self.system.residual(self.volume)
        update = self.system.back(space.multiply(residual, self._rows))
        self.volume = space.add_product(
            self.volume, self._columns, update, options.relaxation, nonnegative=options.nonnegative
        )
        return space.norm(residual)

    def state(self) -> dict[str, np.ndarray]:
        return {"volume": self.system.space.numpy(self.volume)}

    def restore(self, state: State) -> None:
        (volume,) = state_arrays(state, ["volume"])
        self.volume = self.system.space.array(volume)
