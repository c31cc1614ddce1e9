"""From coarse to fine: a volume, the signals that it leaves, a step of what they tell, and again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.finding import AGREES, CANNOT_TELL, CORRECTED, Calibration, Found
from phyradgs_cl.calibrate.level import MOST_FRAMES, Level
from phyradgs_cl.calibrate.moved import Change, Sway, Views, moved
from phyradgs_cl.calibrate.parameters import PARAMETERS, WOBBLE, Parameter, change_of, chosen, in_words
from phyradgs_cl.calibrate.reduced import Reduced, alike, gauge_share, identifiable, least_share, reduced
from phyradgs_cl.calibrate.views import find_sway, find_wobble
from phyradgs_cl.check.coarse import QUICK, coarse
from phyradgs_cl.check.questions.offset import best_offset, rough_offset
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.preprocess import InputOptions, prepared
from phyradgs_cl.runtime import Runtime

Report = Callable[[int, int, str], None]
DEVIATIONS = 3.0  # by which a parameter has to differ from what is stated
_FEWEST_FRAMES, _FEWEST_COLUMNS = 8, 12
_MOST_PX = 2.0  # of a level, per step: signals are straight lines no further
_SETTLED = 0.1  # of a standard deviation
_OF_WAY = 0.5  # from a stage to one twice as fine: what is left of it, as of an error of first order


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
    """Where the search stands: ``at``, values by name, and ``former`` at the end of the stage before; ``known``: those that
    the frames tell; the last stage's problem."""

    at: dict[str, float] = field(default_factory=dict)
    former: dict[str, float] = field(default_factory=dict)
    known: tuple[str, ...] = ()
    shares: dict[str, float] = field(default_factory=dict)
    alike: list[str] = field(default_factory=list)
    problem: Reduced | None = None

    def found(self) -> tuple[np.ndarray, np.ndarray]:
        """Values of what is known, and their standard deviations: those of noise, and half the way that the values went from
        the stage before to this one, which is what voxels are wrong by, together; both grow by what a parameter looks like
        those that are not known and stay as stated, right or wrong."""
        if self.problem is None or not self.known:
            return np.zeros(0), np.zeros(0)
        values, noise = self.problem.step(), self.problem.deviations()
        way = values - [self.former.get(name, value) for name, value in zip(self.known, values, strict=True)]
        others = np.maximum(self.problem.shares / [self.shares[name] for name in self.known], 1.0)
        return values, others * np.hypot(noise, _OF_WAY * way)


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
    parameters, per_view = chosen(what, scan)
    ready = [prepared(one, InputOptions()) for one in (scan, *others)]
    _check(ready, per_view)
    search = _Search(at=_start(rt, ready[0]) if any(one.name == "offset-u" for one in parameters) else {})
    levels = [stage for k, stage in enumerate(STAGES) if k == 0 or _blocks(scan, stage) < _blocks(scan, STAGES[k - 1])]
    for number, stage in enumerate(levels if parameters else ()):
        report(number, len(levels), f"at most {stage.columns} columns")
        level = Level.of(rt, ready, stage.columns)
        _descend(level, stage, parameters, search)
        if not search.known:
            break
    kept = _corrections(search)
    change, views = change_of(kept), None
    table = _table(scan, parameters, search, kept)
    if per_view:
        report(len(levels), len(levels), "views")
        find = find_wobble if per_view == WOBBLE else find_sway
        wobble = find(rt, ready[0], [(stage.columns, stage.first, stage.again) for stage in levels], change)
        table, views = table + wobble.table, wobble.views
    report(len(levels), len(levels), "residuals")
    level = Level.of(rt, ready, levels[-1].columns, MOST_FRAMES if views is None else scan.frames)
    before = _residual(level, levels[-1], Change(), None)
    after = _residual(level, levels[-1], change, views)
    corrected = moved(scan, change, views) if kept or views is not None else scan
    calibration = Calibration(corrected, table, search.alike, (_rms(before), _rms(after)), before, after, views)
    told = {**scan.provenance, "calibration": {**calibration.facts(), "program": f"phyradgs-cl {__version__}"}}
    return replace(calibration, scan=replace(corrected, provenance=told))


def _start(rt: Runtime, scan: Scan) -> dict[str, float]:
    """Where the axis is on the panel, as ``check`` sees it: steps lead there from a few pixels away only."""
    quick = coarse(scan, QUICK)
    offset = best_offset(rt, quick, rough_offset(rt, quick))
    pitch_mm = scan.geometry.pixel_size_mm[1]
    return {"offset-u": offset.pixels * pitch_mm} if np.isfinite(offset.pixels) else {}


def _blocks(scan: Scan, stage: Stage) -> int:
    return -(-max(scan.geometry.detector_shape) // stage.columns)


def _check(scans: Sequence[Scan], per_view: str) -> None:
    first = scans[0]
    for scan in scans:
        scan.check_sight()
    if per_view and len(scans) > 1:
        raise InputError(f"--what {per_view}", "a second scan", "one scan: views are each scan's own", "leave --with out")
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
    """Steps on one level until they are small; which parameters the frames tell is asked at each step of the first one."""
    volume: np.ndarray | None = None
    asks = search.problem is None
    search.former = {} if asks else dict(search.at)
    for number in range(stage.steps):
        asked = parameters if asks else [PARAMETERS[name] for name in search.known]
        volume = level.reconstruct(level.operator(change_of(search.at)), volume, stage.again if number else stage.first)
        problem = reduced(level, asked, search.at, volume, stage.project)
        if asks:
            _ask(problem, gauge_share(level, search.at, volume, stage.project), search)
        search.problem = problem.about(search.at).only(search.known)
        if not search.known:
            return
        values, deviations = search.problem.step(), search.problem.deviations()
        there = np.array([search.at.get(name, 0.0) for name in search.known])
        search.at = {
            name: _limited(PARAMETERS[name], level, old, new)
            for name, old, new in zip(search.known, there, values, strict=True)
        }
        if np.all(np.abs(values - there) < _SETTLED * deviations):
            return


def _limited(one: Parameter, level: Level, old: float, new: float) -> float:
    """``new`` as far as a step from ``old`` may go."""
    most = _MOST_PX * level.block / one.pixels(level.scans[0])
    return max(old + float(np.clip(new - old, -most, most)), one.lowest(level.scans[0]))


def _ask(problem: Reduced, gauge: float, search: _Search) -> None:
    """Which parameters the frames tell, and what they cannot tell apart."""
    least = least_share(gauge)
    search.known = identifiable(problem, least)
    search.alike = [in_words(weights) for weights in alike(problem, least)]
    search.shares = dict(zip(problem.names, problem.shares.tolist(), strict=True))


def _corrections(search: _Search) -> dict[str, float]:
    """The parameters that differ from what is stated by three deviations, with the values that they then have together; all
    that are known, where those would take over by more than a deviation what the others are off by."""
    values, deviations = search.found()
    off = np.abs(values) > DEVIATIONS * deviations
    names = tuple(name for name, is_off in zip(search.known, off, strict=True) if is_off)
    if search.problem is None or not names:
        return {}
    alone = search.problem.only(names).step()
    if np.any(np.abs(alone - values[off]) > deviations[off]):
        return dict(zip(search.known, map(float, values), strict=True))
    return dict(zip(names, map(float, alone), strict=True))


def _table(scan: Scan, parameters: Sequence[Parameter], search: _Search, kept: Mapping[str, float]) -> list[Found]:
    values = dict(zip(search.known, zip(*map(np.ndarray.tolist, search.found()), strict=True), strict=True))
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


def _residual(level: Level, stage: Stage, change: Change, views: Views | Sway | None) -> np.ndarray:
    """What a volume leaves of the frames (F, rows, columns) after a change."""
    operator = level.operator(change, views)
    volume = level.reconstruct(operator, None, stage.first)
    return level.line_integrals(operator, volume) - level.masked(operator.forward(volume))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
