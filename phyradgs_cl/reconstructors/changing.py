"""``changing``: reconstructs an object that changes during the scan as volumes at successive times, its states.

It minimises ½‖p − A x‖² + R(x) for x ≥ 0, with the frames p and the stack x of states. A projects each state to the detector
lines exposed near its time. R is the total variation of each state in space, and of each voxel in time. Because of R, most
voxels keep their value from state to state, and a state also uses views of other times. The steps are those of ``fista``.
Total variation in space and time: L. Ritschl et al., Iterative 4D cardiac micro-CT image reconstruction using an
adaptive spatio-temporal sparsity prior, Phys. Med. Biol. 57 (2012) 1517."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow, Scan
from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.fields import States
from phyradgs_cl.objective import TvProx
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import Reconstruction, through
from phyradgs_cl.reconstructors.voxels.fista import Fista
from phyradgs_cl.reconstructors.voxels.priors import PriorWeight, TvPrior, axis_weights, frame_error
from phyradgs_cl.reconstructors.voxels.run import Iterations, IterativeOptions, MethodRun
from phyradgs_cl.runtime import Runtime

_STACKS = 18  # number of stacks, each of all states, that the method holds in memory at one time
_FRAMES = 3  # number of arrays of all frames that the method holds in memory at one time


@dataclass(frozen=True)
class ChangingOptions(IterativeOptions):
    """Options of ``changing``.

    - states: number of states of the object, at most one per frame. Successive frames are shared evenly among the states.
    - prior_weight: weight of total variation in space, relative to the error of the data term's gradient.
    - time_weight: weight of a voxel's change from one state to the next, relative to an equal difference between
      neighbouring voxels.
    - subsets: number of subsets of the frames, each with one step in a pass. At most 2 · (frames per state) are used.
      tv_iterations: dual iterations per proximal map of total variation."""

    TRIALS: ClassVar[tuple[int, int]] = (1, 8)
    """Numbers of iterations of the two short runs that ``estimate`` times. Both runs begin with the slower first pass."""

    motion: Motion = PerRow()
    iterations: int = 40
    states: int = checks.ranged(30, 1, 1000)
    prior_weight: float = checks.ranged(0.42, 0, 1e6)
    time_weight: float = checks.ranged(10.0, 0, 1000)
    subsets: int = checks.ranged(5, 1, 1_000_000)
    tv_iterations: int = checks.ranged(8, 1, 10_000)


def changing(scan: Scan, options: ChangingOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    """Returns the object's states in 1/mm, and their mean as the volume. ``arguments``: further fields of ``MethodRun``, of
    which ``seed`` has no effect."""
    times_s = state_times_s(scan, options.states)
    shape = (len(times_s), *scan.grid.shape)
    run = MethodRun(scan, options, rt, state_times_s=times_s, **arguments)
    report = through(lambda progress: replace(progress, states=states), run.report)
    run = replace(run, initial=None if run.initial is None else np.broadcast_to(run.initial, shape), report=report)
    try:
        system = run.system(volumes=_STACKS, frames=_FRAMES)
        prox = TvProx(rt, shape, (options.time_weight, *axis_weights(scan.grid)))
        weight = PriorWeight(system, frame_error(scan, options.motion), options.prior_weight)
        prior, nonnegative = TvPrior(prox, options.tv_iterations), options.nonnegative
        # a subset with less than half a frame for each state would make too long steps, which diverge
        subsets = min(options.subsets, 2 * scan.frames // len(times_s))
        method = Fista(system, prior, weight, subsets=subsets, nonnegative=nonnegative)

        def states() -> States:
            return States(times_s, system.space.numpy(method.volume))

        result = run.result("changing", Iterations(method, run))
    except OutOfMemoryError as error:
        error.remedy = f"take fewer of the {len(times_s)} states with --set states=N, or a smaller --size"
        raise
    return replace(result, states=states())


def state_times_s(scan: Scan, count: int) -> np.ndarray:
    """Returns the times (K,) in s of at most ``count`` states: the mean times of K equal groups of successive frames."""
    middles_s = np.unique(scan.middle_times_s)
    shares = np.array_split(middles_s, min(count, len(middles_s)))
    return np.array([share.mean() for share in shares])


METHOD = Method(changing, {"default": ChangingOptions()}, takes_initial=True, finds_motion=True)
