"""``moving``: the volume of an object that moves in an unknown way, and its displacement field.

First the field is sought on a coarse copy of the scan. Each round makes a few passes of ``fista`` with the present field,
then a Gauss-Newton step of the field and a step of its weights (``field.py``). Motion and image together: J. Wang and X. Gu,
Simultaneous motion estimation and image reconstruction (SMEIR) for 4D cone-beam CT, Med. Phys. 40, 101912 (2013).

Then ``fista`` reconstructs the reference volume with that field, as it does with ``--object-motion``. If the search finds no
motion, the result is the volume of ``fista`` for an object at rest."""

import math
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow, Scan
from phyradgs_cl.acquisition.altered.coarse import SMOOTHING, binned, fewer_frames, smooth
from phyradgs_cl.acquisition.motion import with_times
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, triple
from phyradgs_cl.metrics import resampled
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.moving import LEAST_GAIN
from phyradgs_cl.reconstructors.moving.field import FieldProblem, MotionField, sum_squares
from phyradgs_cl.reconstructors.moving.signal import (
    MotionSignal,
    TemporalSplines,
    load_gating,
    motion_signal,
    signal_of,
)
from phyradgs_cl.reconstructors.result import MOTION_FOUND, Progress, Reconstruction, option_facts, through
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions, fista_stage, fista_stages
from phyradgs_cl.reconstructors.voxels.run import MethodRun
from phyradgs_cl.reconstructors.voxels.stages import Stage, Stages
from phyradgs_cl.runtime import Runtime

_MOST_COLUMNS = 64  # most pixels along the longer side of the coarse scan's panel
_MOST_VOXELS = 32  # most voxels along the longest side of the coarse scan's grid
_MOST_FRAMES = 600  # most frames of the coarse scan, unless the signal has more knots
_TIMES_PER_PERIOD = 12  # an exposure is sampled at this many times per period of the motion
_MOST_TIMES = 6  # most times per exposure that a short period may require, because each time costs a projection
_FIRST_PASSES = 8  # passes of fista before the first round, for an object at rest: the field needs a volume to start from
_PASSES = 3  # passes of fista in each later round, which fit the volume to the present field
_WEIGHT = 0.42  # prior weight of fista in the search
_TV_ITERATIONS = 5  # dual iterations of total variation (TV) per pass of fista in the search
_COARSE_SPACINGS = 2  # number of spacings between control points along the longest side in the first, coarse rounds
_FINE_SPACINGS = 4  # number of spacings between control points along the longest side in the last rounds
# Finer control points need a larger bending weight γ, by this factor, so that the field is as stiff in mm as before.
_FINE_BENDING = (_FINE_SPACINGS / _COARSE_SPACINGS) ** 4
_COARSE_SHARE = 0.6  # fraction of the rounds that have coarse control points
_FREE_KNOTS = 6  # number of intervals between spline knots in time, if weights follow no signal
_AT_REST = "no motion found"
# One in five iterations is a round of the search for the field: of the default 33, 7 rounds, then 26 passes of fista.
_ITERATIONS_PER_ROUND = 5
_STORED = ("field_control", "field_place", "field_times", "field_weights", "field_gain")  # names of the field's arrays


def coarse_scan(scan: Scan, most_frames: int = _MOST_FRAMES) -> Scan:
    """Returns a smaller scan for the search: at most ``most_frames`` frames, smoothed and then binned to fewer pixels, and
    fewer voxels in the same box."""
    block = math.ceil(max(scan.geometry.detector_shape) / _MOST_COLUMNS)
    small = binned(smooth(fewer_frames(scan, most_frames), SMOOTHING * block if block > 1 else 0.0), block)
    least_mm = max(max(scan.grid.size_mm) / _MOST_VOXELS, min(scan.grid.voxel_size_mm))
    return replace(small, grid=scan.grid.in_shape(triple(max(1, round(side / least_mm)) for side in scan.grid.size_mm)))


def initial_field(scan: Scan, signal: MotionSignal, last_s: float, first_s: float) -> MotionField:
    """Returns a field at rest over the times from ``first_s`` to ``last_s``. Its two weights follow ``signal`` and its
    quadrature if ``signal.knot_s`` is set, else a straight line in time and its square."""
    spacing_mm = max(scan.grid.size_mm) / _COARSE_SPACINGS
    if signal.knot_s is not None:
        between_s = float(np.median(np.diff(signal.times_s)))
        splines = TemporalSplines.of_step(first_s, last_s, max(signal.knot_s, between_s))
        return MotionField.at_rest(scan, spacing_mm, splines, splines.fit(signal.times_s, signal.pair()))
    splines = TemporalSplines.of_step(first_s, last_s, (last_s - first_s) / _FREE_KNOTS)
    times_s = splines.node_times_s
    line = np.linspace(-1, 1, len(times_s))
    return MotionField.at_rest(scan, spacing_mm, splines, splines.fit(times_s, np.stack([line, line**2], -1)))


class FieldSearch:
    """Searches the displacement field on a coarse copy of the scan. rounds: number of iterations by a ``Loop``. signal: what
    the field's weights in time follow at first. bending: the field's stiffness, γ in ``FieldProblem``."""

    quantity, remedy = "residual", "check the scan for extreme values"

    def __init__(
        self, rt: Runtime, scan: Scan, motion: Motion, signal: MotionSignal, rounds: int, bending: float
    ) -> None:
        knots = float(np.ptp(scan.frame_start_s)) / signal.knot_s if signal.knot_s else 0.0
        self.rt, self.grid, self.iterations, self.iteration = rt, scan.grid, rounds, 0
        self.scan = coarse_scan(scan, max(_MOST_FRAMES, math.ceil(knots)))
        self.motion = _with_times(motion, scan, signal.period_s)
        self.problem = FieldProblem(rt, self.scan, self.motion, bending)
        times_s = self.problem.times_s
        self.field = initial_field(self.scan, signal, float(times_s.max()), float(times_s.min()))
        self.volume = np.zeros(self.scan.grid.shape, np.float32)
        self.relative, self.change = 0.0, 0.0
        self._coarse_rounds = math.ceil(_COARSE_SHARE * rounds)

    @property
    def finished(self) -> str | None:
        """Why the search ends early: two rounds found no step that lowers the misfit, so the object rests. Else None."""
        return _AT_REST if self.iteration >= 2 and not self.field.control_mm.any() else None

    def step(self) -> None:
        if self.iteration == 0:
            self.volume = self._reconstructed(self.field, None, _FIRST_PASSES)
        elif self.field.control_mm.any():
            self.volume = self._reconstructed(self.field, self.volume, _PASSES)
        if self.iteration == self._coarse_rounds:
            self._refine()
        before = self.field
        self.field = self.problem.space_step(self.field, self.volume)
        if self.iteration > 0 and self.field.control_mm.any():
            self.field = self.problem.time_step(self.field, self.volume)
        self.change = _difference(self.field, before)
        self.relative = self._misfit(self.field, self.volume) / max(sum_squares(self.problem.measured), 1e-30)
        self.iteration += 1

    def _refine(self) -> None:
        self.field = self.field.refined(self.scan, max(self.scan.grid.size_mm) / _FINE_SPACINGS)
        self.problem.bending *= _FINE_BENDING

    def measures(self) -> dict[str, float]:
        return {"residual": self.relative**0.5, "change": self.change}

    def facts(self, is_complete: bool) -> dict[str, object]:
        return {}

    def state(self) -> dict[str, np.ndarray]:
        one = self.field
        return {
            "control_mm": one.control_mm, "temporal": one.temporal, "coarse_volume": self.volume,
            "fit": np.array([self.relative, self.change]), "iteration": np.array(self.iteration),
        }  # fmt: skip

    def restore(self, state: State) -> None:
        self.iteration = int(state["iteration"])
        if self.iteration > self._coarse_rounds:
            self._refine()
        self.field = replace(self.field, control_mm=state["control_mm"], temporal=state["temporal"])
        self.volume = state["coarse_volume"]
        self.relative, self.change = state["fit"].tolist()

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        return resampled(self.volume, self.scan.grid, self.grid)[0], self.grid

    def finding(self) -> tuple[Deformation, float]:
        """Returns the field and its gain, 1 − (squared residual with the field)/(squared residual at rest, after as many
        passes). The field is zeros unless the gain exceeds both ``LEAST_GAIN`` and 2 · (parameters of the field)/(valid
        pixels), twice the share of the noise that so many parameters explain."""
        if not self.field.control_mm.any():
            return self.field.deformation(), 0.0
        moving = self._reconstructed(self.field, self.volume, _PASSES)
        resting_field = replace(self.field, control_mm=np.zeros_like(self.field.control_mm))
        resting = self._reconstructed(resting_field, None, _FIRST_PASSES + _PASSES * self.iteration)
        ratio: float = self._misfit(self.field, moving) / self._misfit(resting_field, resting)
        gain = 1 - ratio
        numbers = self.field.control_mm.size + self.field.temporal.size
        least = max(LEAST_GAIN, 2 * numbers / max(int(np.count_nonzero(self.scan.valid)), 1))
        return (self.field if gain > least else resting_field).deformation(), gain

    def _misfit(self, one: MotionField, volume: np.ndarray) -> float:
        return sum_squares(self.problem.residual(one, volume))

    def _reconstructed(self, one: MotionField, volume: np.ndarray | None, passes: int) -> np.ndarray:
        """Returns the volume (nz, ny, nx) after ``passes`` passes of ``fista`` on the coarse scan under the field ``one``,
        from ``volume`` (None: from zeros)."""
        options = FistaOptions(
            motion=self.motion, iterations=passes, prior="dct", prior_weight=_WEIGHT, tv_iterations=_TV_ITERATIONS
        )
        deformation = one.deformation() if one.control_mm.any() else None
        run = fista_stage(lambda: MethodRun(self.scan, options, self.rt, deformation=deformation), passes, volume)
        for _ in range(passes):
            run.step()
        return run.present_volume()[0]


def _with_times(motion: Motion, scan: Scan, period_s: float | None) -> Motion:
    """Returns the motion model with as many times per exposure as the gantry's motion needs and, for a default ``PerRow``,
    the signal's period ``period_s``. How fast the object moves is not known yet."""
    timed = with_times(motion, scan)
    if motion != PerRow() or not isinstance(timed, PerRow) or period_s is None:
        return timed
    times = math.ceil(_TIMES_PER_PERIOD * scan.shutter.exposure_s / period_s)
    return PerRow(max(timed.sub_intervals, min(times, _MOST_TIMES)))


def _difference(one: MotionField, other: MotionField) -> float:
    """Returns √(a² + b²), with the relative changes from ``other`` to ``one`` of the control vectors, a, and of the
    coefficients in time, b. A change counts as 0 if the array's shape has changed, or if the new array is all 0."""
    pairs = [(one.control_mm, other.control_mm), (one.temporal, other.temporal)]
    parts: list[Any] = [
        sum_squares(new - old) / sum_squares(new) for new, old in pairs if new.shape == old.shape and new.any()
    ]
    return float(sum(parts)) ** 0.5


@dataclass(frozen=True)
class MovingOptions(FistaOptions):
    """Options of ``moving``, with those of ``fista``.

    - iterations: a fifth are rounds of the search for the field, the rest passes of ``fista`` after it.
    - bending: stiffness of the field, relative to how strongly frames respond to it.
    - gating: what the motion follows at first: ``auto`` (the signal of the frames if it repeats, else as ``free``), ``free``
      (a line in time and its square), ``scan`` (the signal or phase that the scan states), or a file NAME.csv."""

    TRIALS: ClassVar[tuple[int, int]] = (1, 7)
    """Iterations of the two short runs that ``estimate`` times: one round alone, and two rounds with five passes."""

    iterations: int = 33
    bending: float = checks.ranged(0.01, 0, 1e6)
    gating: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.gating.endswith(".csv"):
            checks.one_of("gating", self.gating, ("auto", "free", "scan", "NAME.csv"))
        if self.prior == "piccs":
            raise InputError("prior", "piccs with --method moving", "a prior without an image", "leave it out")

    @property
    def rounds(self) -> int:
        """Number of rounds of the search; the other iterations are passes of ``fista``."""
        return ceil_div(self.iterations, _ITERATIONS_PER_ROUND)

    def of_passes(self) -> FistaOptions:
        """Returns the options of the ``fista`` passes after the search: those of this method, with ``iterations`` less the
        rounds of the search."""
        own = {one.name: getattr(self, one.name) for one in fields(FistaOptions)}
        return FistaOptions(**{**own, "iterations": self.iterations - self.rounds})


@dataclass
class _Field:
    """Hands the field from the search to the passes of ``fista``. States of these passes hold the field too, so that an
    interrupted run can resume."""

    deformation: Deformation | None = None
    gain: float = 0.0

    @property
    def for_passes(self) -> Deformation | None:
        """The field as a deformation; None before the search has ended, and if nothing moves."""
        return None if self.deformation is None or self.deformation.is_still else self.deformation

    def take(self, search: Any) -> None:
        self.deformation, self.gain = search.finding()

    def state(self) -> dict[str, np.ndarray]:
        if (one := self.deformation) is None:
            return {}
        place = np.array([one.origin_mm, one.spacing_mm])
        return dict(zip(_STORED, (one.control_mm, place, one.times_s, one.weights, np.array(self.gain)), strict=True))

    def restore(self, state: State) -> State:
        """Takes the field from a state of the passes, if it holds one. Returns the state's other arrays."""
        if _STORED[0] not in state:
            return state
        control_mm, place, times_s, weights, gain = (state[name] for name in _STORED)
        origin_mm, spacing_mm = (triple(row.tolist()) for row in place)
        self.deformation, self.gain = Deformation(control_mm, origin_mm, spacing_mm, times_s, weights), float(gain)
        return {name: array for name, array in state.items() if name not in _STORED}


def moving(scan: Scan, options: MovingOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    """Returns the reference volume in 1/mm, with the object's ``deformation``. arguments: other fields of ``MethodRun``."""
    run, one = MethodRun(scan, options, rt, **arguments), _Field()
    if run.resume is not None:
        run = replace(run, resume=one.restore(run.resume))
    signal = _signal_of(scan, options.gating)
    search = partial(FieldSearch, rt, scan, options.motion, signal, options.rounds, options.bending)
    stages = [Stage("field", options.rounds, lambda _: search(), end=one.take)] if options.rounds else []

    def of_passes() -> MethodRun:
        motion = with_times(options.motion, scan, one.for_passes)
        return replace(run, options=replace(options.of_passes(), motion=motion), deformation=one.for_passes)

    coarse, *fine = fista_stages(of_passes(), of_passes)
    # the first passes start as ``fista`` does, not from the volume of the search
    stages += [replace(coarse, make=lambda _: coarse.make(None)), *fine]

    def with_field(progress: Progress) -> Progress:
        return progress.mapped(state=lambda state: {**state, **one.state()}, deformation=one.for_passes)

    result = replace(run, report=through(with_field, run.report)).result("moving", Stages(stages, run))
    state = None if result.state is None else {**result.state, **one.state()}
    facts = option_facts(replace(options, motion=of_passes().options.motion))
    result.facts.update(options=facts, **{MOTION_FOUND: _motion_facts(one, signal, scan)})
    return replace(result, state=state, deformation=one.deformation)


METHOD = Method(
    moving, {"default": MovingOptions()}, finds_motion=True,
    check=lambda scan, options: options.gating in ("auto", "free") or _signal_of(scan, options.gating),
)


def _signal_of(scan: Scan, gating: str) -> MotionSignal:
    """Returns the signal that ``gating`` names: ``scan``, a file, or (``auto``, ``free``) that of the frames, for ``free``
    without a period. Raises InputError if the scan states no signal, and for a file or signal that does not fit the scan."""
    if gating == "scan":
        if scan.gating is None:
            remedy = "take --set gating=auto, or a file NAME.csv"
            raise InputError("gating", "scan, and no gating in the scan", "a signal or a phase in phyradgs/gating", remedy)
        return signal_of(scan.gating, scan, "gating scan")
    if gating.endswith(".csv"):
        return signal_of(load_gating(gating, scan), scan, f"gating {gating}")
    signal = motion_signal(scan)
    return replace(signal, period_s=None, knot_s=None) if gating == "free" else signal


def _motion_facts(one: _Field, signal: MotionSignal, scan: Scan) -> dict[str, object]:
    """Returns what the search found, for the result's facts. rms_mm is the RMS displacement from mean positions in time."""
    moves = one.for_passes is not None
    follows = signal.knot_s is not None
    facts: dict[str, object] = {"moves": moves, "follows": follows, "period_s": signal.period_s, "gain": one.gain}
    if (field := one.for_passes) is None:
        return facts
    units = np.stack([field.on_grid_mm(scan.grid, unit) for unit in np.eye(field.rank)]).reshape(field.rank, -1)
    gram = units.astype(np.float64) @ units.T.astype(np.float64) / (units.shape[1] / 3)
    weights = field.weights - field.weights.mean(0)
    squares_mm2 = np.einsum("tr,rs,ts->t", weights, gram, weights)
    return {**facts, "rms_mm": float(np.sqrt(squares_mm2.mean()))}
