"""FISTA-TV: min ½‖p − A x‖² + λ TV(x), x ≥ 0, by accelerated proximal gradients.

Beck and Teboulle, SIAM J. Imaging Sci. 2 (2009) 183 and IEEE Trans. Image Process. 18 (2009) 2419; restart of the momentum:
O'Donoghue and Candès, Found. Comput. Math. 15 (2015) 715.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.objective import TvProx
from phyradgs_cl.reconstructors.result import State, state_arrays
from phyradgs_cl.reconstructors.voxels.priors import axis_weights
from phyradgs_cl.reconstructors.voxels.run import IterativeOptions, Setting, voxel_method
from phyradgs_cl.reconstructors.voxels.system import System

_ARRAYS = ("volume", "previous", "projected", "projected_previous")


@dataclass(frozen=True)
class FistaTvOptions(IterativeOptions):
    """tv_weight: λ as a share of the largest value of Aᵀp, so that units and doses do not matter.

    tv_iterations: dual iterations per proximal map; it goes on from the last one's dual. transmission_weights: least
    squares weighted by transmission (PWLS), ½ Σ t (p − A x)², and λ is a share of the largest value of Aᵀ t p.
    """

    iterations: int = 100
    tv_weight: float = 0.001
    tv_iterations: int = 10
    transmission_weights: bool = False  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.within("tv_weight", self.tv_weight, 0, 1e6)
        checks.within("tv_iterations", self.tv_iterations, 1, 10_000)


def _started(system: System, options: FistaTvOptions, setting: Setting) -> "FistaTv":
    grid = setting.scan.grid
    return FistaTv(system, options, TvProx(setting.rt, grid.shape, axis_weights(grid)))


METHOD = voxel_method("fista-tv", FistaTvOptions(), _started, volumes=12, frames=3)


class FistaTv:
    """The residual that is reported is that of the new volume; A is linear, so momentum needs no projection of its own.

    In the intensity model I(x) and Jᵀ at x stand in for A x and Aᵀ; what momentum's straight line misses of them vanishes
    with the steps.
    """

    def __init__(self, system: System, options: FistaTvOptions, prox: TvProx) -> None:
        self.system, self.options, self.prox = system, options, prox
        space = system.space
        self.volume = space.full(system.volume_shape, 0.0)
        self.previous = self.volume
        self.projected = space.full(system.measured.shape, 0.0)
        self.projected_previous = self.projected
        self.momentum = 1.0
        self.finished: str | None = None
        # AᵀA has no negative entry: its largest row sum bounds its norm
        self.curvature = space.largest(system.adjoint(system.apply_weights(system.row_sums()))) or 1.0
        gradient = system.adjoint(system.apply_weights(system.measured))
        self.tv_weight = options.tv_weight * space.largest(gradient, absolute=True)

    def start_from(self, volume: Any) -> None:
        self.volume = self.previous = volume
        self.projected = self.projected_previous = self.system.expected(volume)

    def step(self) -> float:
        system, space, options = self.system, self.system.space, self.options
        following = float((1 + np.sqrt(1 + 4 * self.momentum**2)) / 2)
        beta = (self.momentum - 1) / following
        point = space.add(self.volume, system.difference(self.volume, self.previous), beta)
        projected = space.add(self.projected, system.difference(self.projected, self.projected_previous), beta)
        gradient = system.back(system.apply_weights(system.difference(system.measured, projected)))
        moved = space.add(point, gradient, 1 / self.curvature)
        prox = partial(
            self.prox,
            weight=self.tv_weight / self.curvature,
            iterations=options.tv_iterations,
            nonnegative=options.nonnegative,
        )
        volume = space.apply(prox, moved, system.volume_shape)
        uphill = space.inner(system.difference(point, volume), system.difference(volume, self.volume)) > 0
        self.previous, self.volume = self.volume, volume
        self.projected_previous, self.projected = self.projected, system.expected(volume)
        self.momentum = 1.0 if uphill else following
        return space.norm(system.difference(system.measured, self.projected))

    def state(self) -> dict[str, np.ndarray]:
        arrays = (self.volume, self.previous, self.projected, self.projected_previous)
        on_host = dict(zip(_ARRAYS, map(self.system.space.numpy, arrays), strict=True))
        return {**on_host, "momentum": np.array(self.momentum), "dual": self.prox.dual}

    def restore(self, state: State) -> None:
        *arrays, momentum, dual = state_arrays(state, [*_ARRAYS, "momentum", "dual"])
        self.volume, self.previous, self.projected, self.projected_previous = map(self.system.space.array, arrays)
        self.momentum, self.prox.dual = float(momentum), dual
        self.system.linearise_at(self.volume)
