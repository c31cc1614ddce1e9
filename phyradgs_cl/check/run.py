"""Asks all questions about a scan, in an order in which each may rely on earlier answers. Errors that are found, such as a
shifted panel, are corrected for later questions."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.coarse import (
    FINE_COLUMNS,
    QUICK_COLUMNS,
    around_object,
    coarse,
    some_frames,
)
from phyradgs_cl.check import consistency, coverage, detector, orbit, shutter, timing
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding, same_from_everywhere
from phyradgs_cl.check.hypotheses import has_axis_near_edge
from phyradgs_cl.detector import without_lag
from phyradgs_cl.errors import InputError
from phyradgs_cl.io.scan.reader import united
from phyradgs_cl.runtime import Runtime

_SPARE_COLUMNS = 2.0  # room in the grid for an error of the stated detector offset, in coarse columns
Report = Callable[[int, int, str], None]
"""A callback for progress. It takes the number of answered questions, the number of all questions, and the next question."""


@dataclass(frozen=True, eq=False)
class CheckResult:
    """The findings of a check, in order.

    offset_mm: the shift of the panel along u, from its stated place, that explains the frames best. offset_spread_mm: the
    shift's standard deviation. Both are NaN if no shift fits best. Both are NaN too, and ``is_consistent`` is False, if
    something else has to be corrected first."""

    findings: list[Finding]
    offset_mm: float = math.nan
    offset_spread_mm: float = math.nan
    is_consistent: bool = True

    @property
    def suspicious(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.verdict == SUSPICIOUS]


class _Answers:
    """Collects the findings, and reports the progress after each."""

    def __init__(self, questions: list[str], report: Report) -> None:
        self.findings: list[Finding] = []
        self._questions, self._report = [*questions, ""], report
        self._say()

    def add(self, finding: Finding) -> Finding:
        if finding.question == orbit.DISTANCES and finding.verdict == CANNOT_TELL:
            finding = replace(finding, text=f"{finding.text}; {orbit.UNVERIFIED}")
        self.findings.append(finding)
        self._say()
        return finding

    def stop(self) -> CheckResult:
        """Answers all remaining questions with "cannot tell", because of the last finding, and returns the result."""
        cause = self.findings[-1]
        for question in self._questions[len(self.findings) : -1]:
            self.add(Finding(question, CANNOT_TELL, 0.0, 0.0, "", f"rests on {cause.question}: {cause.verdict}"))
        return CheckResult(self.findings, is_consistent=False)

    def _say(self) -> None:
        count = len(self.findings)
        self._report(count, len(self._questions) - 1, self._questions[count])


def check(
    scan: Scan, rt: Runtime, counts: detector.CountReader | None = None,
    report: Report = lambda done, total, question: None,
) -> CheckResult:
    """Returns the findings about a scan. counts: the ``CountReader`` with which the scan's file was read, or None.
    report: called with the number of answered questions, the number of all questions, and the next question.

    Raises InputError where every pixel is masked, and for NaN or infinity at other pixels."""
    scan = without_lag(_finite(scan))
    noisy = coverage.find_noise(scan)
    questions = ["timing", "angles", "saturation", "dead pixels", *([coverage.NOISE] if noisy else []), "coverage"]
    questions.append(consistency.CONSISTENCY)
    questions += [orbit.SIGN, orbit.CENTRE, *([] if scan.is_parallel else [orbit.DISTANCES]), detector.GAIN]
    if scan.is_fly and scan.shutter.exposure_s + scan.shutter.readout_s > 0:
        questions.append(shutter.READOUT)
    if scan.shutter.exposure_s > 0:
        questions.append(shutter.EXPOSURE)
    answers = _Answers(questions, report)
    answers.add(timing.check_timing(scan))
    answers.add(timing.check_angles(scan))
    saturation = answers.add(detector.check_saturation(scan, counts))
    if saturation.unit == detector.OVERFLOW:
        return answers.stop()
    finding, dead = detector.check_dead_pixels(scan)
    if finding.verdict == SUSPICIOUS and saturation.verdict != OK:  # a saturated pixel is as constant as a dead one
        finding = replace(finding, verdict=CANNOT_TELL, text=f"rests on saturation: {saturation.verdict}", advice="")
    answers.add(finding)
    if noisy:
        answers.add(noisy)
    scan = replace(scan, pixel_mask=united(scan.pixel_mask, dead))
    covered = answers.add(coverage.check_coverage(scan))
    if covered.unit in (coverage.NO_OBJECT, coverage.OPAQUE, coverage.TOO_BRIGHT):
        return answers.stop()
    every = quick_scan(scan)
    consistent = consistency.check_consistency(rt, every, scan)
    found = consistent.finding
    if noisy and found.verdict == SUSPICIOUS:
        found = replace(found, verdict=CANNOT_TELL, text=f"rests on {coverage.NOISE}: {SUSPICIOUS}", advice="")
    answers.add(found)
    if not consistent.is_sound:
        return answers.stop()
    quick = some_frames(every, consistent.frames)
    turn = orbit.find_orbit(rt, quick, scan, consistent.sees_angles)
    answers.add(turn.sign)
    answers.add(turn.centre)
    quick = around_object(turn.corrected(quick))

    def ask(question: str, check_question: Callable[[Runtime, Scan], Finding], coarse_scan: Scan) -> None:
        answers.add(check_question(rt, coarse_scan) if consistent.sees_angles else same_from_everywhere(question))

    if not scan.is_parallel:
        ask(orbit.DISTANCES, orbit.check_distances, quick)
    gain = detector.check_gain(rt, quick)
    if gain.verdict == SUSPICIOUS and covered.unit == coverage.CUT_OFF:  # an object beyond the panel changes levels too
        gain = replace(gain, verdict=CANNOT_TELL, text=f"{gain.text}, or the object does beyond the panel")
    answers.add(gain)
    if shutter.READOUT in questions:
        fine = coarse(some_frames(scan, consistent.frames), FINE_COLUMNS)
        ask(shutter.READOUT, shutter.check_readout, around_object(turn.corrected(fine)))
    if shutter.EXPOSURE in questions:
        ask(shutter.EXPOSURE, shutter.check_exposure, quick)
    if turn.is_reversed or turn.centre.unit == orbit.OTHER_CAUSE:  # the offset holds only after another correction
        return CheckResult(answers.findings, is_consistent=False)
    pitch_mm = scan.geometry.pixel_size_mm[1]
    return CheckResult(answers.findings, turn.shift.pixels * pitch_mm, turn.shift.deviation * pitch_mm)


def quick_scan(scan: Scan) -> Scan:
    """Returns the coarse scan, with all frames, for all questions that need a reconstruction, except that about the readout.

    If the axis is near the panel's edge, the grid is cut to the object: with many voxels of air, the few frames of a coarse
    scan would fit under wrong angles too."""
    quick = coarse(scan, QUICK_COLUMNS, scan.frames)
    return around_object(quick, _SPARE_COLUMNS) if has_axis_near_edge(scan) else quick


def _finite(scan: Scan) -> Scan:
    """Returns the scan with zeros for masked values that are not finite. Raises InputError for unmasked values that are not
    finite, and where every pixel is masked."""
    p = np.asarray(scan.projections)
    if not scan.valid.any():
        raise InputError("pixel_mask", "every pixel masked", "at least one usable pixel", "correct the mask")
    is_finite = np.isfinite(p)
    if is_finite.all():
        return scan
    checks.finite("projections", p[scan.valid])
    return replace(scan, projections=np.where(is_finite, p, 0).astype(np.float32))
