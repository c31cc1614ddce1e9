"""SIRT: every iteration corrects for all frames at once (Gilbert, J. Theor. Biol. 36 (1972) 105)."""

from dataclasses import dataclass

from phyradgs_cl.checks import ranged
from phyradgs_cl.reconstructors.voxels.run import Algorithm, IterativeOptions, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System, column_weights, row_weights


@dataclass(frozen=True)
class SirtOptions(IterativeOptions):
    """relaxation: λ between 0 and 2. transmission_weights: transmission-weighted (PWLS), R = t/(A 1), C = 1/(Aᵀ t)."""

    iterations: int = 100
    relaxation: float = ranged(1.0, 1e-6, 2)
    transmission_weights: bool = False  # type: ignore[misc]


class Sirt(Algorithm):
    """x ← x + λ C Aᵀ R (p − A x), R = 1/(A 1), C = 1/(Aᵀ 1). The intensity model replaces Aᵀ by Jᵀ and A x by I(x).

    The residual is that before the correction, of which √R ‖·‖ falls in every step."""

    def __init__(self, system: System, options: SirtOptions) -> None:
        super().__init__(system)
        self.options = options
        self._rows, self._columns = row_weights(system), column_weights(system)

    def step(self) -> float:
        space, options = self.system.space, self.options
        residual = self.system.residual(self.volume)
        update = self.system.back(space.multiply(residual, self._rows))
        self.volume = space.add_product(
            self.volume, self._columns, update, options.relaxation, nonnegative=options.nonnegative
        )
        return space.norm(residual)


METHOD = voxel_method("sirt", SirtOptions(), lambda system, options, _: Sirt(system, options), volumes=4, frames=1)
