"""All questions in the order in which they rest on each other; what is found is taken out of the way of the next."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.coarse import FINE, QUICK, coarse, some_frames
from phyradgs_cl.check.finding import CANNOT_TELL, FEWEST_COLUMNS, OK, SUSPICIOUS, Finding, too_narrow
from phyradgs_cl.check.questions.angles import check_angles
from phyradgs_cl.check.questions.consistency import CONSISTENCY, check_consistency
from phyradgs_cl.check.questions.coverage import CUT_OFF, NO_OBJECT, OPAQUE, TOO_BRIGHT, check_coverage
from phyradgs_cl.check.questions.dead_pixels import check_dead_pixels
from phyradgs_cl.check.questions.distances import DISTANCES, UNVERIFIED, check_distances
from phyradgs_cl.check.questions.exposure import EXPOSURE, check_exposure
from phyradgs_cl.check.questions.gain import GAIN, check_gain
from phyradgs_cl.check.questions.offset import (
    CENTRE,
    OTHER_CAUSE,
    Offset,
    best_offset,
    block_of,
    check_offset,
    rough_offset,
    with_coarseness,
)
from phyradgs_cl.check.questions.readout import READOUT, check_readout
from phyradgs_cl.check.questions.rotation import SIGN, blamed, check_rotation, is_clear
from phyradgs_cl.check.questions.saturation import OVERFLOW, CountReader, check_saturation
from phyradgs_cl.check.questions.timing import check_timing
from phyradgs_cl.check.variants import reversed_rotation, shifted
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.frames.preprocess import Preprocessing, prepared
from phyradgs_cl.runtime import Runtime


@dataclass(frozen=True, eq=False)
class CheckResult:
    """The findings in order, and the shift of the panel along u in mm that explains the frames best (NaN: none does, or
    something else has to be put right first, and ``is_consistent`` is false)."""

    findings: list[Finding]
    offset_mm: float
    offset_spread_mm: float
    is_consistent: bool = True

    @property
    def suspicious(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.verdict == SUSPICIOUS]


def check(
    scan: Scan,
    rt: Runtime,
    counts: CountReader | None = None,
    report: Callable[[int, int, str], None] = lambda done, total, question: None,
) -> CheckResult:
    """What is wrong or suspicious in a scan; ``counts`` is what its file was read with, where it was. ``report`` gets how
    many questions are answered, of how many, and the next. InputError: every pixel masked; NaN or infinity elsewhere."""
    scan = prepared(_usable(scan), Preprocessing())
    asks_readout = scan.is_fly and scan.shutter.exposure_s + scan.shutter.readout_s > 0
    asks_exposure = scan.shutter.exposure_s > 0
    names = ["timing", "angles", "saturation", "dead pixels", "coverage", CONSISTENCY, SIGN, CENTRE, DISTANCES, GAIN]
    names += [READOUT] * asks_readout + [EXPOSURE] * asks_exposure
    found: list[Finding] = []

    def add(finding: Finding) -> Finding:
        if finding.question == DISTANCES and finding.verdict == CANNOT_TELL:
            finding = replace(finding, text=f"{finding.text}; {UNVERIFIED}")
        found.append(finding)
        report(len(found), len(names), names[len(found)] if len(found) < len(names) else "")
        return finding

    report(0, len(names), names[0])
    add(check_timing(scan))
    add(check_angles(scan))
    saturation = add(check_saturation(scan, counts))

    def leave_the_rest() -> CheckResult:
        cause = found[-1]
        for name in names[len(found) :]:
            add(Finding(name, CANNOT_TELL, 0.0, 0.0, "", f"rests on {cause.question}: {cause.verdict}"))
        return CheckResult(found, math.nan, math.nan, False)

    if saturation.unit == OVERFLOW:
        return leave_the_rest()
    finding, dead = check_dead_pixels(scan)
    if finding.verdict == SUSPICIOUS and saturation.verdict != OK:  # a saturated pixel is as still as a dead one
        finding = replace(finding, verdict=CANNOT_TELL, text=f"rests on saturation: {saturation.verdict}", advice="")
    add(finding)
    scan = _without(scan, dead)
    coverage = add(check_coverage(scan))
    if coverage.unit in (NO_OBJECT, OPAQUE, TOO_BRIGHT):
        return leave_the_rest()
    quick = coarse(scan, QUICK)
    fits = check_consistency(rt, quick, scan)
    add(fits.finding)
    if not fits.is_sound:
        return leave_the_rest()
    quick = some_frames(quick, fits.kept)
    is_reversed, offset, centre = _turning(rt, quick, scan, add, fits.sees_angles)
    pitch_mm = scan.geometry.pixel_size_mm[1]
    quick = _under(quick, is_reversed, offset, centre)
    add(check_distances(rt, quick) if fits.sees_angles else _looks_alike(DISTANCES))
    gain = check_gain(rt, quick)
    if gain.verdict == SUSPICIOUS and coverage.unit == CUT_OFF:  # what leaves the panel takes its attenuation along
        gain = replace(gain, verdict=CANNOT_TELL, text=f"{gain.text}, or the object does beyond the panel")
    add(gain)
    if asks_readout:
        fine = _under(some_frames(coarse(scan, FINE), fits.kept), is_reversed, offset, centre)
        add(check_readout(rt, fine) if fits.sees_angles else _looks_alike(READOUT))
    if asks_exposure:
        add(check_exposure(rt, quick) if fits.sees_angles else _looks_alike(EXPOSURE))
    if is_reversed or centre.unit == OTHER_CAUSE:  # its sign or size is another's to say
        return CheckResult(found, math.nan, math.nan, False)
    return CheckResult(found, offset.pixels * pitch_mm, offset.spread * pitch_mm)


def _looks_alike(question: str) -> Finding:
    return Finding(question, CANNOT_TELL, 0.0, 0.0, "", "the object looks the same from every angle")


def _turning(
    rt: Runtime, quick: Scan, as_stated: Scan, add: Callable[[Finding], Finding], sees_angles: bool
) -> tuple[bool, Offset, Finding]:
    """(does the gantry turn the other way, where is its axis on the panel, what was found about that); a panel
    of few columns says neither."""
    if quick.geometry.detector_shape[1] < FEWEST_COLUMNS:
        add(too_narrow(SIGN, "standard errors"))
        return False, Offset(math.nan, math.nan, np.empty(0)), add(too_narrow(CENTRE, "pixels"))
    if not sees_angles:
        add(_looks_alike(SIGN))
        return False, Offset(math.nan, math.nan, np.empty(0)), add(_looks_alike(CENTRE))
    turned, block = reversed_rotation(quick), block_of(quick)
    stated, other = rough_offset(rt, quick), rough_offset(rt, turned)
    was_clear = is_clear(stated, other)
    if not was_clear:
        stated, other = best_offset(rt, quick, stated), best_offset(rt, turned, other)
    sign = check_rotation(stated, other)
    is_reversed = sign.verdict == SUSPICIOUS
    offset = other if is_reversed else stated
    if was_clear:
        offset = best_offset(rt, turned if is_reversed else quick, offset)
    offset = with_coarseness(offset, block, as_stated)
    pitch_mm = quick.geometry.pixel_size_mm[1] / block
    stated_px = as_stated.geometry.detector_offset_mm[1] / pitch_mm
    centre = check_offset(offset, block, pitch_mm, stated_px)
    if is_reversed:
        sign = blamed(sign, offset.pixels, stated_px, centre.threshold)
        centre = replace(centre, verdict=CANNOT_TELL, text=f"rests on {SIGN}: {SUSPICIOUS}", advice="")
    add(sign)
    return is_reversed, offset, add(centre)


def _usable(scan: Scan) -> Scan:
    """The scan with zeros for masked values that are not finite."""
    p = np.asarray(scan.projections)
    if not scan.valid.any():
        raise InputError("pixel_mask", "every pixel masked", "pixels that say something", "check the mask")
    finite = np.isfinite(p)
    if finite.all():
        return scan
    checks.finite("projections", p[scan.valid])
    return replace(scan, projections=np.where(finite, p, 0).astype(np.float32))


def _without(scan: Scan, dead: np.ndarray) -> Scan:
    """The scan with dead pixels (v, u) in its mask."""
    if not dead.any():
        return scan
    mask = dead if scan.pixel_mask is None else (np.asarray(scan.pixel_mask) != 0) | dead
    return replace(scan, pixel_mask=mask)


def _under(scan: Scan, is_reversed: bool, offset: Offset, centre: Finding) -> Scan:
    """The scan as the questions so far have it: turned round where it has to be, the panel where it really is."""
    scan = reversed_rotation(scan) if is_reversed else scan
    is_moved = math.isfinite(offset.pixels) and abs(offset.pixels) > centre.threshold
    return shifted(scan, offset.pixels) if is_moved else scan
