"""A prior over ordered subsets of the frames: min ½‖p − A x‖² + R(x), x ≥ 0, by POGM and FISTA.

Each subset S, one of M, makes one step. FISTA's is xₖ = prox(yₖ + M/L · A_Sᵀ (p_S − A_S yₖ)), yₖ₊₁ = xₖ + βₖ₊₁ (xₖ − xₖ₋₁)
(Beck and Teboulle, SIAM J. Imaging Sci. 2 (2009) 183, Eqs. 4.1 to 4.3). The proximal optimised gradient method, POGM, needs
a third fewer steps (Taylor, Hendrickx and Glineur, SIAM J. Optim. 27 (2017) 1283; Kim and Fessler, J. Optim. Theory Appl.
178 (2018) 240), but leaves more of the noise that subsets cause. Therefore the last passes are FISTA's.

The gradient of a subset, times the number of subsets, stands for that of all frames (Kim, Ramani and Fessler, IEEE Trans.
Med. Imaging 34 (2015) 167). L is a Lipschitz constant of the gradient: it bounds the norm of AᵀA.

On small grids the last 7/13 of the iterations run on smaller voxels, whose means make up most of the result (``stages.py``).
The first 6/13 only provide a first volume, so they are coarser: an iteration is two quick passes, with more subsets and
fewer times in an exposure. All these passes are FISTA's, because POGM diverges with so many subsets.

The calls of a run: ``MethodRun``, ``Stages``, ``fista_stage``; then ``Loop``, ``Iterations.step``, ``Fista.step``,
``System``, ``RayOperator``, a kernel. ``fista_stage`` projects first, for the ``PriorWeight`` and the step size."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields.volume import MOST_VOXELS
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import Reconstruction
from phyradgs_cl.reconstructors.voxels import priors
from phyradgs_cl.reconstructors.voxels.priors import Denoiser, Prior, PriorWeight, frame_error
from phyradgs_cl.reconstructors.voxels.run import Algorithm, Iterations, IterativeOptions, MethodRun
from phyradgs_cl.reconstructors.voxels.stages import STAGES, Stage, Stages, merge_subvoxels, repeated
from phyradgs_cl.reconstructors.voxels.system import OrderedSubsets, System
from phyradgs_cl.removed import refuse_removed
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.algebra import HostSpace

log = logging.getLogger(__name__)
_VOLUMES = 16  # number of volumes that a run with the prior ``dct`` holds in memory at one time
_FRAMES = 3  # number of arrays of all frames that a run holds in memory at one time
_HELD = 9  # number of volumes that the prior ``dct`` keeps on the device, even if the run's arrays are on the host
_COPIES = 2  # number of volumes, input and result, that a map of a prior needs on the device for a volume of the host
# These values were chosen by measurement: docs/results/settings.md.
_SUBVOXELS = "subvoxels"  # name of the stage on divided voxels
_COARSE_SHARE = 6 / 13  # fraction of the iterations that are coarse: all before the voxels are divided
_COARSE_PASSES = 2  # number of passes in a coarse iteration: they cost little, and scans with few views or photons need many
_COARSE_SUBSETS = 1.6  # (number of subsets in a coarse pass)/(option ``subsets``)
_COARSE_TIMES = 1 / 3  # (times per exposure in a coarse pass)/(times in another pass); a coarse pass has at least two
# On smaller voxels a map of the prior takes as long as the rays of a subset. So one map serves _STEPS_PER_MAP steps,
# until the last _FULL_PASSES passes. In these every step has its map, which removes the noise of the passes before.
_STEPS_PER_MAP = 3
_FULL_PASSES = 5
_MOST_OPTIMISED = 23  # most iterations by POGM: its momentum never restarts, and the noise that subsets cause grows with it
_CALM = 3  # number of last iterations by FISTA in a run on one grid: they remove the noise that subsets cause
_FAINTEST = 1e-6  # smaller row sums of AᵀA count as this fraction of the largest, since less would inflate the bound
# Voxels are divided if a slice (y, x) has at most this many of them: dividing is worth its time at 64³, not at 128³.
# Slices are not counted, so that thick and thin slabs of one scan are reconstructed in the same manner.
_MOST_DIVIDED = 90**2


@dataclass(frozen=True)
class FistaOptions(IterativeOptions):
    """Options of FISTA.

    - prior: one of ``PRIORS``, a user's function, or its ``package.module:function``. A function takes (volume (nz, ny, nx)
      in 1/mm, weight in 1/mm) and returns a volume; docs/methods.md says how to scale a denoiser.
    - prior_share: s in the prior piccs, (1 − s) TV(x) + s TV(x − first volume).
    - prior_weight: strength of the prior, relative to the error of the data term's gradient. This error comes from noise of
      the frames and from edges inside large voxels.
    - subvoxels: number of parts of a voxel's side in the last 7/13 of the iterations; 0 takes 2 for slices of up to 90²
      voxels where memory allows, else 1.
    - subsets: number of subsets of the frames, each with one step; iterations before smaller voxels have 1.6 times as many.
      Subsets whose steps diverge are joined two by two. tv_iterations: dual iterations per proximal map of TV.
    - transmission_weights: weights pixels by their transmission, as in ``fista-tv``."""

    FUNCTIONS: ClassVar[tuple[str, ...]] = ("prior",)
    """Options that may be a function."""

    TRIALS: ClassVar[tuple[int, int]] = (2, 7)
    """Numbers of iterations of the two short runs that ``estimate`` times. Of the five more, two are coarse: about 6/13."""

    motion: Motion = PerRow()
    iterations: int = 26
    prior: str | Denoiser = "ridge"
    prior_weight: float = checks.ranged(0.39, 0, 1e6)
    subvoxels: int = checks.ranged(0, 0, 8)
    prior_share: float = checks.ranged(0.5, 0, 1)
    subsets: int = checks.ranged(5, 1, 1_000_000)
    tv_iterations: int = checks.ranged(3, 1, 10_000)
    transmission_weights: bool = False  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (callable(self.prior) or ":" in self.prior):
            refuse_removed(f"--prior {self.prior}")
            checks.one_of("prior", self.prior, (*priors.PRIORS, "package.module:function"))
        if self.prior != "piccs" and self.prior_share != FistaOptions.prior_share:
            found = f"{self.prior_share:g} with the prior {self.prior}"
            raise InputError("prior_share", found, "the prior piccs", "set prior=piccs, or leave prior_share out")


class Accelerated(Algorithm):
    """A proximal gradient method with FISTA's momentum, which restarts when it has carried a step past a minimum.

    The restart is the gradient scheme of O'Donoghue and Candès, Found. Comput. Math. 15 (2015) 715. has_long_steps: takes a
    smaller Lipschitz constant, found by one more pass, so that steps are longer."""

    ARRAYS: ClassVar[tuple[str, ...]] = ("volume", "previous")
    NUMBERS: ClassVar[tuple[str, ...]] = ("momentum",)

    def __init__(self, system: System, prior: Prior, *, has_long_steps: bool = False) -> None:
        super().__init__(system)
        self.prior = prior
        self.previous = self.volume
        self.momentum = 1.0  # tₖ of Beck and Teboulle, 1 for the first step
        self.curvature = (_tight_curvature if has_long_steps else _curvature)(system) or 1.0  # L ≥ ‖AᵀA‖

    def start_from(self, volume: Any) -> None:
        self.volume = self.previous = volume

    @property
    def next_momentum(self) -> float:
        """The number tₖ₊₁ of Beck and Teboulle's Eq. 4.2, from which ``extrapolation`` follows."""
        return float((1 + np.sqrt(1 + 4 * self.momentum**2)) / 2)

    @property
    def extrapolation(self) -> float:
        """The momentum factor βₖ₊₁ of Beck and Teboulle's Eq. 4.3: the next step starts at xₖ + βₖ₊₁ (xₖ − xₖ₋₁)."""
        return (self.momentum - 1) / self.next_momentum

    def accept(self, point: Any, volume: Any) -> None:
        """Makes ``volume``, the result of the step from the extrapolated ``point``, the present volume."""
        # restart if the step points against the last movement: momentum then carried the point past a minimum
        is_uphill = self.system.space.turn(point, volume, self.volume) > 0
        self.momentum = 1.0 if is_uphill else self.next_momentum
        self.previous, self.volume = self.volume, volume

    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), **self.prior.state()}

    def restore(self, state: State) -> None:
        super().restore(state)
        self.prior.restore(state)


def _row_sums(system: System) -> Any:
    return system.adjoint(system.apply_weights(system.row_sums()))


def _curvature(system: System) -> float:
    """Returns a Lipschitz constant in mm²: the largest row sum of AᵀA bounds its norm, as no entry is negative."""
    return system.space.largest(_row_sums(system))


def _tight_curvature(system: System) -> float:
    """Returns a smaller Lipschitz constant in mm², at the cost of one more pass: the norm of AᵀA is at most the largest (AᵀA
    x)/x of an x > 0 (Collatz and Wielandt). With row sums as x the bound is a sixth smaller than the largest row sum."""
    sums, space = _row_sums(system), system.space
    again = system.adjoint(system.apply_weights(system.forward(sums)))
    bound = space.largest(space.multiply(again, space.reciprocal(sums, _FAINTEST)))
    return min(space.largest(sums), bound)


class Fista(Accelerated):
    """Passes over subsets by POGM, then by FISTA. A pass's residual combines all subsets, each at the point of its gradient.

    passes: number of passes in an iteration, whose residual is that of its last pass. optimised: number of passes by POGM.
    sparing: number of passes in which a map of the prior follows only every third step and the last, with the weights of all
    steps since the map before. POGM's wₖ₋₁ is ``previous``, its zₖ₋₁ ``ahead``, θₖ₋₁ ``momentum``, and L γₖ₋₁ ``length``."""

    ARRAYS = ("volume", "previous", "ahead")
    NUMBERS = ("momentum", "length", "optimised", "sparing")

    def __init__(
        self, system: System, prior: Prior, weight: PriorWeight, *, subsets: int, nonnegative: bool,
        has_long_steps: bool = False, optimised: int = 0, passes: int = 1, sparing: int = 0,
    ) -> None:  # fmt: skip
        super().__init__(system, prior, has_long_steps=has_long_steps)
        self.nonnegative, self.weight, self.optimised, self.passes = nonnegative, weight, optimised, passes
        self.sparing = sparing
        self.subsets = OrderedSubsets(system, subsets)
        self._rest()

    def start_from(self, volume: Any) -> None:
        self.volume = volume
        self._rest()

    def _rest(self) -> None:
        """Forgets all momentum, so that the next step is a plain proximal gradient step from ``volume``."""
        self.momentum = self.length = 1.0
        self.previous = self.ahead = self.volume

    def step(self) -> float:
        return [self._pass() for _ in range(self.passes)][-1]

    def _pass(self) -> float:
        weight = self.weight.at(self.volume)
        self.prior.noise_share = self.weight.noise_share(weight)
        update = self._optimised_update if self.optimised else self._update
        steps = (update(subset, weight, maps) for subset, maps in zip(self.subsets, self._maps(), strict=True))
        residual = self.system.space.sum_squares(steps) ** 0.5
        # joined subsets make steps of another length, for which the present momentum would be wrong
        if self.subsets.join_if_diverging(residual) or self.optimised == 1:
            self._rest()
        self.optimised, self.sparing = max(self.optimised - 1, 0), max(self.sparing - 1, 0)
        return residual

    def _maps(self) -> list[int]:
        """Returns, for each step of a pass, for how many steps the map of the prior after it stands; 0 if no map follows."""
        count, spacing = len(self.subsets), _STEPS_PER_MAP if self.sparing else 1
        maps = [0 if step % spacing else spacing for step in range(1, count)]
        return [*maps, (count - 1) % spacing + 1]

    def _descended(self, point: Any, subset: System) -> tuple[Any, Any]:
        """Returns the volume ``point`` after a gradient step of a subset, and the subset's residual at ``point``."""
        residual = subset.residual(point)
        downhill = subset.back(subset.apply_weights(residual))
        return self.system.space.add(point, downhill, len(self.subsets) / self.curvature), residual

    def _mapped(self, volume: Any, weight: float, maps: int) -> Any:
        """Returns the prior's map of a volume, with ``maps`` · ``weight``, for that many steps at once. With ``maps`` 0 the
        volume is only clipped at 0, if ``nonnegative``."""
        prior = self.prior if maps else Prior()
        return prior(self.system.space, volume, maps * weight, nonnegative=self.nonnegative)

    def _update(self, subset: System, weight: float, maps: int) -> Any:
        """Makes FISTA's step: extrapolation, a subset's gradient, prior. Returns the residual at the extrapolated point."""
        space = self.system.space
        point = space.extrapolate(self.volume, self.previous, self.extrapolation)
        descended, residual = self._descended(point, subset)
        self.accept(point, self._mapped(descended, weight / self.curvature, maps))
        return residual

    def _optimised_update(self, subset: System, weight: float, maps: int) -> Any:
        """Makes POGM's step: a subset's gradient, extrapolation, prior. Returns the residual before the step."""
        space, before, after = self.system.space, self.momentum, self.next_momentum
        descended, residual = self._descended(self.volume, subset)
        back = (before - 1) / (self.length * after)
        # zₖ = wₖ + (θₖ₋₁ − 1)/θₖ (wₖ − wₖ₋₁) + θₖ₋₁/θₖ (wₖ − xₖ₋₁) + (θₖ₋₁ − 1)/(L γₖ₋₁ θₖ) (zₖ₋₁ − xₖ₋₁)
        point = space.extrapolate(descended, self.previous, self.extrapolation)
        for volume, share in ((descended, before / after), (self.ahead, back), (self.volume, -before / after - back)):
            point = space.add(point, volume, share)
        self.length = (2 * before + after - 1) / after
        self.previous, self.ahead, self.momentum = descended, point, after
        self.volume = self._mapped(point, weight * self.length / self.curvature, maps)
        return residual

    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), "subsets": np.array([len(self.subsets), self.subsets.least_residual])}

    def restore(self, state: State) -> None:
        super().restore(state)
        count, self.subsets.least_residual = state["subsets"].tolist()
        self.subsets.split(int(count))


def fista(scan: Scan, options: FistaOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    """Returns the reconstruction in 1/mm of a scan by the method ``fista``. ``arguments``: further fields of ``MethodRun``,
    of which ``seed`` has no effect."""
    run = MethodRun(scan, options, rt, **arguments)
    return run.result("fista", Stages(fista_stages(run, lambda: run), run))


METHOD = Method(fista, {"default": FistaOptions()}, is_shared=True, takes_initial=True, takes_deformation=True)


def fista_stages(run: MethodRun, now: Callable[[], MethodRun]) -> list[Stage]:
    """Returns the stages of a run: on the scan's own voxels and, if the options or the grid's size ask for it, on smaller
    voxels. A stage calls ``now`` for its run when it starts, because the object's motion may be known only then."""
    options = run.options
    # a resumed run keeps its stages, also on a device with another room
    kept = None if run.resume is None else run.resume.get(STAGES)
    gains = _gains_from_subvoxels(run, 2) if kept is None else _SUBVOXELS.encode() in kept.tobytes()
    parts = options.subvoxels or (2 if gains else 1)
    first = round(_COARSE_SHARE * options.iterations) if parts > 1 else 0
    last = options.iterations - first

    def stage(name: str, iterations: int, **how: Any) -> Stage:
        return Stage(name, iterations, partial(fista_stage, now, iterations, **how))

    if parts == 1:
        return [stage("voxels", last, optimised=min(max(last - _CALM, 0), _MOST_OPTIMISED))]
    share = priors.subvoxel_share(options.prior, run.scan.grid.finer(parts).shape)
    fine = replace(stage(_SUBVOXELS, last, parts=parts), merge=partial(merge_subvoxels, parts=parts, share=share))
    return [stage("voxels", first, is_coarse=True), fine]


def _few_times(motion: Motion) -> Motion:
    """Returns a ``PerRow`` motion for coarse passes: a third of its times, but at least two; others unchanged."""
    if not isinstance(motion, PerRow) or motion.sub_intervals <= 2:
        return motion
    return replace(motion, sub_intervals=max(2, math.ceil(_COARSE_TIMES * motion.sub_intervals)))


def fista_stage(
    now: Callable[[], MethodRun], iterations: int, volume: np.ndarray | None, parts: int = 1, is_coarse: bool = False,
    optimised: int = 0,
) -> Iterations:  # fmt: skip
    """Returns a stage of ``iterations`` iterations, on a grid whose voxels are divided into ``parts`` along each side.
    volume (nz, ny, nx): the first volume, on the undivided grid; None: zeros. now: returns the run as it is when the stage
    starts. is_coarse: the iterations only provide the next stage's first volume. optimised: how many of the iterations, the
    first ones, use POGM; the others use FISTA."""
    whole = now()
    scan = replace(whole.scan, grid=whole.scan.grid.finer(parts), reference=None, moving_truth=None)
    options, rt = replace(whole.options, iterations=iterations), whole.rt
    if is_coarse and scan.is_fly:
        options = replace(options, motion=_few_times(options.motion))
    run = replace(whole, scan=scan, options=options, initial=repeated(volume, parts), resume=None)
    system = run.system(volumes=_VOLUMES + priors.kind_of(options.prior).volumes, frames=_FRAMES)
    volume_bytes = 4 * math.prod(scan.grid.shape)
    is_on_host = isinstance(system.space, HostSpace)
    held = _HELD + priors.kind_of(options.prior).volumes
    is_short = is_on_host and system.leave_room(rt, (held + _COPIES) * volume_bytes)
    error, image = frame_error(scan, options.motion), repeated(whole.initial, parts)
    prior_inputs = priors.PriorInputs(
        rt, scan.grid, options.tv_iterations, image, options.prior_share, scan.is_fly, error.noise
    )
    prior = priors.kind_of(options.prior).make(prior_inputs)
    with rt.ledger.reserved(_COPIES * volume_bytes if is_short else 0):
        weight = PriorWeight(system, error, options.prior_weight)
        subsets, passes = options.subsets, 1
        if is_coarse:
            subsets, passes = round(_COARSE_SUBSETS * subsets), _COARSE_PASSES
        method = Fista(
            system, prior, weight, subsets=subsets, nonnegative=options.nonnegative, has_long_steps=True,
            optimised=optimised, passes=passes, sparing=max(iterations - _FULL_PASSES, 0) if parts > 1 else 0,
        )  # fmt: skip
    return Iterations(method, run)


def _gains_from_subvoxels(run: MethodRun, parts: int) -> bool:
    """Returns whether voxels divided into ``parts`` along a side are worth their time on the run's grid, and fit on every
    rank's device. Logs a warning if they are worth it and do not fit."""
    shape, rt = run.scan.grid.shape, run.rt
    if math.prod(shape[1:]) > _MOST_DIVIDED:
        return False
    voxels = math.prod(shape) * parts**3
    sizes_bytes = *[4 * voxels] * (_VOLUMES + 2), 4 * voxels * priors.kind_of(run.options.prior).volumes
    has_room = voxels <= MOST_VOXELS and rt.room().holds(*sizes_bytes)
    if rt.ranks.any(not has_room):
        text = "fista: the device has no room for voxels half as large in the last passes (%.3g MiB): the result is less "
        text += "sharp than with them; allow more with --memory, or say subvoxels=1"
        log.warning(text, sum(sizes_bytes) / 2**20)
        return False
    return True
