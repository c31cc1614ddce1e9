"""From coarse to fine: a volume, the signals that it leaves, a step of what they tell, and again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.finding import AGREES, CANNOT_TELL, CORRECTED, Calibration, Found
from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.moved import moved
from phyradgs_cl.calibrate.parameters import PARAMETERS, Parameter, change_of, chosen, in_words
from phyradgs_cl.calibrate.reduced import Reduced, alike, identifiable, reduced
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.preprocess import InputOptions, prepared
from phyradgs_cl.runtime import Runtime

Report = Callable[[int, int, str], None]
DEVIATIONS = 3.0  # by which a parameter has to differ from what is stated
_FEWEST_FRAMES, _FEWEST_COLUMNS = 8, 12
_MOST_PX = 2.0  # of a level, per step: signals are straight lines no further
_SETTLED = 0.1  # of a standard deviation


@dataclass(frozen=True)
class Stage:
    """How finely, how often, and with how many iterations signals are projected and a first and a next volume made."""

    columns: int
    steps: int
    project: int
    first: int
    again: int


STAGES = (Stage(24, 6, 40, 40, 15), Stage(48, 3, 20, 40, 12), Stage(96, 3, 30, 50, 15))


@dataclass(eq=False)
class _Search:
    """Where the search stands: ``at``, values by name; ``known``: those that the frames tell; the last stage's problem."""

    at: dict[str, float] = field(default_factory=dict)
    known: tuple[str, ...] = ()
    shares: dict[str, float] = field(default_factory=dict)
    alike: list[str] = field(default_factory=list)
    problem: Reduced | None = None


def calibrate(
    scan: Scan,
    rt: Runtime,
    what: str | None = None,
    others: Sequence[Scan] = (),
    report: Report = lambda done, total, text: None,
) -> Calibration:
    """The scan with its true geometry and timing as far as its frames tell them; ``what``: parameters with commas, None the
    usual ones. ``others``: more scans of the same object, lying as it did, that share what is wrong.

    InputError for parameters that there are not, a scan too small, or others that do not fit the first."""
    parameters, _ = chosen(what, scan)
    ready = [prepared(one, InputOptions()) for one in (scan, *others)]
    _check(ready)
    search = _Search()
    levels = [stage for k, stage in enumerate(STAGES) if k == 0 or _blocks(scan, stage) < _blocks(scan, STAGES[k - 1])]
    for number, stage in enumerate(levels):
        report(number, len(levels), f"at most {stage.columns} columns")
        level = Level.of(rt, ready, stage.columns)
        _descend(level, stage, parameters, search)
        if not search.known:
            break
    kept = _corrections(search)
    report(len(levels), len(levels), "residuals")
    ends = [_residual(level, stage, values) for values in ({}, kept)]
    facts = _table(scan, parameters, search, kept)
    corrected = moved(scan, change_of(kept)) if kept else scan
    calibration = Calibration(corrected, facts, search.alike, (_rms(ends[0]), _rms(ends[1])), *ends)
    told = {**scan.provenance, "calibration": {**calibration.facts(), "program": f"phyradgs-cl {__version__}"}}
    return replace(calibration, scan=replace(corrected, provenance=told))


def _blocks(scan: Scan, stage: Stage) -> int:
    return -(-max(scan.geometry.detector_shape) // stage.columns)


def _check(scans: Sequence[Scan]) -> None:
    first = scans[0]
    if first.frames < _FEWEST_FRAMES or first.geometry.detector_shape[1] < _FEWEST_COLUMNS:
        found = f"{first.frames} frames of {first.geometry.detector_shape[1]} columns"
        raise InputError("scan", found, f"at least {_FEWEST_FRAMES} frames of {_FEWEST_COLUMNS} columns")
    for other in scans[1:]:
        for name in ("geometry", "grid", "detector_model"):
            if getattr(other, name) != getattr(first, name):
                found = str(getattr(other, name))
                raise InputError(f"--with: {name}", found, f"the first scan's, {getattr(first, name)}")
        if other.shutter.axis != first.shutter.axis:
            raise InputError("--with: readout axis", other.shutter.axis, f"the first scan's, {first.shutter.axis}")


def _descend(level: Level, stage: Stage, parameters: Sequence[Parameter], search: _Search) -> None:
    """Steps on one level until they are small; which parameters the frames tell is asked on the first one."""
    volume: np.ndarray | None = None
    for number in range(stage.steps):
        is_first = search.problem is None
        asked = [one for one in parameters if is_first or one.name in search.known]
        operator = level.operator(change_of(search.at))
        volume = level.reconstruct(operator, volume, stage.again if number else stage.first)
        problem = reduced(level, asked, search.at, volume, stage.project)
        if is_first:
            _ask(problem, search)
        search.problem = problem.only(search.known).about(search.at)
        if not search.known:
            return
        values, deviations = search.problem.step(), search.problem.deviations()
        moves = values - np.array([search.at.get(name, 0.0) for name in search.known])
        for name, move in zip(search.known, moves, strict=True):
            most = _MOST_PX * level.block / PARAMETERS[name].pixels(level.scans[0])
            search.at[name] = search.at.get(name, 0.0) + float(np.clip(move, -most, most))
        if np.all(np.abs(moves) < _SETTLED * deviations):
            return


def _ask(problem: Reduced, search: _Search) -> None:
    """Which parameters the frames tell, and what they cannot tell apart."""
    search.known, search.alike = identifiable(problem), [in_words(weights) for weights in alike(problem)]
    for name in problem.names:
        beside = tuple(one for one in search.known if one != name)
        search.shares[name] = float(problem.only((*beside, name)).shares[-1])


def _corrections(search: _Search) -> dict[str, float]:
    """The parameters that differ from what is stated by three deviations, with the values that they then have together."""
    problem = search.problem
    if problem is None or not search.known:
        return {}
    off = np.abs(problem.step()) > DEVIATIONS * problem.deviations()
    names = tuple(name for name, is_off in zip(search.known, off, strict=True) if is_off)
    return dict(zip(names, map(float, problem.only(names).step()), strict=True)) if names else {}


def _table(scan: Scan, parameters: Sequence[Parameter], search: _Search, kept: Mapping[str, float]) -> list[Found]:
    values: dict[str, tuple[float, float]] = {}
    if search.problem is not None and search.known:
        found = zip(search.problem.step().tolist(), search.problem.deviations().tolist(), strict=True)
        values = dict(zip(search.known, found, strict=True))
    table = []
    for one in parameters:
        stated, share = one.stated(scan) * one.scale, search.shares[one.name]
        if one.name not in values:
            table.append(Found(one.name, one.unit, stated, None, None, share, CANNOT_TELL))
            continue
        value, deviation = values[one.name]
        verdict = CORRECTED if one.name in kept else AGREES
        change = kept.get(one.name, value) * one.scale
        table.append(Found(one.name, one.unit, stated, stated + change, deviation * one.scale, share, verdict))
    return table


def _residual(level: Level, stage: Stage, values: Mapping[str, float]) -> np.ndarray:
    """What a volume leaves of the frames (F, rows, columns) under these values."""
    operator = level.operator(change_of(values))
    volume = level.reconstruct(operator, None, stage.first)
    return level.line_integrals(operator, volume) - level.masked(operator.forward(volume))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
