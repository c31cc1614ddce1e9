"""Checks that exposure, readout, frame times and angles agree with each other, and that the views cover the turn."""

import math

import numpy as np

from phyradgs_cl.acquisition import (
    CircularOrbit,
    EncoderTable,
    FrameSweeps,
    ParallelGeometry,
    PoseTable,
    Scan,
)
from phyradgs_cl.acquisition.altered.angles import (
    azimuth_rad,
    has_opposite_views,
    middle_poses,
    start_azimuths_rad,
    wrapped,
)
from phyradgs_cl.check.finding import OK, SUSPICIOUS, Finding

_TIMING, _ANGLES = "timing", "angles"
_ROUNDING = 1e-3  # relative tolerance: files round times and angles
_SPEED_TOLERANCE = 0.02  # largest relative difference of the speeds between and within frames: gantries vary less
_LONGEST_TABLE = 100.0  # largest (a table's duration) / (the scan's duration) if the frames see an arc below _FEW_RAD
_FEW_RAD = math.radians(5)  # frames that see at least this arc of a table show that table and frames have one unit of time
_MILLISECONDS = (900.0, 3000.0)  # with (table's duration) / (scan's duration) in this range, the table is likely in ms
_WIDE = 3.0  # a gap between views is wide above this multiple of the median gap
_SAME_VIEW = 0.05  # views nearer to each other than this fraction of the mean step are repeats with uneven angles
_SAME_RAD = 1e-6  # views nearer to each other than this have the same angle
_TOLERATED_DEG = 1.0  # views may cover this much less than half a turn plus the fan, which nearly parallel rays do not need


def check_timing(scan: Scan) -> Finding:
    """Compares exposure, readout and table times with the frame times, and the angles with the speed.

    A line cannot open while it is open, a frame cannot be read while the one before is read, and a gantry has one angle at a
    time. Four numbers have limits: exposure / shortest frame period, readout / shortest frame period, 1 + the relative
    difference between the angle steps and the speed within the frames, and (a table's duration) / (the scan's duration). The
    finding's value is the first number that exceeds its limit, or else the one nearest to its limit."""
    starts_s = np.asarray(scan.frame_start_s, np.float64)
    if scan.frames < 2:
        return Finding(_TIMING, OK, 0.0, 1.0, "share", "one frame: nothing to compare")
    period_s = float(np.diff(starts_s).min())
    if period_s <= 0:
        text = "a frame starts before the frame that precedes it in the file"
        advice = "correct frame_start_time: frames must follow each other"
        return Finding(_TIMING, SUSPICIOUS, period_s, 0.0, "s", text, advice)
    if not scan.is_fly:
        return Finding(_TIMING, OK, 0.0, 1.0, "share", "the gantry stands still during exposures: any timing fits")
    findings = [
        _share("exposure", "a line would open again while it is open", scan.shutter.exposure_s / period_s),
        _share("readout", "a frame would be read while the last one is", scan.shutter.readout_s / period_s),
    ]
    # in other trajectories the angle steps and the speed come from one function of time, so the two always agree
    if isinstance(scan.trajectory, CircularOrbit) and isinstance(scan.trajectory.kinematics, FrameSweeps):
        findings.append(_speed(scan, starts_s))
    findings += _table(scan)
    suspicious = [finding for finding in findings if finding.verdict == SUSPICIOUS]
    return suspicious[0] if suspicious else max(findings, key=lambda finding: finding.value / finding.threshold)


def _share(name: str, consequence: str, share: float) -> Finding:
    text = f"{name} takes {100 * share:.4g} % of the time between frames"
    if share <= 1 + _ROUNDING:
        return Finding(_TIMING, OK, share, 1.0, "share", text)
    advice = f"correct the {name} time (is it stated {share:.3g} times too long?) or frame_start_time"
    return Finding(_TIMING, SUSPICIOUS, share, 1.0, "share", f"{text}: {consequence}", advice)


def _table(scan: Scan) -> list[Finding]:
    """Returns a finding if a table of angles or poses lasts over 100 times as long as the scan, and the frames see less than
    5° of it: the times of table and frames are then likely to be in different units. Returns [] otherwise."""
    table = scan.trajectory.kinematics if isinstance(scan.trajectory, CircularOrbit) else scan.trajectory
    if not isinstance(table, EncoderTable | PoseTable):
        return []
    ratio = float(np.ptp(table.time_s)) / (float(np.ptp(scan.frame_start_s)) + scan.shutter.span_s)
    seen_rad = float(np.ptp(np.unwrap(start_azimuths_rad(scan))))
    if ratio <= _LONGEST_TABLE or seen_rad >= _FEW_RAD:
        return []
    kind, seen_deg = "poses" if isinstance(table, PoseTable) else "angles", math.degrees(seen_rad)
    text = f"the table of {kind} runs {ratio:.4g} times as long as the frames, which see {seen_deg:.3g}° of it"
    advice = "correct its times or the frames', and their units"
    if _MILLISECONDS[0] <= ratio <= _MILLISECONDS[1]:
        advice = "are its times in ms, and the frames' in s?"
    return [Finding(_TIMING, SUSPICIOUS, ratio, _LONGEST_TABLE, "share", text, advice)]


def _speed(scan: Scan, starts_s: np.ndarray) -> Finding:
    """Compares the angle from a frame to the next with the speed within the frame, by medians, since gantry speeds vary."""
    span_s = scan.shutter.exposure_s or scan.shutter.span_s
    by_speed, stepped = np.empty(scan.frames - 1), np.empty(scan.frames - 1)
    for frame in range(scan.frames - 1):
        times_s = starts_s[frame] + np.array([0.0, span_s])
        first, last = azimuth_rad(scan.trajectory.pose(frame, times_s))
        following = azimuth_rad(scan.trajectory.pose(frame + 1, starts_s[frame + 1 : frame + 2]))[0]
        by_speed[frame] = wrapped(last - first) * (starts_s[frame + 1] - starts_s[frame]) / span_s
        stepped[frame] = by_speed[frame] + wrapped(following - first - by_speed[frame])
    difference = float(np.median(np.abs(stepped - by_speed))) / max(float(np.median(np.abs(stepped))), 1e-9)
    text = f"angle steps between frames differ by {100 * difference:.2f} % from the speed within the frames"
    values = (1 + difference, 1 + _SPEED_TOLERANCE, "share", text)
    if difference <= _SPEED_TOLERANCE:
        return Finding(_TIMING, OK, *values)
    speed_deg, step_deg = math.degrees(float(np.median(by_speed))), math.degrees(float(np.median(stepped)))
    advice = (
        f"at the speed within the frames the gantry turns {speed_deg:.4g}° from frame to frame, the angles say "
        f"{step_deg:.4g}°: correct the exposure time, frame_start_time or rotation_angle_end"
    )
    return Finding(_TIMING, SUSPICIOUS, *values, advice)


def check_angles(scan: Scan) -> Finding:
    """Compares the largest gap between neighbouring views with three times the median gap.

    Views of a cone beam that cover at least half a turn plus the fan may leave one wide gap. Less coverage is suspicious.
    Parallel rays at right angles to the axis see the same after half a turn, so their angles are taken modulo 180°. Parallel
    rays at another angle to the axis need a full turn."""
    turn_deg, needed_deg, of_needed = _needed_turn(scan)
    steps_deg = _steps_deg(scan, turn_deg)
    if steps_deg.size < 3:
        count = max(steps_deg.size, 1)
        text = f"{count} different angle{'s' if count > 1 else ''}"
        advice = "check rotation_angle and its unit (degrees)"
        return Finding(_ANGLES, SUSPICIOUS, float(steps_deg.size), 3.0, "angles", text, advice)
    usual_deg = float(np.median(_steps_deg(scan)))
    widest = np.sort(steps_deg)[::-1]
    is_short = widest[0] > _WIDE * usual_deg
    # A view covers half a step to each side, so the views cover one step more than from the first to the last.
    covered_deg = turn_deg - float(widest[0]) + usual_deg if is_short else turn_deg
    if is_short and covered_deg < needed_deg - _TOLERATED_DEG:
        text = f"views cover {covered_deg:.4g}°; {of_needed}"
        advice = "expect streaks along the missing directions; check rotation_angle, its unit and its sign"
        return Finding(_ANGLES, SUSPICIOUS, covered_deg, needed_deg, "degrees", text, advice)
    gap_deg = float(widest[1] if is_short and not scan.is_parallel else widest[0])
    text = f"{steps_deg.size} angles over {covered_deg:.4g}°, usually {usual_deg:.3g}° apart, at most {gap_deg:.3g}°"
    if gap_deg <= _WIDE * usual_deg:
        return Finding(_ANGLES, OK, gap_deg, _WIDE * usual_deg, "degrees", text)
    advice = "are frames missing, or angles mixed up? Exclude doubtful frames (image_key 3)"
    return Finding(_ANGLES, SUSPICIOUS, gap_deg, _WIDE * usual_deg, "degrees", text, advice)


def is_full_turn(scan: Scan) -> bool:
    """Returns whether no gap between views, around a full turn, is wider than three times the median gap."""
    steps_deg = _steps_deg(scan)
    return steps_deg.size > 0 and float(steps_deg.max()) <= _WIDE * float(np.median(steps_deg))


def _needed_turn(scan: Scan) -> tuple[float, float, str]:
    """Returns the degrees after which views repeat, the degrees of views that a volume needs, and the latter in words."""
    geometry = scan.geometry
    if isinstance(geometry, ParallelGeometry):
        if has_opposite_views(scan):
            return 180.0, 180.0, "parallel rays need half a turn"
        return 360.0, 360.0, "parallel rays that rise need a full turn"
    # The fan under which the source sees the grid, or the panel if its fan is narrower.
    half_width_mm = geometry.detector_shape[1] * geometry.pixel_size_mm[1] / 2
    panel_rad = math.atan2(half_width_mm, geometry.source_to_detector_mm)
    box_rad = math.asin(min(1.0, max(scan.grid.size_mm[1:]) / 2 / geometry.source_to_axis_mm))
    needed_deg = 180 + 2 * math.degrees(min(panel_rad, box_rad))
    return 360.0, needed_deg, f"half a turn and the fan are {needed_deg:.4g}°"


def _steps_deg(scan: Scan, turn_deg: float = 360.0) -> np.ndarray:
    """Returns the gaps (n,) in degrees between neighbouring views' angles modulo ``turn_deg``, without gaps of repeats."""
    angles_deg = np.rad2deg(azimuth_rad(middle_poses(scan))) % turn_deg
    angles_deg = np.sort(angles_deg % turn_deg)  # the second % is needed because -1e-16 % 360 is 360
    steps_deg = np.diff(angles_deg, append=angles_deg[0] + turn_deg)
    return steps_deg[steps_deg > max(math.degrees(_SAME_RAD), _SAME_VIEW * turn_deg / len(angles_deg))]
