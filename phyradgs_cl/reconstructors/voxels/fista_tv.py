"""FISTA-TV: min ½‖p − A x‖² + λ TV(x), x ≥ 0, by accelerated proximal gradients.

Beck and Teboulle, IEEE Trans. Image Process. 18 (2009) 2419, on all frames at once, with the momentum of ``fista.py``."""

from dataclasses import dataclass
from typing import Any

from phyradgs_cl.checks import ranged
from phyradgs_cl.objective import TvProx
from phyradgs_cl.reconstructors.voxels.fista import Accelerated
from phyradgs_cl.reconstructors.voxels.priors import TvPrior, axis_weights
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, MethodRun, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System


@dataclass(frozen=True)
class FistaTvOptions(IterativeOptions):
    """Options of FISTA-TV. tv_weight: λ/max|Aᵀp|, so that one value suits scans of any unit and dose.

    tv_iterations: dual iterations per proximal map, begun from the dual field of the map before. transmission_weights: least
    squares weighted by the transmission t (PWLS), ½ Σ t (p − A x)²; tv_weight is then λ/max|Aᵀ t p|."""

    iterations: int = 100
    tv_weight: float = ranged(0.001, 0, 1e6)
    tv_iterations: int = ranged(10, 1, 10_000)
    transmission_weights: bool = False  # type: ignore[misc]


class FistaTv(Accelerated):
    """FISTA with TV on all frames at once. An iteration's residual belongs to its new volume.

    A is linear, so A y at the extrapolated point y follows from A xₖ and A xₖ₋₁. The intensity model replaces A x by the
    expected I(x), and Aᵀ by Jᵀ, with the derivative J of I at xₖ. I is not linear, so that I(y) has an error, which vanishes
    as the steps become shorter."""

    ARRAYS = ("volume", "previous", "projected", "projected_previous")

    def __init__(self, system: System, options: FistaTvOptions, prox: TvProx) -> None:
        super().__init__(system, TvPrior(prox, options.tv_iterations))
        self.nonnegative = options.nonnegative
        self.projected = self.projected_previous = system.space.full(system.measured.shape, 0.0)
        gradient = system.adjoint(system.apply_weights(system.measured))
        self.tv_weight = options.tv_weight * system.space.largest(gradient, absolute=True)

    def start_from(self, volume: Any) -> None:
        super().start_from(volume)
        self.projected = self.projected_previous = self.system.expected(volume)

    def step(self) -> float:
        system, space = self.system, self.system.space
        point = space.extrapolate(self.volume, self.previous, self.extrapolation)
        projected = space.extrapolate(self.projected, self.projected_previous, self.extrapolation)
        gradient = system.back(system.apply_weights(space.add(system.measured, projected, -1.0)))
        descended = space.add(point, gradient, 1 / self.curvature)
        volume = self.prior(space, descended, self.tv_weight / self.curvature, nonnegative=self.nonnegative)
        self.accept(point, volume)
        self.projected_previous, self.projected = self.projected, system.expected(self.volume)
        return space.norm(space.add(system.measured, self.projected, -1.0))


def _started(system: System, options: FistaTvOptions, run: MethodRun) -> FistaTv:
    grid = run.scan.grid
    return FistaTv(system, options, TvProx(run.rt, grid.shape, axis_weights(grid)))


METHOD = voxel_method("fista-tv", FistaTvOptions(), _started, volumes=12, frames=3)
