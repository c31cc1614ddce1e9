"""``moving``: the volume of an object that moves in an unknown way, and its displacement field.

The search finds the field on a coarse copy of the scan (``search.py``). ``fista`` then reconstructs the reference volume
with that field, as it does with ``--object-motion``. An object that shows no motion gets the volume of ``fista`` at rest."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.motion import with_times
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, triple
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.loop import Loop
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.moving.search import FieldSearch
from phyradgs_cl.reconstructors.moving.signal import (
    MotionSignal,
    gating_of_scan,
    load_gating,
    motion_signal,
    signal_of,
)
from phyradgs_cl.reconstructors.result import MOTION_FOUND, Progress, Reconstruction, Report, option_facts
from phyradgs_cl.reconstructors.voxels.fista import FistaOptions, fista_stages
from phyradgs_cl.reconstructors.voxels.run import MethodInputs
from phyradgs_cl.reconstructors.voxels.stages import Stage, run_stages
from phyradgs_cl.runtime import Runtime

_ITERATIONS_PER_ROUND = 6  # 7 rounds of the search come before the 35 passes that are the default of fista
_STORED = ("field_control", "field_place", "field_times", "field_weights", "field_gain")


@dataclass(frozen=True)
class MovingOptions(FistaOptions):
    """iterations: rounds of the search for the field, a sixth of them, and passes of ``fista`` after it. bending: stiffness
    of the field, relative to how strongly frames respond to it. gating: what the motion follows at first: ``auto`` (the
    signal of the frames, where it repeats), ``free`` (any smooth curve in time), ``scan`` (the signal or phase that the scan
    states), or a file, NAME.csv (``load_gating``). The other options are those of ``fista``."""

    TRIALS: ClassVar[tuple[int, int]] = (1, 7)
    """Iterations of the short runs of ``estimate``: one round alone, two rounds with five passes."""

    iterations: int = 42
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
        """Rounds of the search; the other iterations are passes of ``fista``."""
        return ceil_div(self.iterations, _ITERATIONS_PER_ROUND)

    def of_passes(self) -> FistaOptions:
        """Returns the options of ``fista`` after the search."""
        own = {one.name: getattr(self, one.name) for one in fields(FistaOptions)}
        return FistaOptions(**{**own, "iterations": self.iterations - self.rounds})


@dataclass
class _Field:
    """The field between the search and the passes: kept in the states of the passes, which need it to resume."""

    deformation: Deformation | None = None
    gain: float = 0.0

    @property
    def for_passes(self) -> Deformation | None:
        """None where nothing moves."""
        return None if self.deformation is None or self.deformation.is_still else self.deformation

    def state(self) -> dict[str, np.ndarray]:
        if (one := self.deformation) is None:
            return {}
        place = np.array([one.origin_mm, one.spacing_mm])
        return dict(zip(_STORED, (one.control_mm, place, one.times_s, one.weights, np.array(self.gain)), strict=True))

    def restore(self, state: State) -> State:
        """Takes the field from a state of the passes. Returns the other arrays."""
        if _STORED[0] not in state:
            return state
        control_mm, place, times_s, weights, gain = (state[name] for name in _STORED)
        origin_mm, spacing_mm = (triple(row.tolist()) for row in place)
        self.deformation, self.gain = Deformation(control_mm, origin_mm, spacing_mm, times_s, weights), float(gain)
        return {name: array for name, array in state.items() if name not in _STORED}


def moving(scan: Scan, options: MovingOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    """Returns the reference volume in 1/mm with the object's ``deformation``. ``arguments``: the other ``MethodInputs``."""
    inputs, one = MethodInputs(scan, options, rt, **arguments), _Field()
    if inputs.resume is not None:
        inputs = replace(inputs, resume=one.restore(inputs.resume))
    signal = _signal_of(scan, options.gating)
    passes_inputs = replace(inputs, options=options.of_passes())
    stages = [Stage("field", options.rounds, partial(_search, signal=signal, one=one))] if options.rounds else []
    for number, stage in enumerate(fista_stages(passes_inputs)):
        stages.append(replace(stage, run=partial(_with_field, stage.run, passes_inputs, one, number == 0)))
    report = Report.of(inputs.report)
    with report.through(partial(_with_field_in_progress, one)):
        result = run_stages(stages, replace(inputs, report=report))
    state = None if result.state is None else {**result.state, **one.state()}
    options = replace(options, motion=with_times(options.motion, scan, one.for_passes))
    result.facts.update(method="moving", options=option_facts(options), **{MOTION_FOUND: _motion_facts(one, signal, scan)})
    return replace(result, state=state, deformation=one.deformation)


METHOD = Method(moving, {"default": MovingOptions()}, finds_motion=True)


def _signal_of(scan: Scan, gating: str) -> MotionSignal:
    """Returns the signal of the scan, of a file, or that of the frames; ``free`` has no period."""
    if gating == "scan":
        return signal_of(gating_of_scan(scan), scan, "gating scan")
    if gating.endswith(".csv"):
        return signal_of(load_gating(gating, scan), scan, f"gating {gating}")
    signal = motion_signal(scan)
    return replace(signal, period_s=None, knot_s=None) if gating == "free" else signal


def _search(inputs: MethodInputs, signal: MotionSignal, one: _Field) -> Reconstruction:
    """Runs the search, and keeps the field in ``one`` when it is complete."""
    started, scan, options = time.perf_counter(), inputs.scan, inputs.options
    search = FieldSearch(inputs.rt, scan, options.motion, signal, options.rounds, options.bending)
    loop = Loop(search, inputs.rt.ranks, inputs.report, started)
    loop.run(inputs.resume)
    if loop.interrupted_at is None:
        one.deformation, one.gain = search.finding()
    facts = {"iterations": options.rounds, "interrupted_at": loop.interrupted_at, "seconds": loop.seconds}
    volume, grid = search.present_volume()
    return Reconstruction(volume, grid, record=loop.record, facts=facts, state=loop.state_if_interrupted())


def _with_field(
    run: Callable[[MethodInputs], Reconstruction], of_passes: MethodInputs, one: _Field, is_first: bool, inputs: MethodInputs
) -> Reconstruction:
    """Runs a stage of ``fista`` with the field. The first one starts as ``fista`` does, not from the coarse volume."""
    initial = of_passes.initial if is_first else inputs.initial
    return run(replace(inputs, options=of_passes.options, initial=initial, deformation=one.for_passes))


def _with_field_in_progress(one: _Field, progress: Progress) -> Progress:
    return progress.mapped(state=lambda state: {**state, **one.state()}, deformation=one.for_passes)


def _motion_facts(one: _Field, signal: MotionSignal, scan: Scan) -> dict[str, object]:
    """Returns what was found, for the result: displacements relative to the mean place of matter in the scan."""
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
