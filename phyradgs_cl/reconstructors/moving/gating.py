"""Signals and phases that are stated rather than found: in the scan itself, or in a file of comma-separated values."""

from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating
from phyradgs_cl.reconstructors.moving.signal import MotionSignal, middle_times_s, period_of, scaled

_FEWEST = 4  # values
_FRAMES_PER_PERIOD = 6  # where no rate dominates
_FORMS = f"at least {_FEWEST} lines: time in s, value; or one value for each frame"


def gating_of_scan(scan: Scan) -> Gating:
    """Returns what the scan states. Raises InputError for a scan without gating."""
    if scan.gating is None:
        remedy = "take --set gating=auto, or a file NAME.csv"
        raise InputError("gating", "scan, which states neither", "a signal or a phase in phyradgs/gating", remedy)
    return scan.gating


def load_gating(path: str, scan: Scan) -> Gating:
    """Loads a file with lines ``time in s, value``, or with one value for each frame in their order, with or without a
    heading. Values whose heading is ``phase`` are phases in cycles. Raises InputError for other files."""
    subject = f"gating {path}"
    try:
        lines = [line.strip() for line in Path(path).read_text(encoding="utf-8").splitlines() if line.strip()]
        names, lines = (lines[0].lower(), lines[1:]) if lines and not _is_number(lines[0].split(",")[0]) else ("", lines)
        rows = [[float(word) for word in line.split(",")] for line in lines]
    except OSError as error:
        raise InputError(subject, str(error.strerror), _FORMS, "check the path") from error
    except ValueError as error:
        raise InputError(subject, str(error), _FORMS) from error
    if len(rows) < _FEWEST:
        raise InputError(subject, f"{len(rows)} lines of numbers", _FORMS)
    widths = {len(row) for row in rows}
    if widths not in ({1}, {2}):
        raise InputError(subject, "a line that is not two numbers", _FORMS)
    numbers = np.array(rows)
    if not np.isfinite(numbers).all():
        raise InputError(subject, f"{int((~np.isfinite(numbers)).any(1).sum())} lines with NaN or infinity", _FORMS)
    if widths == {1}:
        if len(rows) != scan.frames:
            raise InputError(subject, f"{len(rows)} values without times", f"one for each of {scan.frames} frames")
        numbers = np.column_stack([middle_times_s(scan), numbers])
    times_s, values = numbers[np.argsort(numbers[:, 0], kind="stable")].T
    try:
        return Gating(times_s, values, is_phase=names.split(",")[-1].strip() == "phase")
    except InputError as error:
        found = f"{len(times_s)} times from {times_s[0]:.4g} to {times_s[-1]:.4g} s, of which some are equal"
        raise InputError(subject, found, "times that rise") from error


def signal_of(gating: Gating, scan: Scan, subject: str) -> MotionSignal:
    """Returns the signal of a gating. Its period is that of the phases or of the spectrum, or six frames' time where no rate
    dominates. Raises InputError, about ``subject``, for times that miss the scan and values that do not change."""
    times_s, values = gating.times_s, gating.values
    advance = float(gating.steps.sum()) if gating.is_phase else 0.0
    if advance == 0 and (gating.is_phase or np.ptp(values) == 0):
        remedy = "take --set gating=auto, which finds its own"
        raise InputError(subject, f"the same value {values[0]:.4g} throughout", "values that change", remedy)
    first_s, last_s = float(np.min(scan.frame_start_s)), float(np.max(scan.frame_start_s))
    if times_s[0] > first_s + scan.shutter.span_s or times_s[-1] < last_s:
        found = f"{len(times_s)} times from {times_s[0]:.4g} to {times_s[-1]:.4g} s"
        raise InputError(subject, found, f"times that cover the scan, {first_s:.4g} to {last_s:.4g} s")
    if gating.is_phase:
        angles_rad = 2 * np.pi * values
        period_s = float(times_s[-1] - times_s[0]) / advance
        return MotionSignal(times_s, scaled(np.cos(angles_rad)), period_s, np.sin(angles_rad))
    step_s = float(np.median(np.diff(np.sort(scan.frame_start_s)))) if scan.frames > 1 else 1.0
    return MotionSignal(times_s, scaled(values), period_of(times_s, values) or _FRAMES_PER_PERIOD * step_s)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
