"""Calibrates a scan from its own frames.

The start is the axis that fits best and, for a known phantom, the place where its beads are seen. On request the readout's
direction is tested, and single views or a motion are corrected first. ``search.py`` then estimates what is common to all
views, from coarse to fine grids. After that, views or the motion are estimated again. Significant corrections enter the
scan and its provenance. If no views were corrected, corrections that raise the residual are dropped."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import start_azimuths_rad
from phyradgs_cl.acquisition.altered.coarse import MOST_FRAMES, QUICK_COLUMNS, coarse
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, perturb
from phyradgs_cl.acquisition.altered.variants import reversed_readout
from phyradgs_cl.acquisition.trajectory import continued
from phyradgs_cl.calibrate.beads import BeadProblem
from phyradgs_cl.calibrate.parameters import (
    BEYOND_PANEL,
    DIRECTION,
    OFFSET_U,
    WOBBLE,
    Request,
    correction_of,
    requested,
)
from phyradgs_cl.calibrate.per_view import (
    MotionParameters,
    PerViewParameters,
    ViewsEstimate,
    WobbleParameters,
    estimate_views,
    passes_of_views,
)
from phyradgs_cl.calibrate.placing import WRONG_PHANTOM, bead_centres_mm, placements
from phyradgs_cl.calibrate.problem import CoarseProblem, PassCounter, Passes, Report, Stage, pass_cost
from phyradgs_cl.calibrate.result import AGREES, CANNOT_TELL, CORRECTED, Calibration, ParameterEstimate, rms
from phyradgs_cl.calibrate.search import Fallback, Problem, Search
from phyradgs_cl.check import SUSPICIOUS
from phyradgs_cl.check.coverage import CUT_OFF, check_coverage
from phyradgs_cl.check.hypotheses import has_axis_near_edge
from phyradgs_cl.check.orbit import OTHER_CAUSE, centre_of
from phyradgs_cl.detector import without_lag
from phyradgs_cl.errors import InputError
from phyradgs_cl.phantoms import EllipsoidPhantom
from phyradgs_cl.reconstructors.fits.axis import axis_shift, columns_per_block
from phyradgs_cl.reconstructors.fits.residuals import residual_ratio, t_statistic
from phyradgs_cl.runtime import Runtime

log = logging.getLogger(__name__)
STAGES = (
    Stage(24, first=40, again=15, steps=6, project=40),
    Stage(48, first=40, again=12, steps=3, project=20),
    Stage(96, first=50, again=15, steps=3, project=30),
)
BEAD_STAGES = (Stage(48, first=8, again=4, steps=6, project=0), Stage(128, first=6, again=4, steps=6, project=0))
_FEWEST_FRAMES = 8  # with fewer frames a scan does not determine its geometry
_FEWEST_COLUMNS = 12  # with fewer columns a scan does not determine its geometry
_FEWEST_SPLINES = 4  # cubic splines need at least four coefficients
# In its best place, the right phantom explains at least this fraction of the frames' sum of squares, before corrections.
_LEAST_EXPLAINED = 0.3
_ORDER_ERRORS = 4.0  # least difference, in standard errors, of the squared residuals of both readout directions
_ORDER_RATIO = 1.04  # least (larger squared residual) / (smaller squared residual) of both readout directions
# An encoder table is continued at each end by this many times (exposure + readout), because early steps of the search may
# ask for times far beyond the table.
_BEYOND = 1e6
# In progress, (expected cost of a stage) / (its largest cost): mostly few parameters are determined, in few steps.
_EXPECTED_SHARE = 0.25


def calibrate(
    scan: Scan, rt: Runtime, what: str | None = None, others: Sequence[Scan] = (),
    report: Report = lambda done, total, text, share: None, phantom: EllipsoidPhantom | None = None,
    splines: int = 0, note: Callable[[str], None] = lambda line: None,
) -> Calibration:
    """Estimates a scan's true geometry and timing, as far as its frames determine them.

    - what: parameters separated by commas; None: the usual ones (``requested``).
    - others: more scans of the same object in the same place, with the same errors.
    - phantom: the object, in any place, if its shape is known.
    - splines: a wobble's number of splines of time; 0: each view has parameters of its own.
    - note: a function that is called after each grid with a line about the estimates so far.

    Raises InputError for what ``requested`` refuses, options that exclude each other, a scan too small, ``others`` that do
    not fit ``scan``, and a phantom that the frames do not show."""
    request = requested(what, scan, phantom is not None)
    ready = [
        without_lag(replace(one, trajectory=continued(one.trajectory, _BEYOND * one.shutter.span_s)))
        for one in (scan, *others)
    ]
    _check(ready, request, phantom, splines)
    is_cut = phantom is None and check_coverage(ready[0]).unit == CUT_OFF
    _warn(ready, is_cut)
    return _Calibrator(rt, scan, ready, request, phantom, is_cut, splines, report, note).run()


@dataclass(eq=False)
class _Calibrator:
    """One calibration: its inputs, its grids, and the progress of its phases. ``ready``: all scans, with lag removed and
    encoder tables continued. is_cut: whether an object of unknown shape reaches beyond the panel's sides."""

    rt: Runtime
    scan: Scan
    ready: list[Scan]
    request: Request
    phantom: EllipsoidPhantom | None
    is_cut: bool
    splines: int
    report: Report
    note: Callable[[str], None]

    def __post_init__(self) -> None:
        self.placement = np.zeros(0)
        self.stated = self.ready  # the scans as stated: ``ready`` may later get the other readout direction
        stages = {one.block(self.scan): one for one in reversed(STAGES if self.phantom is None else BEAD_STAGES)}
        # on a small panel several stages have blocks of the same size: the first stage of each size is kept
        self.stages = [replace(one, is_cut=self.is_cut) for one in reversed(stages.values())]
        self.per_view: PerViewParameters | None = None
        if self.request.per_view == WOBBLE:
            self.per_view = WobbleParameters.of(self.ready[0], self.splines)
        elif self.request.per_view:
            self.per_view = MotionParameters.of(self.ready[0])
        self.passes = PassCounter(self.report, self._plan())
        self.search = Search(self.request.parameters, held=BEYOND_PANEL if self.is_cut else ())
        self.views_estimates: dict[GeometryCorrection, ViewsEstimate] = {}

    def run(self) -> Calibration:
        self.passes.begin("start", "where the axis is")
        if OFFSET_U in self.request.names:
            self._start_from_axis()
        if self.phantom is not None:
            self.passes.begin("start", "where the beads are")
            self.placement = self._place(self.phantom)
        table = self._test_direction() if self.request.asks_direction else []
        if self.request.parameters:
            self._search_common()
        corrections = self.search.corrections()
        correction, views, views_table = correction_of(corrections), None, []
        if self.per_view is not None:
            self.passes.begin("views", "views")
            estimate = self._estimate_views(correction)
            views, views_table = estimate.views, estimate.table
        self.passes.begin("residuals", "residuals")
        most_frames = MOST_FRAMES if views is None else self.scan.frames
        problem = self._problem(self.ready, self.stages[-1], most_frames)
        is_as_stated = self.stated is self.ready
        as_stated = problem if is_as_stated else self._problem(self.stated, self.stages[-1], most_frames)
        before = self._residual(as_stated, self.stages[-1], GeometryCorrection())
        after = self._residual(problem, self.stages[-1], correction, views)
        held = {name: value for name, value in corrections.items() if name in self.search.held}
        before_rest = before  # the residual if only the held parameters are corrected
        if held:
            known = correction_of(held)
            before_rest = after if held == corrections else self._residual(as_stated, self.stages[-1], known)
        if views is None and rms(after) > rms(before_rest):  # a correction that explains the frames worse is not applied
            corrections, correction, after = held, correction_of(held), before_rest
            self.search.keep_held()
        table += self.search.table(self.scan, corrections) + views_table
        later_s = max(0.0, correction.exposure_s) + max(0.0, correction.readout_s)
        stated = replace(self.scan, trajectory=continued(self.scan.trajectory, later_s)) if later_s else self.scan
        corrected = perturb(stated, correction, views) if corrections or views is not None else self.scan
        alike = list(self.search.alike)
        if beyond := [name for name in self.request.names if self.is_cut and name in BEYOND_PANEL]:
            alike.append(f"{', '.join(beyond)}: looks like matter beyond the panel's sides")
        calibration = Calibration(corrected, table, alike, (rms(before), rms(after)), before, after, views)
        return replace(calibration, scan=_with_provenance(corrected, self.scan, calibration))

    def _start_from_axis(self) -> None:
        """Starts from the offset that ``check`` finds, because Gauss–Newton steps find the right offset only within a few
        pixels of it.

        In half a turn of nearly parallel rays, a volume explains most of what an offset changes. The search cannot determine
        the offset there, so ``check``'s answer stands. The answer also stands if the panel sees less than half of the rays
        twice, because a wrong shift under which even fewer rays are seen twice would fit better."""
        if self.phantom is None and has_axis_near_edge(self.ready[0]):
            self.search.held += (OFFSET_U,)
        quick, pitch_mm = coarse(self.ready[0], QUICK_COLUMNS), self.scan.geometry.pixel_size_mm[1]
        shift, finding = centre_of(axis_shift(self.rt, quick), columns_per_block(quick), self.ready[0])
        if not shift.is_found or (OFFSET_U in self.search.held and finding.verdict == CANNOT_TELL):
            return
        self.search.at[OFFSET_U] = shift.pixels * pitch_mm
        if finding.verdict != CANNOT_TELL and finding.unit != OTHER_CAUSE:
            is_significant = finding.verdict == SUSPICIOUS
            self.search.fallback = {OFFSET_U: Fallback(shift.pixels * pitch_mm, shift.deviation * pitch_mm, is_significant)}

    def _search_common(self) -> None:
        """Searches for the parameters that all views share. Where requested, corrects single views first, because their
        errors would look like a roll."""
        steady = self.ready
        if self.per_view is not None:
            self.passes.begin("views before", "views, before the rest")
            steady = [self._with_steady_views(self.ready[0])]
        for number, stage in enumerate(self.stages):
            self.passes.begin(f"stage {number}", f"at most {stage.columns} columns")
            self.search.descend(self._problem(steady, stage), stage)
            units = [(one, "" if one.found is None else f" {one.unit}") for one in self.search.table(self.scan, {})]
            estimates = ", ".join(f"{one.name} {one.words}{unit}" for one, unit in units)
            self.note(f"so far, {stage.columns} columns: {estimates}")
            if not self.search.determined:
                return
            self.passes.plan |= self._plan_of_stages(len(self.search.determined), number + 1)

    def _with_steady_views(self, scan: Scan) -> Scan:
        """Returns the scan with its single views corrected. If the search has an offset along u, the views' mean shift along
        u is added to this offset instead."""
        views = self._estimate_views(correction_of(self.search.at)).views
        if isinstance(views, Views) and OFFSET_U in self.search.at:
            common_mm = float(views.shift_mm[:, 1].mean())
            self.search.at[OFFSET_U] += common_mm
            views = replace(views, shift_mm=views.shift_mm - [0.0, common_mm])
        return scan if views is None else perturb(scan, GeometryCorrection(), views)

    def _estimate_views(self, correction: GeometryCorrection) -> ViewsEstimate:
        """Returns the estimate of single views of the scan after ``correction``; computed only once per correction."""
        assert self.per_view is not None
        if correction not in self.views_estimates:
            self.views_estimates[correction] = estimate_views(
                self.rt, self.ready[0], self.per_view, self.stages, correction, self.passes
            )
        return self.views_estimates[correction]

    def _problem(self, scans: Sequence[Scan], stage: Stage, most_frames: int = MOST_FRAMES) -> Problem:
        problem: Problem
        if self.phantom is None:
            problem = CoarseProblem.of(self.rt, scans, stage, most_frames)
        else:
            problem = BeadProblem.of(self.phantom, self.placement, scans, stage, most_frames)
        return replace(problem, count_pass=self.passes.counter(pass_cost(scans, stage.columns, most_frames)))

    def _place(self, phantom: EllipsoidPhantom) -> np.ndarray:
        """Returns a first placement (7,) of the phantom: of those that take its beads to bright spots of a volume, the one
        that fits the frames best. Raises InputError if none fits well."""
        bead_centres_mm(phantom)
        correction = correction_of(self.search.at)
        voxels = CoarseProblem.of(self.rt, self.ready, STAGES[-1])
        volume = voxels.reconstruct(voxels.operator(correction), None, STAGES[-1].first)
        candidates = []
        for place in placements(phantom, volume, voxels.grid):
            problem = BeadProblem.of(phantom, np.array([*place, 1.0]), self.ready, self.stages[0])
            operator = problem.operator(correction)
            placement = problem.reconstruct(operator, None, self.stages[0].first)
            candidates.append((problem.explained(operator, placement), placement))
        share, placement = max(candidates, key=lambda one: one[0])
        if share < _LEAST_EXPLAINED:
            explained = f"beads that explain {100 * share:.0f} % of the frames"
            raise InputError("--phantom", explained, f"{100 * _LEAST_EXPLAINED:.0f} % or more", WRONG_PHANTOM)
        return placement

    def _test_direction(self) -> list[ParameterEstimate]:
        """Compares the residuals for both directions of the readout. Takes the other direction if it fits better. Returns an
        estimate of the direction for the table.

        Only squared residuals that differ by four standard errors and by 4 % decide. The direction is 1 or −1. Its standard
        deviation is 2 / (number of standard errors), where 2 is the difference between 1 and −1."""
        self.passes.begin("order", "which line is read first")
        stage = self.stages[min(1, len(self.stages) - 1)]
        reverse = [reversed_readout(scan) for scan in self.ready]
        stated, other = (
            np.mean(np.square(self._residual(problem, stage, correction_of(self.search.at)), dtype=np.float64), (1, 2))
            for problem in (self._problem(scans, stage) for scans in (self.ready, reverse))
        )
        errors, ratio = t_statistic(stated, other), residual_ratio(stated, other)
        direction, share = float(self.scan.shutter.direction), abs(1 - min(ratio, 1 / ratio))
        if abs(errors) < _ORDER_ERRORS or max(ratio, 1 / ratio) < _ORDER_RATIO:
            return [ParameterEstimate(DIRECTION, "", direction, None, None, share, CANNOT_TELL)]
        if errors > 0:
            return [ParameterEstimate(DIRECTION, "", direction, direction, 2 / abs(errors), share, AGREES)]
        self.scan, self.ready = reversed_readout(self.scan), reverse
        return [ParameterEstimate(DIRECTION, "", direction, -direction, 2 / abs(errors), share, CORRECTED)]

    def _residual(
        self, problem: Problem, stage: Stage, correction: GeometryCorrection, views: Views | Sway | None = None
    ) -> np.ndarray:
        operator: Any = problem.operator(correction, views)
        return problem.residual(operator, problem.reconstruct(operator, None, stage.first))

    def _plan(self) -> dict[str, Passes]:
        """Returns the phases in order, each with its largest number of passes through the frames and their expected cost."""
        second, last = self.stages[min(1, len(self.stages) - 1)], self.stages[-1]
        parameters, views, most_frames = len(self.request.parameters), (0, 0.0), MOST_FRAMES
        if self.per_view is not None:
            views = passes_of_views(self.ready[0], self.stages, len(self.per_view.KINDS))
            most_frames = self.scan.frames
        return {
            "start": (0, 0.0),
            "order": self._passes(second, 2 * second.first if self.request.asks_direction else 0),
            "views before": views if parameters else (0, 0.0),
            **(self._plan_of_stages(parameters, 0) if parameters else {}),
            "views": views,
            "residuals": self._passes(last, 2 * last.first, most_frames),
        }

    def _plan_of_stages(self, parameters: int, start: int) -> dict[str, Passes]:
        plan = {}
        for k, stage in list(enumerate(self.stages))[start:]:
            passes, cost = self._passes(stage, stage.passes(parameters, k == 0))
            plan[f"stage {k}"] = passes, _EXPECTED_SHARE * cost
        return plan

    def _passes(self, stage: Stage, count: int, most_frames: int = MOST_FRAMES) -> Passes:
        return count, count * pass_cost(self.ready, stage.columns, most_frames)


def _with_provenance(corrected: Scan, scan: Scan, calibration: Calibration) -> Scan:
    provenance = dict(scan.provenance)
    if (former := provenance.get("calibration")) is not None:
        earlier = provenance.get("calibrated_before", [])
        provenance["calibrated_before"] = [*(earlier if isinstance(earlier, list) else []), former]
    provenance["calibration"] = {**calibration.facts(), "program": f"phyradgs-cl {__version__}"}
    return replace(corrected, provenance=provenance)


def _check(scans: Sequence[Scan], request: Request, phantom: EllipsoidPhantom | None, splines: int) -> None:
    first, per_view = scans[0], request.per_view
    if splines and per_view != WOBBLE:
        raise InputError("--splines", str(splines), f"with --what {WOBBLE}", f"leave it out, or ask for {WOBBLE}")
    for scan in scans:
        scan.check_sight()
    if per_view and phantom is not None:
        raise InputError(f"--what {per_view}", "given with a phantom", "parameters of all views", "leave one of the two out")
    if per_view and len(scans) > 1:
        expected = "one scan, because views differ from scan to scan"
        raise InputError(f"--what {per_view}", "a second scan", expected, "leave --with out")
    rows, columns = first.geometry.detector_shape
    if first.frames < _FEWEST_FRAMES or columns < _FEWEST_COLUMNS:
        expected = f"at least {_FEWEST_FRAMES} frames of {_FEWEST_COLUMNS} columns"
        raise InputError("scan", f"{first.frames} frames of {columns} columns", expected)
    if splines:
        checks.whole("--splines", splines, _FEWEST_SPLINES, first.frames)
    for other in scans[1:]:
        for name in ("geometry", "grid", "detector_model", "lag"):
            if getattr(other, name) != getattr(first, name):
                stated = str(getattr(other, name))
                raise InputError(f"--with: {name}", stated, f"that of the first scan, {getattr(first, name)}")
        if other.shutter.axis != first.shutter.axis:
            raise InputError("--with: readout axis", other.shutter.axis, f"that of the first scan, {first.shutter.axis}")


def _warn(scans: Sequence[Scan], is_cut: bool) -> None:
    first, *others = scans
    if is_cut:
        log.warning(
            "calibrate: the object reaches beyond the panel's sides: tilts and offset-v stay as stated; "
            "compare slices before and after"
        )
    for other in others:
        is_as_long = len(other.frame_start_s) == len(first.frame_start_s) and other.shutter == first.shutter
        if is_as_long and np.allclose(start_azimuths_rad(other), start_azimuths_rad(first), atol=1e-3):
            log.warning(
                "calibrate: --with turns as the first scan does: only a scan that turns the other way, or at another "
                "speed, adds information about readout and exposure"
            )
