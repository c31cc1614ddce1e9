"""ASD-POCS: a SART pass, then a few steps down the total variation (TV), kept in balance with the pass's change.

Sidky and Pan, Phys. Med. Biol. 53 (2008) 4777, with the step control of TIGRE (Biguri et al. 2016)."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.checks import ranged
from phyradgs_cl.objective import TvDescent
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.voxels.run import Algorithm, MethodRun, voxel_method
from phyradgs_cl.reconstructors.voxels.sart import Sart, SartOptions, held_volumes
from phyradgs_cl.reconstructors.voxels.system import System


@dataclass(frozen=True)
class AsdPocsOptions(SartOptions):
    """Options of ASD-POCS. tv_steps: TV steps per iteration. tv_share: α. The first TV steps are α times as long as the
    change by the first SART pass.

    tv_reduction: factor on the length of TV steps after an iteration whose TV steps change the volume by more than
    ``tv_ratio`` (r_max) times the SART pass's change, while the residual is above ε. residual_share: ε as a fraction of the
    FDK volume's residual."""

    iterations: int = 10
    relaxation_reduction: float = 0.9999
    tv_steps: int = ranged(20, 0, 10_000)
    tv_share: float = ranged(0.002, 0, 10)
    tv_reduction: float = ranged(0.95, 1e-6, 1)
    tv_ratio: float = ranged(0.94, 0, 1e6)
    residual_share: float = ranged(0.15, 0, 1e6)


class AsdPocs(Algorithm):
    """ASD-POCS. An iteration's residual is that of the volume after its SART pass, before its TV steps."""

    def __init__(self, system: System, options: AsdPocsOptions, descend: TvDescent, epsilon: float) -> None:
        super().__init__(system)
        self.options, self.descend, self.epsilon = options, descend, epsilon
        self.sart = Sart(system, options)
        self.tv_step = 0.0

    def step(self) -> float:
        options, space = self.options, self.system.space
        self.sart.volume = self.volume
        self.sart.step()
        by_data = space.add(self.sart.volume, self.volume, -1.0)
        data_length = space.norm(by_data)
        residual = space.norm(self.system.residual(self.sart.volume))
        if self.tv_step == 0:
            self.tv_step = options.tv_share * data_length
        self.volume = self.descend(self.sart.volume, self.tv_step, options.tv_steps)
        by_tv = space.add(self.volume, self.sart.volume, -1.0)
        tv_length = space.norm(by_tv)
        if tv_length > options.tv_ratio * data_length and residual > self.epsilon:
            self.tv_step *= options.tv_reduction
        cosine = space.inner(by_tv, by_data) / max(tv_length * data_length, 1e-30)
        # if data and TV steps undo each other, more iterations would only alternate between the two
        if cosine < -0.99 and residual <= self.epsilon:
            self.finished = "data and TV in balance"
        return residual

    def state(self) -> dict[str, np.ndarray]:
        self.sart.volume = self.volume
        return {**self.sart.state(), "tv_step": np.array(self.tv_step)}

    def restore(self, state: State) -> None:
        self.sart.restore(state)
        self.volume = self.sart.volume
        self.tv_step = float(state["tv_step"])


def _started(system: System, options: AsdPocsOptions, run: MethodRun) -> AsdPocs:
    start = system.space.array(static_fdk(run.rt, run.scan, run.deformation))
    epsilon = options.residual_share * system.space.norm(system.residual(start))
    return AsdPocs(system, options, TvDescent(run.rt, run.scan.grid.shape), epsilon)


METHOD = voxel_method(
    "asd-pocs", AsdPocsOptions(), _started, frames=2,
    volumes=lambda scan, options: held_volumes(scan, options) + 4,  # SART's, and 4 to compare lengths of steps
)
