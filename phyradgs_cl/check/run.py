"""All questions in an order in which each rests on the ones before: each error found is corrected for the next question."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.coarse import FINE_COLUMNS, QUICK_COLUMNS, coarse, some_frames
from phyradgs_cl.check.consistency import CONSISTENCY, check_consistency
from phyradgs_cl.check.coverage import CUT_OFF, NO_OBJECT, OPAQUE, TOO_BRIGHT, check_coverage
from phyradgs_cl.check.detector import (
    GAIN,
    OVERFLOW,
    CountReader,
    check_dead_pixels,
    check_gain,
    check_saturation,
)
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding, same_from_everywhere
from phyradgs_cl.check.orbit import (
    CENTRE,
    DISTANCES,
    OTHER_CAUSE,
    SIGN,
    UNVERIFIED,
    check_distances,
    find_orbit,
)
from phyradgs_cl.check.shutter import EXPOSURE, READOUT, check_exposure, check_readout
from phyradgs_cl.check.timing import check_angles, check_timing
from phyradgs_cl.detector import without_lag
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import Runtime

Report = Callable[[int, int, str], None]
"""Takes how many questions are answered, how many there are, and the next one."""


@dataclass(frozen=True, eq=False)
class CheckResult:
    """The findings in order. ``offset_mm``: the shift of the panel along u that explains the frames best, with its standard
    deviation ``offset_spread_mm``; NaN where none does, or where something else has to be corrected first (then
    ``is_consistent`` is false)."""

    findings: list[Finding]
    offset_mm: float = math.nan
    offset_spread_mm: float = math.nan
    is_consistent: bool = True

    @property
    def suspicious(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.verdict == SUSPICIOUS]


class _Answers:
    """Collects the findings and reports each."""

    def __init__(self, questions: list[str], report: Report) -> None:
        self.findings: list[Finding] = []
        self._questions, self._report = [*questions, ""], report
        self._say()

    def add(self, finding: Finding) -> Finding:
        if finding.question == DISTANCES and finding.verdict == CANNOT_TELL:
            finding = replace(finding, text=f"{finding.text}; {UNVERIFIED}")
        self.findings.append(finding)
        self._say()
        return finding

    def stop(self) -> CheckResult:
        """Leaves the remaining questions open because of the last finding."""
        cause = self.findings[-1]
        for question in self._questions[len(self.findings) : -1]:
            self.add(Finding(question, CANNOT_TELL, 0.0, 0.0, "", f"rests on {cause.question}: {cause.verdict}"))
        return CheckResult(self.findings, is_consistent=False)

    def _say(self) -> None:
        count = len(self.findings)
        self._report(count, len(self._questions) - 1, self._questions[count])


def check(
    scan: Scan, rt: Runtime, counts: CountReader | None = None, report: Report = lambda done, total, question: None
) -> CheckResult:
    """Looks for what is wrong or suspicious in a scan. ``counts``: the reader of the scan's file, if it remembers counts.

    Raises InputError where every pixel is masked, and for NaN or infinity elsewhere."""
    scan = without_lag(_finite(scan))
    questions = ["timing", "angles", "saturation", "dead pixels", "coverage", CONSISTENCY, SIGN, CENTRE, DISTANCES, GAIN]
    if scan.is_fly and scan.shutter.exposure_s + scan.shutter.readout_s > 0:
        questions.append(READOUT)
    if scan.shutter.exposure_s > 0:
        questions.append(EXPOSURE)
    answers = _Answers(questions, report)
    answers.add(check_timing(scan))
    answers.add(check_angles(scan))
    saturation = answers.add(check_saturation(scan, counts))
    if saturation.unit == OVERFLOW:
        return answers.stop()
    finding, dead = check_dead_pixels(scan)
    if finding.verdict == SUSPICIOUS and saturation.verdict != OK:  # a saturated pixel is as constant as a dead one
        finding = replace(finding, verdict=CANNOT_TELL, text=f"rests on saturation: {saturation.verdict}", advice="")
    answers.add(finding)
    scan = _with_masked(scan, dead)
    coverage = answers.add(check_coverage(scan))
    if coverage.unit in (NO_OBJECT, OPAQUE, TOO_BRIGHT):
        return answers.stop()
    quick = coarse(scan, QUICK_COLUMNS)
    consistency = check_consistency(rt, quick, scan)
    answers.add(consistency.finding)
    if not consistency.is_sound:
        return answers.stop()
    quick = some_frames(quick, consistency.frames)
    orbit = find_orbit(rt, quick, scan, consistency.sees_angles)
    answers.add(orbit.sign)
    answers.add(orbit.centre)
    quick = orbit.corrected(quick)

    def ask(question: str, check_question: Callable[[Runtime, Scan], Finding], coarse_scan: Scan) -> None:
        answers.add(check_question(rt, coarse_scan) if consistency.sees_angles else same_from_everywhere(question))

    ask(DISTANCES, check_distances, quick)
    gain = check_gain(rt, quick)
    if gain.verdict == SUSPICIOUS and coverage.unit == CUT_OFF:  # an object that leaves the panel changes the levels too
        gain = replace(gain, verdict=CANNOT_TELL, text=f"{gain.text}, or the object does beyond the panel")
    answers.add(gain)
    if READOUT in questions:
        ask(READOUT, check_readout, orbit.corrected(some_frames(coarse(scan, FINE_COLUMNS), consistency.frames)))
    if EXPOSURE in questions:
        ask(EXPOSURE, check_exposure, quick)
    if orbit.is_reversed or orbit.centre.unit == OTHER_CAUSE:  # the offset's sign or size depends on another correction
        return CheckResult(answers.findings, is_consistent=False)
    pitch_mm = scan.geometry.pixel_size_mm[1]
    return CheckResult(answers.findings, orbit.shift.pixels * pitch_mm, orbit.shift.deviation * pitch_mm)


def _finite(scan: Scan) -> Scan:
    """Returns the scan with zeros for masked values that are not finite."""
    p = np.asarray(scan.projections)
    if not scan.valid.any():
        raise InputError("pixel_mask", "every pixel masked", "at least one usable pixel", "correct the mask")
    is_finite = np.isfinite(p)
    if is_finite.all():
        return scan
    checks.finite("projections", p[scan.valid])
    return replace(scan, projections=np.where(is_finite, p, 0).astype(np.float32))


def _with_masked(scan: Scan, dead: np.ndarray) -> Scan:
    """Returns the scan with dead pixels (v, u) in its mask."""
    if not dead.any():
        return scan
    mask = dead if scan.pixel_mask is None else (np.asarray(scan.pixel_mask) != 0) | dead
    return replace(scan, pixel_mask=mask)
