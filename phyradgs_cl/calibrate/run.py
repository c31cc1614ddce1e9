"""From coarse to fine: a volume, the signals that it leaves, a step of what they tell, and again."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.beads import BeadLevel
from phyradgs_cl.calibrate.finding import AGREES, CANNOT_TELL, CORRECTED, Calibration, Found
from phyradgs_cl.calibrate.level import MOST_FRAMES, Level
from phyradgs_cl.calibrate.moved import Change, Sway, Views, evenly_lit, moved
from phyradgs_cl.calibrate.parameters import (
    DIRECTION,
    PARAMETERS,
    WOBBLE,
    Parameter,
    change_of,
    chosen,
    in_words,
)
from phyradgs_cl.calibrate.placing import WRONG_PHANTOM, bead_centres_mm, placements
from phyradgs_cl.calibrate.reduced import Reduced, alike, gauge_share, identifiable, least_share, reduced
from phyradgs_cl.calibrate.views import KINDS_OF, Wobble, find_sway, find_wobble, passes_of
from phyradgs_cl.calibrate.work import Passes, Report, Work, cost_of
from phyradgs_cl.check.coarse import QUICK, coarse
from phyradgs_cl.check.questions.coverage import CUT_OFF, check_coverage
from phyradgs_cl.check.questions.offset import best_offset, rough_offset
from phyradgs_cl.check.questions.timing import start_azimuths_rad
from phyradgs_cl.check.statistics import residual_ratio, t_statistic
from phyradgs_cl.check.variants import reversed_readout
from phyradgs_cl.errors import InputError
from phyradgs_cl.phantoms import EllipsoidPhantom
from phyradgs_cl.reconstructors.frames.preprocess import Preprocessing, prepared
from phyradgs_cl.runtime import Runtime

log = logging.getLogger(__name__)
Maker = Callable[..., Level | BeadLevel]
Finder = Callable[[Runtime, Scan, Sequence[tuple[int, int, int]], Change, Work], Wobble]
DEVIATIONS = 3.0  # by which a parameter has to differ from what is stated
_FEWEST_FRAMES, _FEWEST_COLUMNS = 8, 12
_MOST_PX = 2.0  # of a level, per step: signals are straight lines no further
LEAST_OF_BEADS = 0.02  # of a parameter's signal, of a known shape: voxels explain nothing by accident
_LEAST_EXPLAINED = 0.3  # of the frames' variance, by beads that lie best, before anything is put right
_ORDER_ERRORS, _ORDER_RATIO = 4.0, 1.04  # of the other order's residual, as ``check`` has them
_OF_FRAMES = ("lag", "drift")  # what is no matter of poses
_FEWEST_SPLINES = 4  # cubic ones
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

    def passes(self, parameters: int, steps: int, asks: bool) -> int:
        """Passes through the frames of so many last ``steps``, at most; ``asks``: what the frames tell, too."""
        first = self.first - self.again if steps == self.steps else 0
        return first + steps * (self.again + self.project * (parameters + (3 if asks else 1)))


BEAD_STAGES = (Stage(48, 6, 0, 8, 4), Stage(128, 6, 0, 6, 4))
STAGES = (Stage(24, 6, 40, 40, 15), Stage(48, 3, 20, 40, 12), Stage(96, 3, 30, 50, 15))


@dataclass(eq=False)
class _Search:
    """Where the search stands: ``at``, values by name, and ``former`` at the end of the stage before, if of voxels;
    ``known``: those that the frames tell; the last stage's problem."""

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
    report: Report = lambda done, total, text, share: None,
    phantom: EllipsoidPhantom | None = None,
    splines: int = 0,
) -> Calibration:
    """The scan with its true geometry and timing as far as its frames tell them; ``what``: parameters with commas, None the
    usual ones. ``others``: more scans of the same object, lying as it did, that share what is wrong. ``phantom``: what the
    object is, wherever it lies. ``splines``: of time, that a wobble goes by, 0 for every view by itself.

    InputError for parameters that there are not, a scan too small, others that do not fit the first, a phantom that is not
    what frames show."""
    parameters, per_view, asks_direction = chosen(what, scan, phantom is not None)
    asks_lag = any(one.name == "lag" for one in parameters)
    ready = [prepared(one, Preprocessing(ignore_lag=asks_lag)) for one in (scan, *others)]
    if splines and per_view != WOBBLE:
        raise InputError("--splines", str(splines), f"with --what {WOBBLE}", f"leave it out, or ask for {WOBBLE}")
    _check(ready, [one.name for one in parameters], per_view, phantom)
    if splines:
        checks.whole("--splines", splines, _FEWEST_SPLINES, scan.frames)
    _warn_of_truncation(ready[0], phantom)
    _warn_of_same_turn(ready)
    stages = STAGES if phantom is None else BEAD_STAGES
    levels = [stage for k, stage in enumerate(stages) if k == 0 or _blocks(scan, stage) < _blocks(scan, stages[k - 1])]
    make: Maker = partial(Level.of, rt, asks_lag)
    of_views = [(stage.columns, stage.first, stage.again) for stage in levels]
    work = Work(report, _plan(ready, levels, parameters, per_view, asks_direction))
    work.begin("start", "where the axis is")
    search = _Search(at=_start(rt, ready[0]) if any(one.name == "offset-u" for one in parameters) else {})
    if phantom is not None:
        work.begin("start", "where the beads are")
        make = partial(BeadLevel.of, phantom, _placement(rt, ready, phantom, search))
    work.begin("order", "which line is read first")
    order = _order(make, work, ready, levels[min(1, len(levels) - 1)], search) if asks_direction else None
    if order is not None and order.verdict == CORRECTED:
        scan, ready = reversed_readout(scan), [reversed_readout(one) for one in ready]
    find: Finder = partial(find_wobble, splines=int(splines)) if per_view == WOBBLE else find_sway
    steady, wobbles = ready, {}
    if per_view and parameters:
        work.begin("views before", "views, before the rest")
        first = change_of(search.at)
        wobbles[first] = find(rt, ready[0], of_views, first, work)
        steady = [_steady(ready[0], wobbles[first].views, search)]
    for number, stage in enumerate(levels if parameters else ()):
        work.begin(f"stage {number}", f"at most {stage.columns} columns")
        cost = cost_of(steady, stage.columns, MOST_FRAMES)
        level = replace(make(steady, stage.columns), count_pass=work.counts(cost))
        _descend(level, stage, parameters, search, partial(work.expect_at, cost))
        if not search.known:
            break
        work.plan |= _plan_of_stages(steady, levels, len(search.known), number + 1)
    kept = _corrections(search)
    change, views, table_of_views = change_of(kept), None, []
    if per_view:
        work.begin("views", "views")
        wobble = wobbles[change] if change in wobbles else find(rt, ready[0], of_views, change, work)
        views, table_of_views = wobble.views, wobble.table
    work.begin("residuals", "residuals")
    most_frames = MOST_FRAMES if views is None else scan.frames
    level = make(ready, levels[-1].columns, most_frames)
    level = replace(level, count_pass=work.counts(cost_of(ready, levels[-1].columns, most_frames)))
    before = _residual(level, levels[-1], Change(), None)
    after = _residual(level, levels[-1], change, views)
    if views is None and _rms(after) > _rms(before):  # what explains the frames worse is not what was wrong
        kept, change, after, search.known = {}, Change(), before, ()
    table = ([] if order is None else [order]) + _table(scan, parameters, search, kept) + table_of_views
    corrected = moved(scan, change, views) if kept or views is not None else scan
    corrected = evenly_lit(corrected, change.drift) if change.drift else corrected
    calibration = Calibration(corrected, table, search.alike, (_rms(before), _rms(after)), before, after, views)
    return replace(calibration, scan=replace(corrected, provenance=_told(scan, calibration)))


def _plan(
    scans: Sequence[Scan], levels: Sequence[Stage], parameters: Sequence[Parameter], per_view: str, asks_direction: bool
) -> dict[str, Passes]:
    """Passes through the frames of all phases, at most."""
    of_views = [(stage.columns, stage.first, stage.again) for stage in levels]
    views = passes_of(scans[0], of_views, KINDS_OF[per_view]) if per_view else []
    second, last = levels[min(1, len(levels) - 1)], levels[-1]
    most_frames = scans[0].frames if per_view else MOST_FRAMES
    return {
        "start": [],
        "order": [(cost_of(scans, second.columns, MOST_FRAMES), 2 * second.first)] if asks_direction else [],
        "views before": views if parameters else [],
        **(_plan_of_stages(scans, levels, len(parameters), 0) if parameters else {}),
        "views": views,
        "residuals": [(cost_of(scans, last.columns, most_frames), 2 * last.first)],
    }


def _plan_of_stages(scans: Sequence[Scan], levels: Sequence[Stage], parameters: int, start: int) -> dict[str, Passes]:
    """Those of the stages from ``start`` on."""
    return {
        f"stage {k}": [(cost_of(scans, stage.columns, MOST_FRAMES), stage.passes(parameters, stage.steps, k == 0))]
        for k, stage in enumerate(levels)
        if k >= start
    }


def _told(scan: Scan, calibration: Calibration) -> dict[str, Any]:
    """The scan's provenance with what was found now, and what had been found before."""
    now = {**calibration.facts(), "program": f"phyradgs-cl {__version__}"}
    former = [one for one in (scan.provenance.get("calibration"),) if one is not None]
    earlier = scan.provenance.get("calibrated_before", [])
    return {
        **scan.provenance,
        "calibration": now,
        **({"calibrated_before": [*(earlier if isinstance(earlier, list) else []), *former]} if former else {}),
    }


def _warn_of_truncation(scan: Scan, phantom: EllipsoidPhantom | None) -> None:
    """Says where the object is wider than what is seen, unless its shape is known."""
    if phantom is None and check_coverage(scan).unit == CUT_OFF:
        text = "calibrate: the object reaches beyond the panel, which can look like a panel that stands elsewhere: %s"
        log.warning(text, "give it a grid that holds the whole object (--roi-mm), and look at slices before and after")


def _warn_of_same_turn(scans: Sequence[Scan]) -> None:
    """Says where other scans are of the same turn and timing: they tell nothing of it that the first does not."""
    first, *others = scans
    for other in others:
        is_as_long = len(other.frame_start_s) == len(first.frame_start_s) and other.shutter == first.shutter
        if is_as_long and np.allclose(start_azimuths_rad(other), start_azimuths_rad(first), atol=1e-3):
            text = "calibrate: --with turns as the first scan does: %s"
            log.warning(text, "of readout and exposure only one that turns the other way, or at another speed, tells more")


def _start(rt: Runtime, scan: Scan) -> dict[str, float]:
    """Where the axis is on the panel, as ``check`` sees it: steps lead there from a few pixels away only."""
    quick = coarse(scan, QUICK)
    offset = best_offset(rt, quick, rough_offset(rt, quick))
    pitch_mm = scan.geometry.pixel_size_mm[1]
    return {"offset-u": offset.pixels * pitch_mm} if np.isfinite(offset.pixels) else {}


def _steady(scan: Scan, views: Views | Sway | None, search: _Search) -> Scan:
    """The scan without what its views are off by, which would pass for a roll; but for a shift along u that all views share,
    which is the panel's offset where that is asked for."""
    if isinstance(views, Views) and "offset-u" in search.at:
        shared_mm = float(views.shift_mm[:, 1].mean())
        search.at["offset-u"] += shared_mm
        views = replace(views, shift_mm=views.shift_mm - [0.0, shared_mm])
    return scan if views is None else moved(scan, Change(), views)


def _placement(rt: Runtime, scans: Sequence[Scan], phantom: EllipsoidPhantom, search: _Search) -> np.ndarray:
    """How the phantom lies (7,), about: of the places where its beads are seen, that which explains the frames best."""
    bead_centres_mm(phantom)
    change = change_of(search.at)
    first = Level.of(rt, False, scans, STAGES[-1].columns)
    volume = first.reconstruct(first.operator(change), None, STAGES[-1].first)
    stage, best = BEAD_STAGES[0], []
    for place in placements(phantom, volume, first.grid):
        level = BeadLevel.of(phantom, np.array([*place, 1.0]), scans, stage.columns)
        operator = level.operator(change)
        found = level.reconstruct(operator, None, stage.first)
        best.append((level.explained(operator, found), found))
    share, placement = max(best, key=lambda one: one[0])
    if share < _LEAST_EXPLAINED:
        raise InputError("--phantom", f"beads that explain {100 * share:.0f} % of the frames", "most", WRONG_PHANTOM)
    return placement


def _order(make: Maker, work: Work, scans: Sequence[Scan], stage: Stage, search: _Search) -> Found:
    """Are lines read from the stated end? Told by four standard errors of the frames' residuals, and a share; the deviation
    is that by which 1 and −1 differ as they do."""
    counts = work.counts(cost_of(scans, stage.columns, MOST_FRAMES))
    levels = [
        replace(make(some, stage.columns), count_pass=counts) for some in (scans, [reversed_readout(scan) for scan in scans])
    ]
    stated, other = (
        np.mean(np.square(_residual(level, stage, change_of(search.at), None), dtype=np.float64), (1, 2)) for level in levels
    )
    errors, ratio = t_statistic(stated, other), residual_ratio(stated, other)
    direction, share = float(scans[0].shutter.direction), abs(1 - min(ratio, 1 / ratio))
    if abs(errors) < _ORDER_ERRORS or max(ratio, 1 / ratio) < _ORDER_RATIO:
        return Found(DIRECTION, "", direction, None, None, share, CANNOT_TELL)
    verdict, found = (AGREES, direction) if errors > 0 else (CORRECTED, -direction)
    return Found(DIRECTION, "", direction, found, 2 / abs(errors), share, verdict)


def _blocks(scan: Scan, stage: Stage) -> int:
    return -(-max(scan.geometry.detector_shape) // stage.columns)


def _check(scans: Sequence[Scan], names: Sequence[str], per_view: str, phantom: EllipsoidPhantom | None) -> None:
    first = scans[0]
    for scan in scans:
        scan.check_sight()
    unsuited = [per_view] * bool(per_view) + [name for name in _OF_FRAMES if name in names]
    if unsuited and phantom is not None:
        expected = "parameters of geometry and timing, of all views"
        raise InputError(f"--what {unsuited[0]}", "with a phantom", expected, "leave one of the two out")
    if per_view and "lag" in names:
        raise InputError(f"--what {per_view}", "with lag", "one of the two at a time", "ask twice")
    if per_view and len(scans) > 1:
        raise InputError(f"--what {per_view}", "a second scan", "one scan: views are each scan's own", "leave --with out")
    if first.frames < _FEWEST_FRAMES or first.geometry.detector_shape[1] < _FEWEST_COLUMNS:
        found = f"{first.frames} frames of {first.geometry.detector_shape[1]} columns"
        raise InputError("scan", found, f"at least {_FEWEST_FRAMES} frames of {_FEWEST_COLUMNS} columns")
    for other in scans[1:]:
        for name in ("geometry", "grid", "detector_model", "lag"):
            if getattr(other, name) != getattr(first, name):
                found = str(getattr(other, name))
                raise InputError(f"--with: {name}", found, f"the first scan's, {getattr(first, name)}")
        if other.shutter.axis != first.shutter.axis:
            raise InputError("--with: readout axis", other.shutter.axis, f"the first scan's, {first.shutter.axis}")


def _descend(
    level: Level | BeadLevel,
    stage: Stage,
    parameters: Sequence[Parameter],
    search: _Search,
    expect: Callable[[int], None],
) -> None:
    """Steps on one level until they are small; which parameters the frames tell is asked at each step of the first one."""
    volume: np.ndarray | None = None
    asks = search.problem is None
    search.former = {} if asks or isinstance(level, BeadLevel) else dict(search.at)
    for number in range(stage.steps):
        asked = parameters if asks else [PARAMETERS[name] for name in search.known]
        expect(stage.passes(len(asked), stage.steps - number, asks))
        operator: Any = level.operator(change_of(search.at))
        here = level.at(change_of(search.at))
        volume = here.reconstruct(operator, volume, stage.again if number else stage.first)
        problem = reduced(level, asked, search.at, volume, stage.project)
        if asks:
            least = LEAST_OF_BEADS
            if isinstance(level, Level):
                least = least_share(gauge_share(level, search.at, volume, stage.project))
            _ask(problem, least, search)
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


def _limited(one: Parameter, level: Level | BeadLevel, old: float, new: float) -> float:
    """``new`` as far as a step from ``old`` may go."""
    most = _MOST_PX * level.block / one.pixels(level.scans[0])
    return max(old + float(np.clip(new - old, -most, most)), one.lowest(level.scans[0]))


def _ask(problem: Reduced, least: float, search: _Search) -> None:
    """Which parameters the frames tell: of whose signals ``least`` is left, to more than nothing; and what they cannot tell
    apart."""
    shared = identifiable(problem, least)
    deviations = problem.only(shared).deviations() if shared else ()
    search.known = tuple(n for n, d in zip(shared, deviations, strict=True) if PARAMETERS[n].is_told(float(d)))
    search.alike = [in_words(weights) for weights in alike(problem, least)]
    search.shares = dict(zip(problem.names, problem.shares.tolist(), strict=True))


def _corrections(search: _Search) -> dict[str, float]:
    """The parameters that differ from what is stated by three deviations, with the values that they have together while all
    others stay as stated: what then differs by less is left out as well."""
    values, deviations = search.found()
    names, kept = search.known, values
    while search.problem is not None and names:
        of_names = deviations[[search.known.index(name) for name in names]]
        off = np.abs(kept) > DEVIATIONS * of_names
        if off.all():
            break
        names = tuple(name for name, is_off in zip(names, off, strict=True) if is_off)
        kept = search.problem.only(names).step() if names else kept[:0]
    return dict(zip(names, map(float, kept), strict=True))


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


def _residual(level: Level | BeadLevel, stage: Stage, change: Change, views: Views | Sway | None) -> np.ndarray:
    """What a volume leaves of the frames (F, rows, columns) after a change."""
    operator: Any = level.operator(change, views)
    level = level.at(change)
    return level.residual(operator, level.reconstruct(operator, None, stage.first))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
