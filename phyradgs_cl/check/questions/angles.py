"""Are the views spread over the turn?"""

import math

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import OK, SUSPICIOUS, Finding
from phyradgs_cl.check.questions.timing import azimuth_rad

_WIDE = 3.0  # times the median step
_SAME_RAD = 1e-6
_TOLERATED_DEG = 1.0  # rays that are nearly parallel need no more than half a turn
_QUESTION = "angles"


def check_angles(scan: Scan) -> Finding:
    """The largest gap between neighbouring views, against three times the usual one. Views that cover half a turn and
    the fan (or more) leave one gap that is no fault; less is one whatever the steps."""
    apart_deg = _apart_deg(scan)
    if apart_deg.size < 3:
        count = max(apart_deg.size, 1)
        text = f"{count} different angle{'s' if count > 1 else ''}"
        advice = "check rotation_angle and its unit (degrees)"
        return Finding(_QUESTION, SUSPICIOUS, float(apart_deg.size), 3.0, "angles", text, advice)
    usual_deg = float(np.median(apart_deg))
    widest = np.sort(apart_deg)[::-1]
    is_short = widest[0] > _WIDE * usual_deg
    covered_deg = 360 - float(widest[0]) + usual_deg * is_short  # half a step before the first view and behind the last
    needed_deg = 180 + 2 * _half_fan_deg(scan)
    if is_short and covered_deg < needed_deg - _TOLERATED_DEG:
        text = f"views cover {covered_deg:.4g}°, half a turn and the fan are {needed_deg:.4g}°"
        advice = "expect streaks along the missing directions; check rotation_angle, its unit and its sign"
        return Finding(_QUESTION, SUSPICIOUS, covered_deg, needed_deg, "degrees", text, advice)
    gap_deg = float(widest[1] if is_short else widest[0])
    text = f"{apart_deg.size} angles over {covered_deg:.4g}°, usually {usual_deg:.3g}° apart, at most {gap_deg:.3g}°"
    if gap_deg <= _WIDE * usual_deg:
        return Finding(_QUESTION, OK, gap_deg, _WIDE * usual_deg, "degrees", text)
    advice = "are frames missing, or angles mixed up? Leave out what is not to be trusted (image_key 3)"
    return Finding(_QUESTION, SUSPICIOUS, gap_deg, _WIDE * usual_deg, "degrees", text, advice)


def is_full_turn(scan: Scan) -> bool:
    """Whether no gap between views stands out."""
    apart_deg = _apart_deg(scan)
    return apart_deg.size > 0 and float(apart_deg.max()) <= _WIDE * float(np.median(apart_deg))


def _apart_deg(scan: Scan) -> np.ndarray:
    """Degrees from each different angle of the views to the next, around the turn."""
    middle_s = np.asarray(scan.frame_start_s) + scan.shutter.middle_s
    poses = np.stack([scan.trajectory.pose(f, middle_s[f : f + 1])[0] for f in range(scan.frames)])
    angles_rad = np.sort(azimuth_rad(poses) % (2 * np.pi))
    gaps_deg = np.rad2deg(np.diff(angles_rad, append=angles_rad[0] + 2 * np.pi))
    return gaps_deg[gaps_deg > math.degrees(_SAME_RAD)]


def _half_fan_deg(scan: Scan) -> float:
    """Half the fan that the reconstruction's box takes, no more than the panel sees."""
    geometry = scan.geometry
    half_width_mm = geometry.detector_shape[1] * geometry.pixel_size_mm[1] / 2
    seen = math.atan2(half_width_mm, geometry.source_to_detector_mm)
    radius_mm = max(scan.grid.size_mm[1:]) / 2
    taken = math.asin(min(1.0, radius_mm / geometry.source_to_axis_mm))
    return math.degrees(min(seen, taken))
